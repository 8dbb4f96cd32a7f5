"""Files that servers and git put in the place of others are named by every reader of arrays."""

from __future__ import annotations

import gzip
import re
import zipfile
from pathlib import Path

import pytest
import torch

from rgbt.checkpoints.files import read
from rgbt.checks import InputError
from rgbt.exported.onnx_network import ExportedNetwork
from rgbt.files.plain_files import disguise
from rgbt.metrics.counts import Counts

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab\nsize 12345\n"
FILES = {
    b"\n<!DOCTYPE html>\n<html><body>Sign in</body></html>": "a web page",
    b"<HTML lang=en>": "a web page",
    b'<?xml version="1.0"?><Error><Code>AccessDenied</Code></Error>': "in XML",
    b'{"error": {"code": 404}}': "in JSON",
    POINTER: "a pointer of Git LFS",
    gzip.compress(b"weights"): "packed with gzip",
    b"Not found\n": "a text that begins with 'not found'",
    b"": "empty",
}


@pytest.mark.parametrize(("content", "what"), FILES.items(), ids=FILES.values())
def test_disguised_file_is_named_by_every_reader(tmp_path: Path, content: bytes, what: str) -> None:
    for name, reader in {
        "w.pth": read,
        "w.safetensors": read,
        "w.npz": Counts.load,
        "w.onnx": ExportedNetwork.read,
    }.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError, match=re.escape(what)) as refused:
            reader(path)
        assert str(path) in str(refused.value)


def test_archive_of_other_files_is_no_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "release.pth"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("release/model.pth", b"x")
    with pytest.raises(InputError, match=r"a zip archive of release/model\.pth; unpack it"):
        read(path)


def test_weights_are_not_disguised(tmp_path: Path) -> None:
    torch.save({"a": torch.zeros(2)}, tmp_path / "w.pth")
    assert disguise(tmp_path / "w.pth") == ""
    assert disguise(tmp_path / "none") == ""
