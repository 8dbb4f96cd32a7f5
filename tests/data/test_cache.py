from __future__ import annotations

import hashlib
import logging
import os
import pickle
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.cache import file_state, sample_file
from rgbt.data.cache import folder as cache_folder
from rgbt.data.cache.__main__ import entry
from rgbt.data.cache.dataset import CachedDataset, _cache_name, cached_dataset, default_folder
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import PST900
from rgbt.data.reader import SplitReader
from rgbt.types import Sample
from tests.data.pst900_files import TRAIN, write_pst900

NAMES = ("a", "b", "c", "d")
SIZES = {"a": (4, 6), "b": (5, 7), "c": (4, 6), "d": (3, 3)}


class Arrays:
    """Samples as .npy: R, G, B, thermal and, except for "d", label. Records what it decodes."""

    name, num_classes, classes, unscored = "arrays", 2, ("x", "y"), ()
    palette = ((0, 0, 0), (1, 1, 1))
    splits = {"train": "all"}

    def __init__(self, root: Path, decoding: dict[str, Any] | None = None) -> None:
        self.root = root
        self.decoded: list[str] = []
        self._decoding = decoding or {}

    def has(self, split: str) -> bool:
        return True

    def names(self, split: str) -> tuple[str, ...]:
        return NAMES

    def files(self, name: str) -> tuple[Path, ...]:
        return (self.root / f"{name}.npy", self.root / f"{name}.txt")

    def decoding(self) -> dict[str, Any]:
        return self._decoding

    def read(self, name: str) -> Sample:
        self.decoded.append(name)
        path = self.files(name)[0]
        try:
            image = np.load(path)
        except (OSError, ValueError) as error:
            raise InputError(f"{path} is no array.") from error
        label = image[..., 4] if image.shape[2] == 5 else None
        return Sample(image[..., :3], image[..., 3], label, name)  # strided: rgb is a cut

    def label(self, name: str) -> np.ndarray | None:
        return self.read(name).label

    def nights(self, names: tuple[str, ...]) -> None:
        return None

    def fingerprint(self) -> str:
        sizes = [(p.stat().st_size if p.exists() else -1) for n in NAMES for p in self.files(n)]
        return hashlib.sha256(str(sizes).encode()).hexdigest()


class Case(NamedTuple):
    source: Arrays
    cache: Path

    def opened(self, source: Arrays | None = None) -> CachedDataset:
        """A new one, as in another process, with `NAMES` ensured."""
        self.source.decoded.clear()
        cached = CachedDataset(source or self.source, self.cache, num_threads=2)
        cached.ensure(NAMES)
        return cached

    def files(self) -> list[Path]:
        return sorted(self.cache.glob("*/*.frames"))


def write(root: Path, name: str, seed: int = 0) -> None:
    channels = 4 if name == "d" else 5
    rng = np.random.default_rng([seed, ord(name)])
    np.save(root / f"{name}.npy", rng.integers(0, 256, (*SIZES[name], channels), np.uint8))


@pytest.fixture
def case(tmp_path: Path) -> Case:
    root = tmp_path / "data"
    root.mkdir()
    for name in NAMES:
        write(root, name)
    return Case(Arrays(root), tmp_path / "cache")


def check_equal(found: CachedDataset, source: Any, names: tuple[str, ...] = NAMES) -> None:
    """Bit for bit the samples of the source, without reading the source."""
    for name in names:
        expected = source.read(name)
        before = list(getattr(source, "decoded", ()))
        sample = found.read(name)
        assert list(getattr(source, "decoded", ())) == before, f"{name} was decoded"
        assert sample.name == name
        assert sample.confidence is None
        np.testing.assert_array_equal(sample.rgb, expected.rgb)
        np.testing.assert_array_equal(sample.thermal, expected.thermal)
        assert (sample.label is None) == (expected.label is None)
        if expected.label is not None:
            np.testing.assert_array_equal(sample.label, expected.label)
            np.testing.assert_array_equal(found.label(name), expected.label)


def test_cache_returns_samples_of_source_decoded_once(case: Case) -> None:
    cached = case.opened()
    assert sorted(set(case.source.decoded)) == list(NAMES)
    check_equal(cached, case.source)
    assert cached.label("d") is None
    again = case.opened()
    assert case.source.decoded == []
    check_equal(again, case.source)


