"""Decoded images in memory-mapped files: equal to the data set, and renewed with its files."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from rgbt.data import cache
from rgbt.data.cache import CachedDataset
from rgbt.data.mfnet import MFNet
from rgbt.types import Sample
from tests.conftest import WriteMFNet
from tests.data.layouts import refused

NAMES = ("00001D", "00002N")


@pytest.fixture
def source(write_mfnet: WriteMFNet) -> MFNet:
    return MFNet(str(write_mfnet({"train": list(NAMES)}, (5, 7))))


@pytest.fixture
def cached(source: MFNet, tmp_path: Path) -> CachedDataset:
    """A cache that has read every sample once."""
    found = CachedDataset(source, str(tmp_path / "cache"))
    for name in NAMES:
        found.read(name)
    return found


def assert_equal(found: Sample, expected: Sample) -> None:
    for kind in ("name", "rgb", "thermal", "label"):
        one, other = getattr(found, kind), getattr(expected, kind)
        assert getattr(one, "dtype", None) == getattr(other, "dtype", None)
        np.testing.assert_array_equal(one, other)


def test_samples_are_decoded_once_and_equal(
    source: MFNet, cached: CachedDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = [source.read(name) for name in NAMES]
    monkeypatch.setattr(MFNet, "read", None)
    # As a worker process gets it, and another command.
    for dataset in (cached, pickle.loads(pickle.dumps(cached))):
        cache.opened.cache_clear()
        for sample in expected * 2:
            assert_equal(dataset.read(sample.name), sample)
            np.testing.assert_array_equal(dataset.label(sample.name), sample.label)
    view = cached.read(NAMES[0])
    for image in (view.rgb, view.thermal, view.label):
        assert image.flags.c_contiguous
        assert not image.flags.writeable


def test_pairs_without_label(source: MFNet, tmp_path: Path) -> None:
    source.patterns = source.patterns._replace(label=None)
    cached = CachedDataset(source, str(tmp_path / "cache"))
    for _ in range(2):
        assert_equal(cached.read(NAMES[0]), source.read(NAMES[0]))
    assert cached.label(NAMES[0]) is None


@pytest.mark.parametrize("change", ["images", "images in their time", "labels", "copied elsewhere"])
def test_changed_files_are_decoded_again(
    source: MFNet, cached: CachedDataset, tmp_path: Path, change: str
) -> None:
    if change == "copied elsewhere":
        shutil.copytree(source.root, tmp_path / "copy")
        source = MFNet(str(tmp_path / "copy"))
        cached = CachedDataset(source, str(cached.folder))
    kind = change.partition(" ")[0].replace("copied", "images")
    path = source.root / kind / f"{NAMES[0]}.png"
    before = path.stat()
    shutil.copy(source.root / kind / f"{NAMES[1]}.png", path)
    if change == "images in their time":
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    for name in NAMES:
        assert_equal(cached.read(name), source.read(name))


@pytest.mark.parametrize("damage", [b"", b"no array"])
def test_damaged_file_of_the_cache_is_written_again(
    cached: CachedDataset, damage: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = cached.source.read(NAMES[0])
    for path in cached.folder.iterdir():
        path.write_bytes(damage or path.read_bytes()[:-9])
    assert_equal(cached.read(NAMES[0]), expected)
    monkeypatch.setattr(MFNet, "read", None)
    assert_equal(cached.read(NAMES[0]), expected)


def test_other_decoding_has_other_files(source: MFNet, cached: CachedDataset) -> None:
    source.codes.codes[0] = 1
    source.codes.__dict__.pop("_of_bytes")
    again = CachedDataset(source, str(cached.folder))
    for name in NAMES:
        assert_equal(again.read(name), source.read(name))
    assert len(list(cached.folder.iterdir())) == 4


def test_message_of_the_disk(source: MFNet, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    cached = CachedDataset(source, str(tmp_path / "file" / "cache"))
    assert "data.cache: cannot write" in refused(lambda: cached.read(NAMES[1]))


def test_folder_of_the_user(source: MFNet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/xdg")
    assert CachedDataset(source, "auto").folder == Path("/xdg/rgbt/decoded")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/me")
    assert CachedDataset(source, "auto").folder == Path("/home/me/.cache/rgbt/decoded")
    assert CachedDataset(source, "~/x").folder == Path("/home/me/x")
