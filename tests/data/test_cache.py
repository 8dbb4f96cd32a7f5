"""Decoded images in memory-mapped files: equal to the data set, and renewed with its files."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.cache import CachedDataset
from rgbt.data.mfnet import MFNet
from rgbt.types import Sample
from tests.conftest import WriteMFNet

NAMES = ("00001D", "00002N")


@pytest.fixture
def source(write_mfnet: WriteMFNet) -> MFNet:
    return MFNet(str(write_mfnet({"train": list(NAMES)}, (5, 7))))


def filled(source: MFNet, folder: Path) -> CachedDataset:
    """A cache that has read every sample once."""
    cached = CachedDataset(source, str(folder))
    for name in NAMES:
        cached.read(name)
    return cached


def decoded(monkeypatch: pytest.MonkeyPatch, source: MFNet) -> list[str]:
    """Names that are decoded from now on."""
    names: list[str] = []
    read = type(source).read

    def noted(self: MFNet, name: str) -> Sample:
        names.append(name)
        return read(self, name)

    monkeypatch.setattr(MFNet, "read", noted)
    return names


def assert_equal(found: Sample, expected: Sample) -> None:
    assert found.name == expected.name
    for kind in ("rgb", "thermal", "label"):
        one, other = getattr(found, kind), getattr(expected, kind)
        assert (one is None) == (other is None)
        if one is not None:
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)


def test_samples_are_decoded_once_and_equal(
    source: MFNet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = [source.read(name) for name in NAMES]
    cached = filled(source, tmp_path / "cache")
    names = decoded(monkeypatch, source)
    # As a worker process gets it, and another command.
    for each in (cached, pickle.loads(pickle.dumps(cached)), filled(source, tmp_path / "cache")):
        for sample in expected:
            assert_equal(each.read(sample.name), sample)
            np.testing.assert_array_equal(each.label(sample.name), sample.label)
    assert names == []
    view = cached.read(NAMES[0])
    for image in (view.rgb, view.thermal, view.label):
        assert image is not None
        assert image.flags.c_contiguous
        assert not image.flags.writeable


def test_pairs_without_label(source: MFNet, tmp_path: Path) -> None:
    class Unlabelled(MFNet):
        def label(self, name: str) -> None:
            return None

    dataset = Unlabelled(str(source.root))
    cached = filled(dataset, tmp_path / "cache")
    assert_equal(cached.read(NAMES[0]), dataset.read(NAMES[0]))
    assert cached.label(NAMES[0]) is None


@pytest.mark.parametrize("change", ["content", "content in its time", "label", "copied elsewhere"])
def test_changed_files_are_decoded_again(
    source: MFNet, write_mfnet: WriteMFNet, tmp_path: Path, change: str
) -> None:
    cached = filled(source, tmp_path / "cache")
    image, label = source.files(NAMES[0])
    other = write_mfnet({"train": [NAMES[1]]}, (5, 7), folder="other")
    if change == "copied elsewhere":
        shutil.copytree(source.root, tmp_path / "copy")
        moved = MFNet(str(tmp_path / "copy"))
        shutil.copy(other / "images" / f"{NAMES[1]}.png", moved.files(NAMES[0])[0])
        assert_equal(
            CachedDataset(moved, str(tmp_path / "cache")).read(NAMES[0]), moved.read(NAMES[0])
        )
        return
    kind, path = ("labels", label) if change == "label" else ("images", image)
    before = path.stat()
    shutil.copy(other / kind / f"{NAMES[1]}.png", path)
    if change == "content in its time":
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert_equal(cached.read(NAMES[0]), source.read(NAMES[0]))
    assert_equal(cached.read(NAMES[1]), source.read(NAMES[1]))


@pytest.mark.parametrize("damage", [b"", b"no array"])
def test_damaged_file_of_the_cache_is_written_again(
    source: MFNet, tmp_path: Path, damage: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    cached = filled(source, tmp_path / "cache")
    for path in (tmp_path / "cache").iterdir():
        path.write_bytes(damage or path.read_bytes()[:-9])
    names = decoded(monkeypatch, source)
    for name in NAMES * 2:
        assert_equal(cached.read(name), source.read(name))
    assert names.count(NAMES[0]) == 3  # two of them by this test


def test_other_decoding_has_other_files(source: MFNet, tmp_path: Path) -> None:
    filled(source, tmp_path / "cache")
    changed = MFNet(str(source.root))
    changed.codes.codes[0] = 1
    cached = filled(changed, tmp_path / "cache")
    assert_equal(cached.read(NAMES[0]), changed.read(NAMES[0]))
    assert len(list((tmp_path / "cache").iterdir())) == 4


def test_message_of_the_data_set_and_of_the_disk(source: MFNet, tmp_path: Path) -> None:
    source.files(NAMES[0])[0].unlink()
    cached = CachedDataset(source, str(tmp_path / "cache"))
    with pytest.raises(InputError, match=f"'{NAMES[0]}': its RGB image .* is missing"):
        cached.read(NAMES[0])
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "cache"):
        with pytest.raises(InputError, match=r"data\.cache: cannot write .*data\.cache=FOLDER"):
            CachedDataset(source, str(folder)).read(NAMES[1])


def test_arrays_of_another_type_are_refused(source: MFNet, tmp_path: Path) -> None:
    class Floats(MFNet):
        def read(self, name: str) -> Sample:
            sample = super().read(name)
            return Sample(sample.rgb / np.float32(255), sample.thermal, sample.label, name)  # type: ignore[arg-type]

    dataset: Any = Floats(str(source.root))
    with pytest.raises(InputError, match=r"data\.cache: images of '00001D' are not uint8"):
        CachedDataset(dataset, str(tmp_path / "cache")).read(NAMES[0])


def test_folder_of_the_user(source: MFNet, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert CachedDataset(source, "auto").folder == tmp_path / "xdg" / "rgbt" / "decoded"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert CachedDataset(source, "auto").folder == tmp_path / "home" / ".cache" / "rgbt" / "decoded"
    assert CachedDataset(source, "~/x").folder == tmp_path / "home" / "x"