@pytest.mark.parametrize("layout", ["packed", "folders"])
def test_cached_mfnet_equals_source(write_mfnet, tmp_path: Path, layout: str) -> None:
    names = ("00001D", "00002N")
    source = MFNet(str(write_mfnet({"train": list(names)}, layout=layout)))
    cached = CachedDataset(source, tmp_path / "cache", num_threads=1)
    cached.ensure(source.names("train"))
    check_equal(cached, source, names)


def test_other_members_are_those_of_source(case: Case) -> None:
    cached, source = case.opened(), case.source
    assert cached.source is source
    for key in ("root", "name", "num_classes", "classes", "palette", "unscored", "splits"):
        assert getattr(cached, key) == getattr(source, key)
    assert cached.names("train") == NAMES
    assert cached.has("train")
    assert cached.files("a") == source.files("a")
    assert cached.decoding() == {}
    assert cached.nights(NAMES) is None
    assert cached.fingerprint() == source.fingerprint()


def test_read_returns_read_only_views(case: Case) -> None:
    sample = case.opened().read("b")
    for image in (sample.rgb, sample.thermal, sample.label):
        assert image.flags.c_contiguous
        assert not image.flags.owndata
        assert not image.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            image[0, 0] = 1
    assert sample.rgb.shape == (5, 7, 3)
    crop = sample.rgb[1:3, 2:4]
    assert np.shares_memory(crop, sample.rgb)


def test_read_without_ensure_reads_source(case: Case) -> None:
    cached = CachedDataset(case.source, case.cache, num_threads=1)
    cached.ensure(("a",))
    case.source.decoded.clear()
    cached.read("a")
    assert case.source.decoded == []
    cached.read("b")
    assert case.source.decoded == ["b"]
    cached.ensure(("b", "b"))
    check_equal(cached, case.source, ("a", "b"))


def test_progress_counts_decoded_samples(case: Case) -> None:
    reported: list[tuple[str, int, int]] = []
    cached = CachedDataset(case.source, case.cache, num_threads=2)
    cached.ensure(NAMES, lambda *each: reported.append(each))
    assert reported == [("decoding", n, 4) for n in (1, 2, 3, 4)]
    reported.clear()
    cached.ensure(NAMES, lambda *each: reported.append(each))
    assert reported == []


def test_changed_file_alone_is_decoded_again(case: Case) -> None:
    case.opened()
    write(case.source.root, "b", seed=1)  # as long as it was
    cached = case.opened()
    assert set(case.source.decoded) == {"b"}
    check_equal(cached, case.source)
    assert len(case.files()) == 2
    for name in NAMES:
        write(case.source.root, name, seed=2)
    check_equal(case.opened(), case.source)
    assert len(case.files()) == 1, "files of which nothing is used any more are removed"


def test_change_of_second_file_is_noticed(case: Case) -> None:
    (case.source.root / "a.txt").write_text("x")
    case.opened()
    os.utime(case.source.root / "a.txt", ns=(1, 1))
    (case.source.root / "a.txt").write_text("y")
    case.opened()
    assert set(case.source.decoded) == {"a"}


def test_copy_with_other_times_uses_same_cache(case: Case, tmp_path: Path) -> None:
    case.opened()
    shutil.copytree(case.source.root, tmp_path / "copy", copy_function=shutil.copyfile)
    copy = Arrays(tmp_path / "copy")
    check_equal(case.opened(copy), case.source)
    assert set(copy.decoded) == set(), "equal bytes"


def settle(path: Path, time: int) -> None:
    """Give a file a time of change, at another moment than it was changed before."""
    before = path.stat().st_ctime_ns
    while path.stat().st_ctime_ns == before:  # the clock of a disk ticks in milliseconds
        os.utime(path, ns=(time, time))


def test_equal_lengths_and_times_compare_bytes(case: Case, tmp_path: Path) -> None:
    """Archives and images of containers keep times; a copy of other content is another data set."""
    other = Arrays(tmp_path / "other")
    other.root.mkdir()
    for name in NAMES:
        write(other.root, name, seed=int(name == "b"))
        for root in (case.source.root, other.root):
            os.utime(root / f"{name}.npy", ns=(5, 5))
    assert other.fingerprint() == case.source.fingerprint()
    case.opened()
    cached = case.opened(other)
    assert set(other.decoded) == {"b"}, "equal bytes are not decoded again"
    check_equal(cached, other)
    check_equal(case.opened(), case.source)


