"""Files that replace others, on a disk that is full: the message, and what is left."""

from __future__ import annotations

import resource
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbt.checkpoints.files import read_torch_file, save
from rgbt.checks import InputError
from rgbt.config.plain_command import exit_code
from rgbt.files.atomic import check_writable, naming_full_disk, replacing, write_atomic
from rgbt.metrics.archive import Archive


@pytest.fixture
def small_files() -> Iterator[None]:
    """No file of this process may have more than 4096 bytes; an error as of a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def test_full_disk_is_named_by_every_writer(tmp_path: Path, small_files: None) -> None:
    """torch and NumPy raise errors of their own; the old file stays, and nothing else."""
    path = tmp_path / "file"
    tensors = {"a": torch.zeros(250_000)}  # a million bytes
    arrays = {"a": np.random.default_rng(0).random(10_000)}

    def append() -> None:
        with naming_full_disk(path), path.open("ab") as file:
            file.write(bytes(5000))

    for write, needed in (
        (lambda: save(path, tensors), "1.00 MB are needed, "),
        (lambda: Archive("m", "counts", "").save(path, arrays), ""),
        (lambda: write_atomic(path, bytes(20_000)), "0.02 MB are needed, "),
        (append, ""),
    ):
        path.write_bytes(b"old")
        with pytest.raises(OSError, match=r"MB are free\); free some and rerun") as raised:
            write()
        assert raised.value.filename == str(path)
        assert f"File too large ({needed}" in str(raised.value.strerror)
        assert path.read_bytes().startswith(b"old")
        assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_other_errors_of_a_writer_stay(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), replacing(tmp_path / "file"):
        _ = 1 / 0
    with pytest.raises(FileNotFoundError):
        write_atomic(tmp_path / "none" / "file", b"")
    save(tmp_path / "file", {"a": torch.ones(3)})
    assert read_torch_file(tmp_path / "file")["a"].sum() == 3


def test_unwritable_folder_is_refused_with_its_setting(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    check_writable("out=x", tmp_path / "new" / "deeper")
    assert list(tmp_path.iterdir()) == [tmp_path / "file"], "nothing is made"
    with pytest.raises(InputError, match=f"^out=x: cannot write in {tmp_path}/file "):
        check_writable("out=x", tmp_path / "file/x")


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_folder_whose_permissions_do_not_tell_is_refused_too() -> None:
    with pytest.raises(InputError, match="^out=x: cannot write in /proc "):
        check_writable("out=x", Path("/proc/no"))


def test_error_of_a_file_names_the_word_of_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["rgbt", "a=1", "out=/x", "runs_dir=/x/y", "-m"])
    for file, said in (
        ("/x/y/z.json", "runs_dir=/x/y: /x/y/z.json"),
        ("/x/y", "runs_dir=/x/y"),
        ("/x/a", "out=/x: /x/a"),
        ("/z", "/z"),
    ):

        def work(file: str = file) -> None:
            raise PermissionError(13, "Permission denied", file)

        assert exit_code(work) == 2
        assert capsys.readouterr().err == f"rgbt: {said}: Permission denied.\n"