def test_change_with_restored_time_is_noticed(case: Case) -> None:
    path = case.source.root / "b.npy"
    os.utime(path, ns=(5, 5))
    case.opened()
    inode = path.stat().st_ino
    write(case.source.root, "b", seed=1)
    settle(path, 5)
    assert (path.stat().st_ino, path.stat().st_mtime_ns) == (inode, 5)
    check_equal(case.opened(), case.source)


def test_unchanged_files_are_not_opened(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    case.opened()

    def refuses(path: Path) -> int:
        raise AssertionError(f"{path} was read")

    monkeypatch.setattr(file_state, "_crc", refuses)
    check_equal(case.opened(), case.source)


def test_new_cache_takes_unchanged_samples_of_old(
    case: Case, caplog: pytest.LogCaptureFixture
) -> None:
    case.opened()
    np.save(case.source.root / "c.npy", np.zeros((2, 2, 5), np.uint8))
    with caplog.at_level(logging.WARNING):
        cached = CachedDataset(case.source, case.cache, num_threads=1)
        reported: list[Any] = []
        cached.ensure(NAMES, lambda *each: reported.append(each))
    assert reported == [("decoding", 1, 1)], "the frame that is another one"
    assert "arrays has changed" in caplog.text
    check_equal(cached, case.source)
    assert len({path.parent for path in case.files()}) == 2, "the old one stays"
    reported.clear()
    CachedDataset(case.source, case.cache, num_threads=1).ensure(
        NAMES, lambda *each: reported.append(each)
    )
    assert reported == [], "neither decoded nor verified once more"


def test_other_length_with_same_time_is_noticed(case: Case) -> None:
    """Not even where its time was kept, as archivers and rsync do."""
    case.opened()
    path = case.source.root / "c.npy"
    time = path.stat().st_mtime_ns
    np.save(path, np.zeros((2, 2, 5), np.uint8))
    os.utime(path, ns=(time, time))
    check_equal(case.opened(), case.source)


def test_other_decoding_settings_have_own_cache(case: Case) -> None:
    case.opened()
    other = Arrays(case.source.root, {"crop": (0, 1)})
    case.opened(other)
    assert set(other.decoded) == set(NAMES)
    assert len(cache_folder.caches_like(case.cache, case.opened()._about())) == 1


class Inverted(Arrays):
    """Another reader of the same files."""

    def read(self, name: str) -> Sample:
        sample = super().read(name)
        return replace(sample, thermal=255 - sample.thermal)


@pytest.mark.parametrize(("kind", "name"), [(Inverted, "arrays"), (Arrays, "others")])
def test_other_class_or_name_has_own_cache(case: Case, kind: type[Arrays], name: str) -> None:
    """Their class and their name tell them apart, where all else is the same."""
    case.opened()
    other = kind(case.source.root)
    other.name = name
    cached = case.opened(other)
    assert set(other.decoded) == set(NAMES)
    check_equal(cached, other)
    assert len(cached.caches()) == 1
    assert len(case.files()) == 2


def test_cache_of_other_root_is_not_adopted(
    case: Case, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Not even one with the same names: images of one folder are never linked to another's."""
    first = case.opened()
    other = Arrays(tmp_path / "other")
    other.root.mkdir()
    for name in NAMES:
        np.save(other.root / f"{name}.npy", np.full((2, 2, 5), ord(name), np.uint8))
    with caplog.at_level(logging.WARNING):
        cached = case.opened(other)
    assert caplog.text == ""
    check_equal(cached, other)
    (mine,), (its,) = cached.caches(), first.caches()
    assert [len(list(cache.glob("*.frames"))) for cache in (mine, its)] == [1, 1]
    assert not {path.name for path in mine.glob("*.frames")} & {
        path.name for path in case.files() if path.parent == its
    }
    cache_folder.remove(mine)
    again = case.opened()
    assert case.source.decoded == [], "what others remove is theirs"
    check_equal(again, case.source)


def test_moved_data_set_keeps_its_cache(case: Case, tmp_path: Path) -> None:
    """And the states of the folder that it lies in now are its own, by whatever path."""
    (cache,) = case.opened().caches()
    case.source.root.rename(tmp_path / "moved")
    moved = Arrays(tmp_path / "moved")
    cached = case.opened(moved)
    assert moved.decoded == []
    assert cached.caches() == [cache]
    (tmp_path / "link").symlink_to(tmp_path / "moved")
    np.save(moved.root / "c.npy", np.zeros((2, 2, 5), np.uint8))
    (changed,) = case.opened(moved).caches()
    assert changed != cache, "that was begun in another folder"
    write(moved.root, "c", seed=3)
    np.save(moved.root / "d.npy", np.zeros((1, 1, 5), np.uint8))
    linked = case.opened(Arrays(tmp_path / "link"))
    assert changed in linked.caches()
    assert len(linked.caches()) == 2


def flip(path: Path, offset: int) -> None:
    content = bytearray(path.read_bytes())
    content[offset] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("image", ["rgb", "thermal", "label"])
def test_damaged_sample_is_decoded_again(case: Case, image: str) -> None:
    case.opened()
    (path,) = case.files()
    (record,) = [f for f in sample_file.SampleFile(path).records() if f.name == "b"]
    within = {"rgb": 0, "thermal": 3 * 35, "label": 5 * 35 - 1}[image]
    flip(path, record.offset + within)
    reported: list[tuple[str, int, int]] = []
    CachedDataset(case.source, case.cache, num_threads=2).ensure(
        ("a",), lambda *each: reported.append(each)
    )
    assert reported == [("comparing checksums", n, 4) for n in (1, 2, 3, 4)]
    reported.clear()
    case.source.decoded.clear()
    cached = CachedDataset(case.source, case.cache, num_threads=2)
    cached.ensure(NAMES, lambda *each: reported.append(each))
    assert reported == [("decoding", 1, 1)], "noted: not compared twice, and not served"
    assert set(case.source.decoded) == {"b"}
    check_equal(cached, case.source)


def test_checksums_are_compared_once(case: Case) -> None:
    case.opened()
    (path,) = case.files()
    reported: list[tuple[str, int, int]] = []

    def open_again() -> int:
        reported.clear()
        CachedDataset(case.source, case.cache, num_threads=1).ensure(
            NAMES, lambda *each: reported.append(each)
        )
        return len(reported)

    assert open_again() == 0
    os.utime(path, ns=(1, 1))
    assert open_again() == 4
    assert open_again() == 0
    (path.parent / cache_folder.VERIFIED).write_text("{damaged")
    assert open_again() == 4
    assert open_again() == 0


@pytest.mark.parametrize("damage", ["cut", "index", "end", "empty"])
def test_incomplete_file_is_written_again(case: Case, damage: str) -> None:
    case.opened()
    (path,) = case.files()
    content = path.read_bytes()
    if damage in ("cut", "empty"):
        path.write_bytes(content[: len(content) // 2 if damage == "cut" else 0])
    else:
        flip(path, len(content) - (40 if damage == "index" else 3))
    check_equal(case.opened(), case.source)
    assert path not in case.files()


class Stop(BaseException):
    """Simulates a kill: the code under test does not catch it."""


@pytest.mark.parametrize("step", ["open", "first", "third", "index", "sync", "rename", "note"])
def test_process_killed_at_any_step_leaves_valid_cache(
    case: Case, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """It leaves no file that looks complete, and the next process completes the cache."""
    calls = 0

    def stops(*args: Any, **kwargs: Any) -> Any:
        raise Stop

    def at_third(writer: Any, *args: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == (1 if step == "first" else 3):
            raise Stop
        add(writer, *args)

    add = sample_file.SampleFileWriter.add
    with monkeypatch.context() as patch:
        if step == "open":
            patch.setattr(sample_file.SampleFileWriter, "__init__", stops)
        elif step in ("first", "third"):
            patch.setattr(sample_file.SampleFileWriter, "add", at_third)
        elif step == "index":
            patch.setattr(sample_file.zlib, "crc32", _fails_for_bytes)
        elif step == "sync":
            patch.setattr(sample_file.os, "fsync", _only_in("publish"))
        elif step == "rename":
            patch.setattr(Path, "replace", _only_in("publish"))
        else:
            patch.setattr(cache_folder.CacheFolder, "_write_notes", stops)
        patch.setattr(sample_file.SampleFileWriter, "discard", lambda writer: None)
        with pytest.raises(Stop):
            case.opened()
    assert len(case.files()) == (1 if step == "note" else 0)
    check_equal(case.opened(), case.source)
    assert list(case.cache.glob("*/.*")) == [], "files of the killed process are removed"


def _fails_for_bytes(data: Any, *start: int) -> int:
    if isinstance(data, bytes):  # the index; frames come as arrays
        raise Stop
    return _CRC32(data, *start)


_CRC32 = sample_file.zlib.crc32


def _only_in(function: str) -> Any:
    """Raises if `function` calls it, and otherwise calls the original."""
    real = {"fsync": os.fsync, "replace": Path.replace}

    def call(*args: Any) -> Any:
        if sys._getframe(1).f_code.co_name == function:
            raise Stop
        return real["fsync" if isinstance(args[0], int) else "replace"](*args)

    return call


def test_complete_files_survive_an_exception(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache_folder, "FILE_BYTES", 1)  # one file per sample
    add = sample_file.SampleFileWriter.add

    def stops_at_c(writer: Any, sample: Sample, *rest: Any) -> None:
        if sample.name == "c":
            raise Stop
        add(writer, sample, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(sample_file.SampleFileWriter, "add", stops_at_c)
        with pytest.raises(Stop):
            case.opened()
    assert len(case.files()) == 2
    check_equal(case.opened(), case.source)
    assert set(case.source.decoded) >= {"c", "d"}
    assert {"a", "b"}.isdisjoint(case.source.decoded[:-4]), "read by check_equal alone"


def test_two_processes_decode_once(case: Case) -> None:
    barrier = threading.Barrier(2)

    def build(source: Arrays) -> CachedDataset:
        cached = CachedDataset(source, case.cache, num_threads=1)
        barrier.wait()
        cached.ensure(NAMES)
        return cached

    sources = [Arrays(case.source.root), Arrays(case.source.root)]
    with ThreadPoolExecutor(2) as pool:
        built = list(pool.map(build, sources))
    assert len(case.files()) == 1
    for cached in built:
        check_equal(cached, cached.source)


def test_two_processes_without_locks_keep_cache_valid(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*args: Any) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(cache_folder.fcntl, "flock", no_locks)
    first = CachedDataset(case.source, case.cache, num_threads=1)
    second = CachedDataset(Arrays(case.source.root), case.cache, num_threads=1)
    build = cache_folder.CacheFolder.add

    def add_after_another(cache: Any, samples: Iterator[Any]) -> None:
        monkeypatch.setattr(cache_folder.CacheFolder, "add", build)
        second.ensure(NAMES)
        build(cache, samples)

    monkeypatch.setattr(cache_folder.CacheFolder, "add", add_after_another)
    first.ensure(NAMES)
    assert len(case.files()) == 2
    check_equal(first, case.source)
    check_equal(second, second.source)


def test_too_small_disk_is_refused_before_writing(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage("/")._replace(free=479)
    monkeypatch.setattr(cache_folder.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(InputError) as caught:
        case.opened()
    # The first frame has 4 x 6 pixels of 5 bytes; four times 120 bytes.
    assert "need about 0.0 MB" in str(caught.value)
    assert str(case.cache) in str(caught.value)
    assert case.files() == []
    usage = usage._replace(free=480)
    check_equal(case.opened(), case.source)


@pytest.mark.parametrize("number", [28, 122])
def test_full_disk_is_refused(case: Case, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def full(writer: Any) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(sample_file.SampleFileWriter, "publish", full)
        with pytest.raises(InputError, match=r"is full .*data\.cache=null"):
            case.opened()
    assert [path.name for path in case.cache.glob("*/.*")] == []
    check_equal(case.opened(), case.source)


def test_unwritable_folder_is_refused(case: Case) -> None:
    case.cache.write_text("a file")
    with pytest.raises(InputError, match=r"data\.cache: cannot write .*data\.cache=FOLDER"):
        case.opened()


def test_complete_cache_is_not_written_to(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """So it may be in a read-only folder, even if a sample is damaged."""
    (case.source.root / "c.npy").write_bytes(b"none")
    case.opened()

    def refuses(*args: Any, **kwargs: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuses)
    monkeypatch.setattr(cache_folder, "_write_whole", refuses)
    os.utime(case.files()[0], ns=(1, 1))  # compares the checksums, cannot record the result
    check_equal(case.opened(), case.source, ("a", "b", "d"))


def test_unreadable_file_raises_message_of_data_set(case: Case) -> None:
    path = case.source.root / "c.npy"
    content = path.read_bytes()
    path.write_bytes(b"none")
    cached = case.opened()
    check_equal(cached, case.source, ("a", "b", "d"))
    case.source.decoded.clear()
    for _ in range(2):
        with pytest.raises(InputError, match=r"c\.npy is no array\."):
            cached.read("c")
    assert case.source.decoded == [], "known without reading again"
    path.write_bytes(content)
    cached.ensure(("c",))
    check_equal(cached, case.source)
    check_equal(case.opened(), case.source)


def test_file_that_became_unreadable_is_refused(case: Case) -> None:
    case.opened()
    path = case.source.root / "c.npy"
    path.write_bytes(b"x" * path.stat().st_size)  # the same cache
    cached = case.opened()
    with pytest.raises(InputError, match="no array"):
        cached.read("c")
    check_equal(cached, case.source, ("a", "b", "d"))


def test_system_error_is_reported(case: Case) -> None:
    class Faulty(Arrays):
        def read(self, name: str) -> Sample:
            if name == "b":
                raise PermissionError(13, "Permission denied", "b.npy")
            return super().read(name)

    cached = case.opened(Faulty(case.source.root))
    with pytest.raises(InputError, match=r"b\.npy: Permission denied\."):
        cached.read("b")
    check_equal(cached, case.source, ("a", "c", "d"))


OTHER_IMAGES = {
    "half a label": (lambda s: replace(s, label=s.label[:2]), r"label must be .* \(2, 7\)"),
    "a wide label": (lambda s: replace(s, label=s.label.astype(np.int64)), "label must .* int64"),
    "counts": (lambda s: replace(s, thermal=s.thermal.astype(np.uint16)), "thermal must .* uint16"),
    "channels": (lambda s: replace(s, thermal=s.rgb), r"thermal must be .* \(5, 7, 3\)"),
    "grey": (lambda s: replace(s, rgb=s.rgb[..., 0]), r"rgb must be .* \(5, 7, 3\), .* \(5, 7\)"),
    "floats": (lambda s: replace(s, rgb=s.rgb / np.float32(255)), "rgb must be .* float32"),
}


@pytest.mark.parametrize("change", OTHER_IMAGES)
def test_unsupported_sample_is_refused_and_others_kept(case: Case, change: str) -> None:
    """A user's data set may return other arrays; later samples must keep their offsets."""
    changed, sentence = OTHER_IMAGES[change]

    class Own(Arrays):
        def read(self, name: str) -> Sample:
            sample = super().read(name)
            return changed(sample) if name == "b" else sample

    source = Own(case.source.root)
    cached = case.opened(source)
    with pytest.raises(InputError, match=rf"^'b': {sentence}.* \(data\.cache=null\)\.$"):
        cached.read("b")
    check_equal(cached, source, ("a", "c", "d"))
    check_equal(case.opened(source), source, ("a", "c", "d"))


@pytest.mark.parametrize("begun", [False, True])
def test_names_without_files_are_skipped_as_without_cache(tmp_path: Path, begun: bool) -> None:
    """data.on_error=skip: PST900 refuses a name of both parts, and says so for its files too."""
    before = PST900(str(write_pst900(tmp_path / "data")))
    if begun:  # the frame is in the cache that the next one begins with
        CachedDataset(before, tmp_path / "cache", num_threads=1).ensure(before.names("train"))
    source = PST900(str(write_pst900(tmp_path / "data", (), (TRAIN[0],))))
    cached = CachedDataset(source, tmp_path / "cache", num_threads=2)
    names = source.names("train")
    cached.ensure(names)
    found: list[dict[str, str]] = []
    for dataset in (source, cached):
        skipped: dict[str, str] = {}
        reader = SplitReader(dataset, names, None, skip_errors=True)  # type: ignore[arg-type]
        read = [reader.read(name, skipped) for name in names]
        assert [sample.name for sample in read if sample] == [n for n in names if n != TRAIN[0]]
        found.append(skipped)
    assert list(found[0]) == [TRAIN[0]]
    assert found[0] == found[1]
    check_equal(cached, source, tuple(name for name in names if name != TRAIN[0]))


def test_no_cache_is_written_without_readable_sample(case: Case) -> None:
    for name in NAMES:
        (case.source.root / f"{name}.npy").unlink()
    cached = case.opened()
    assert not case.cache.exists()
    with pytest.raises(InputError, match="no array"):
        cached.read("a")


def test_pickle_does_not_contain_map(case: Case) -> None:
    cached = case.opened()
    (case.source.root / "c.npy").write_bytes(b"none")
    cached.ensure(("c",))
    text = pickle.dumps(cached)
    assert len(text) < 4000
    copy = pickle.loads(text)
    check_equal(copy, copy.source, ("a", "b", "d"))
    with pytest.raises(InputError, match="no array"):
        copy.read("c")


def test_removed_cache_does_not_stop_worker(case: Case) -> None:
    cached = case.opened()
    late = pickle.loads(pickle.dumps(cached))
    for cache in cached.caches():
        cache_folder.remove(cache)
    assert list(case.cache.iterdir()) == []
    check_equal(cached, case.source)  # the map is still there
    np.testing.assert_array_equal(late.read("a").rgb, case.source.read("a").rgb)


def test_remove_keeps_foreign_files(case: Case) -> None:
    cached = case.opened()
    (cache,) = cached.caches()
    (cache / "notes.txt").write_text("mine")
    cache_folder.remove(cache)
    assert [path.name for path in cache.iterdir()] == ["notes.txt"]


def test_cached_dataset_chooses_folder(
    case: Case, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert default_folder() == tmp_path / "xdg" / "rgbt" / "decoded"
    source = case.source
    assert cached_dataset(source, None, num_threads=1) is source
    found = cached_dataset(source, "auto", num_threads=1)
    assert isinstance(found, CachedDataset)
    assert found.folder == default_folder()
    named = cached_dataset(source, str(tmp_path / "own"), num_threads=1)
    assert isinstance(named, CachedDataset)
    assert named.folder == tmp_path / "own"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert default_folder() == tmp_path / "home" / ".cache" / "rgbt" / "decoded"


def test_command_fills_and_removes_cache(
    case: Case, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rgbt.data.cache.__main__.built", lambda node, overrides: case.source)
    cache = f"cache={case.cache}"
    assert entry.run([cache]) == 0
    size = sum(path.stat().st_size for path in case.cache.glob("arrays-*/*"))
    assert capsys.readouterr().out.endswith(f": {size / 1e6:.1f} MB\n")
    assert entry.run([cache, "remove=true"]) == 0
    assert capsys.readouterr().out.endswith(" MB removed\n")
    assert list(case.cache.iterdir()) == []
    with pytest.raises(InputError, match="'remove' must be true or false"):
        entry.run([cache, "remove=maybe"])
    with pytest.raises(InputError, match=r"^cache: 'null' is not a folder; expected auto or a"):
        entry.run(["cache=null"])


def test_cached_real_pairs_equal_source(tmp_path: Path) -> None:
    shared = Path(os.environ.get("RGBT_SHARED", Path(__file__).parents[3] / "shared"))
    root = shared / "realdata" / "mfnet200"
    if not root.is_dir():
        pytest.skip("real images are not part of the repository")
    source = MFNet(str(root))
    names = source.names("train")[:3]
    cached = CachedDataset(source, tmp_path, num_threads=2)
    cached.ensure(names)
    check_equal(cached, source, names)
    packed = cv2.imread(str(root / "images" / f"{names[0]}.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(cached.read(names[0]).rgb, packed[..., 2::-1])


def test_former_command_warns_and_works() -> None:
    command = [sys.executable, "-m", "rgbt.data.decoded", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "into the image cache" in done.stdout
    assert "use python -m rgbt.data.cache" in done.stderr


def test_folder_and_file_names_are_those_of_existing_caches(case: Case) -> None:
    """Caches that exist must remain valid."""
    about = {"format": 2, "name": "a b", "class": "rgbt.data.mfnet.MFNet", "root": "/x"}
    assert _cache_name({**about, "decoding": {}, "fingerprint": "0"}) == "a_b-867e0a9462b65d63"
    case.opened()
    kinds = {path.name.partition("-")[2][8:] or path.name for path in case.cache.glob("*/*")}
    assert kinds == {".frames", "about.json", "verified.json", "lock"}


def test_command_refuses_setting_without_effect(case: Case) -> None:
    with pytest.raises(InputError, match=r"'data\.cache' has no effect here; did you mean 'cache'"):
        entry.run([f"cache={case.cache}", "dataset=synth", "data.cache=/x"])
