from __future__ import annotations

import hashlib
import logging
import os
import pickle
import shutil
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
from rgbt.data.cache import file as decoded_file
from rgbt.data.cache import stamps as decoded_stamps
from rgbt.data.cache import store as decoded_store
from rgbt.data.cache.__main__ import entry
from rgbt.data.cache.dataset import Decoded, decoded_dataset, default_folder
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import PST900
from rgbt.data.reader import Source
from rgbt.types import Sample
from tests.data.pst900_files import TRAIN, write_pst900

NAMES = ("a", "b", "c", "d")
SIZES = {"a": (4, 6), "b": (5, 7), "c": (4, 6), "d": (3, 3)}


class Arrays:
    """Frames as .npy: channels R, G, B, thermal and, but for "d", label. Counts what it decodes."""

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

    def opened(self, source: Arrays | None = None) -> Decoded:
        """A new one, as another process would make it, with `NAMES` ensured."""
        self.source.decoded.clear()
        decoded = Decoded(source or self.source, self.cache, num_threads=2)
        decoded.ensure(NAMES)
        return decoded

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


def check_equal(found: Decoded, source: Any, names: tuple[str, ...] = NAMES) -> None:
    """Bit for bit what the source says, and served without asking it."""
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


def test_returns_what_the_source_does_and_decodes_once(case: Case) -> None:
    decoded = case.opened()
    assert sorted(set(case.source.decoded)) == list(NAMES)
    check_equal(decoded, case.source)
    assert decoded.label("d") is None
    again = case.opened()
    assert case.source.decoded == []
    check_equal(again, case.source)


@pytest.mark.parametrize("layout", ["packed", "folders"])
def test_mfnet_bit_for_bit(write_mfnet, tmp_path: Path, layout: str) -> None:
    names = ("00001D", "00002N")
    source = MFNet(str(write_mfnet({"train": list(names)}, layout=layout)))
    decoded = Decoded(source, tmp_path / "cache", num_threads=1)
    decoded.ensure(source.names("train"))
    check_equal(decoded, source, names)


def test_is_the_data_set_otherwise(case: Case) -> None:
    decoded, source = case.opened(), case.source
    assert decoded.source is source
    for key in ("root", "name", "num_classes", "classes", "palette", "unscored", "splits"):
        assert getattr(decoded, key) == getattr(source, key)
    assert decoded.names("train") == NAMES
    assert decoded.has("train")
    assert decoded.files("a") == source.files("a")
    assert decoded.decoding() == {}
    assert decoded.nights(NAMES) is None
    assert decoded.fingerprint() == source.fingerprint()


def test_views_of_the_map_that_nobody_can_write(case: Case) -> None:
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


def test_what_was_not_ensured_is_read_from_the_source(case: Case) -> None:
    decoded = Decoded(case.source, case.cache, num_threads=1)
    decoded.ensure(("a",))
    case.source.decoded.clear()
    decoded.read("a")
    assert case.source.decoded == []
    decoded.read("b")
    assert case.source.decoded == ["b"]
    decoded.ensure(("b", "b"))
    check_equal(decoded, case.source, ("a", "b"))


def test_progress_counts_what_is_decoded(case: Case) -> None:
    told: list[tuple[str, int, int]] = []
    decoded = Decoded(case.source, case.cache, num_threads=2)
    decoded.ensure(NAMES, lambda *each: told.append(each))
    assert told == [("decoding", n, 4) for n in (1, 2, 3, 4)]
    told.clear()
    decoded.ensure(NAMES, lambda *each: told.append(each))
    assert told == []


def test_a_changed_file_is_decoded_again_and_no_other(case: Case) -> None:
    case.opened()
    write(case.source.root, "b", seed=1)  # as long as it was
    decoded = case.opened()
    assert set(case.source.decoded) == {"b"}
    check_equal(decoded, case.source)
    assert len(case.files()) == 2
    for name in NAMES:
        write(case.source.root, name, seed=2)
    check_equal(case.opened(), case.source)
    assert len(case.files()) == 1, "files of which nothing is used any more are removed"


def test_every_file_of_a_frame_counts(case: Case) -> None:
    (case.source.root / "a.txt").write_text("x")
    case.opened()
    os.utime(case.source.root / "a.txt", ns=(1, 1))
    (case.source.root / "a.txt").write_text("y")
    case.opened()
    assert set(case.source.decoded) == {"a"}


def test_a_copy_with_other_times_finds_the_cache(case: Case, tmp_path: Path) -> None:
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


def test_equal_lengths_and_times_are_not_equal_files(case: Case, tmp_path: Path) -> None:
    """Archives and images of containers keep times; a copy of other content is another data set."""
    other = Arrays(tmp_path / "other")
    other.root.mkdir()
    for name in NAMES:
        write(other.root, name, seed=int(name == "b"))
        for root in (case.source.root, other.root):
            os.utime(root / f"{name}.npy", ns=(5, 5))
    assert other.fingerprint() == case.source.fingerprint()
    case.opened()
    decoded = case.opened(other)
    assert set(other.decoded) == {"b"}, "equal bytes are not decoded again"
    check_equal(decoded, other)
    check_equal(case.opened(), case.source)


def test_a_file_that_was_changed_in_place_and_given_its_time_back(case: Case) -> None:
    path = case.source.root / "b.npy"
    os.utime(path, ns=(5, 5))
    case.opened()
    inode = path.stat().st_ino
    write(case.source.root, "b", seed=1)
    settle(path, 5)
    assert (path.stat().st_ino, path.stat().st_mtime_ns) == (inode, 5)
    check_equal(case.opened(), case.source)


def test_files_that_are_as_they_were_are_not_opened(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    case.opened()

    def refuses(path: Path) -> int:
        raise AssertionError(f"{path} was read")

    monkeypatch.setattr(decoded_stamps, "_crc", refuses)
    check_equal(case.opened(), case.source)


def test_other_lengths_make_another_cache_that_takes_what_is_the_same(
    case: Case, caplog: pytest.LogCaptureFixture
) -> None:
    case.opened()
    np.save(case.source.root / "c.npy", np.zeros((2, 2, 5), np.uint8))
    with caplog.at_level(logging.WARNING):
        decoded = Decoded(case.source, case.cache, num_threads=1)
        told: list[Any] = []
        decoded.ensure(NAMES, lambda *each: told.append(each))
    assert told == [("decoding", 1, 1)], "the frame that is another one"
    assert "arrays has changed" in caplog.text
    check_equal(decoded, case.source)
    assert len({path.parent for path in case.files()}) == 2, "the old one stays"
    told.clear()
    Decoded(case.source, case.cache, num_threads=1).ensure(NAMES, lambda *each: told.append(each))
    assert told == [], "neither decoded nor verified once more"


def test_a_file_of_another_length_is_never_the_same(case: Case) -> None:
    """Not even where its time was kept, as archivers and rsync do."""
    case.opened()
    path = case.source.root / "c.npy"
    time = path.stat().st_mtime_ns
    np.save(path, np.zeros((2, 2, 5), np.uint8))
    os.utime(path, ns=(time, time))
    check_equal(case.opened(), case.source)


def test_other_settings_share_nothing(case: Case) -> None:
    case.opened()
    other = Arrays(case.source.root, {"crop": (0, 1)})
    case.opened(other)
    assert set(other.decoded) == set(NAMES)
    assert len(decoded_store.stores_like(case.cache, case.opened()._about())) == 1


class Inverted(Arrays):
    """Another reader of the same files."""

    def read(self, name: str) -> Sample:
        sample = super().read(name)
        return replace(sample, thermal=255 - sample.thermal)


@pytest.mark.parametrize(("kind", "name"), [(Inverted, "arrays"), (Arrays, "others")])
def test_readers_share_nothing(case: Case, kind: type[Arrays], name: str) -> None:
    """Their class and their name tell them apart, where all else is the same."""
    case.opened()
    other = kind(case.source.root)
    other.name = name
    decoded = case.opened(other)
    assert set(other.decoded) == set(NAMES)
    check_equal(decoded, other)
    assert len(decoded.caches()) == 1
    assert len(case.files()) == 2


def test_another_data_set_is_no_earlier_state(
    case: Case, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Not even one with the same names: images of one folder are never linked to another's."""
    first = case.opened()
    other = Arrays(tmp_path / "other")
    other.root.mkdir()
    for name in NAMES:
        np.save(other.root / f"{name}.npy", np.full((2, 2, 5), ord(name), np.uint8))
    with caplog.at_level(logging.WARNING):
        decoded = case.opened(other)
    assert caplog.text == ""
    check_equal(decoded, other)
    (mine,), (its,) = decoded.caches(), first.caches()
    assert [len(list(cache.glob("*.frames"))) for cache in (mine, its)] == [1, 1]
    assert not {path.name for path in mine.glob("*.frames")} & {
        path.name for path in case.files() if path.parent == its
    }
    decoded_store.remove(mine)
    again = case.opened()
    assert case.source.decoded == [], "what others remove is theirs"
    check_equal(again, case.source)


def test_a_data_set_that_moved_keeps_its_cache(case: Case, tmp_path: Path) -> None:
    """And the states of the folder that it lies in now are its own, by whatever path."""
    (cache,) = case.opened().caches()
    case.source.root.rename(tmp_path / "moved")
    moved = Arrays(tmp_path / "moved")
    decoded = case.opened(moved)
    assert moved.decoded == []
    assert decoded.caches() == [cache]
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
def test_a_damaged_frame_is_decoded_again(case: Case, image: str) -> None:
    case.opened()
    (path,) = case.files()
    (frame,) = [f for f in decoded_file.FrameFile(path).frames() if f.name == "b"]
    within = {"rgb": 0, "thermal": 3 * 35, "label": 5 * 35 - 1}[image]
    flip(path, frame.offset + within)
    told: list[tuple[str, int, int]] = []
    Decoded(case.source, case.cache, num_threads=2).ensure(("a",), lambda *each: told.append(each))
    assert told == [("comparing checksums", n, 4) for n in (1, 2, 3, 4)]
    told.clear()
    case.source.decoded.clear()
    decoded = Decoded(case.source, case.cache, num_threads=2)
    decoded.ensure(NAMES, lambda *each: told.append(each))
    assert told == [("decoding", 1, 1)], "noted: not compared twice, and not served"
    assert set(case.source.decoded) == {"b"}
    check_equal(decoded, case.source)


def test_checksums_are_compared_once(case: Case) -> None:
    case.opened()
    (path,) = case.files()
    told: list[tuple[str, int, int]] = []

    def open_again() -> int:
        told.clear()
        Decoded(case.source, case.cache, num_threads=1).ensure(
            NAMES, lambda *each: told.append(each)
        )
        return len(told)

    assert open_again() == 0
    os.utime(path, ns=(1, 1))
    assert open_again() == 4
    assert open_again() == 0
    (path.parent / decoded_store.VERIFIED).write_text("{damaged")
    assert open_again() == 4
    assert open_again() == 0


@pytest.mark.parametrize("damage", ["cut", "index", "end", "empty"])
def test_a_file_that_is_not_whole_is_written_again(case: Case, damage: str) -> None:
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
    """Stands for a kill: no handler of the code under test catches it."""


@pytest.mark.parametrize("step", ["open", "first", "third", "index", "sync", "rename", "note"])
def test_killed_at_any_step(case: Case, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    """A build that ends anywhere leaves nothing that looks whole, and the next one goes on."""
    calls = 0

    def stops(*args: Any, **kwargs: Any) -> Any:
        raise Stop

    def at_third(writer: Any, *args: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == (1 if step == "first" else 3):
            raise Stop
        add(writer, *args)

    add = decoded_file.FrameWriter.add
    with monkeypatch.context() as patch:
        if step == "open":
            patch.setattr(decoded_file.FrameWriter, "__init__", stops)
        elif step in ("first", "third"):
            patch.setattr(decoded_file.FrameWriter, "add", at_third)
        elif step == "index":
            patch.setattr(decoded_file.zlib, "crc32", _fails_for_bytes)
        elif step == "sync":
            patch.setattr(decoded_file.os, "fsync", _only_in("publish"))
        elif step == "rename":
            patch.setattr(Path, "replace", _only_in("publish"))
        else:
            patch.setattr(decoded_store.Store, "_write_notes", stops)
        patch.setattr(decoded_file.FrameWriter, "discard", lambda writer: None)
        with pytest.raises(Stop):
            case.opened()
    assert len(case.files()) == (1 if step == "note" else 0)
    check_equal(case.opened(), case.source)
    assert list(case.cache.glob("*/.*")) == [], "what the killed one left is cleared away"


def _fails_for_bytes(data: Any, *start: int) -> int:
    if isinstance(data, bytes):  # the index; frames come as arrays
        raise Stop
    return _CRC32(data, *start)


_CRC32 = decoded_file.zlib.crc32


def _only_in(function: str) -> Any:
    """Raises where `function` calls it, and otherwise does what it did."""
    import sys

    real = {"fsync": os.fsync, "replace": Path.replace}

    def call(*args: Any) -> Any:
        if sys._getframe(1).f_code.co_name == function:
            raise Stop
        return real["fsync" if isinstance(args[0], int) else "replace"](*args)

    return call


def test_what_was_complete_before_the_end_stays(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decoded_store, "FILE_BYTES", 1)  # a file for every frame
    add = decoded_file.FrameWriter.add

    def stops_at_c(writer: Any, sample: Sample, *rest: Any) -> None:
        if sample.name == "c":
            raise Stop
        add(writer, sample, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(decoded_file.FrameWriter, "add", stops_at_c)
        with pytest.raises(Stop):
            case.opened()
    assert len(case.files()) == 2
    check_equal(case.opened(), case.source)
    assert set(case.source.decoded) >= {"c", "d"}
    assert {"a", "b"}.isdisjoint(case.source.decoded[:-4]), "read by check_equal alone"


def test_two_builders_do_the_work_once(case: Case) -> None:
    barrier = threading.Barrier(2)

    def build(source: Arrays) -> Decoded:
        decoded = Decoded(source, case.cache, num_threads=1)
        barrier.wait()
        decoded.ensure(NAMES)
        return decoded

    sources = [Arrays(case.source.root), Arrays(case.source.root)]
    with ThreadPoolExecutor(2) as pool:
        built = list(pool.map(build, sources))
    assert len(case.files()) == 1
    for decoded in built:
        check_equal(decoded, decoded.source)


def test_two_builders_without_locks_do_no_harm(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*args: Any) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(decoded_store.fcntl, "flock", no_locks)
    first = Decoded(case.source, case.cache, num_threads=1)
    second = Decoded(Arrays(case.source.root), case.cache, num_threads=1)
    build = decoded_store.Store.add

    def add_after_another(store: Any, frames: Iterator[Any]) -> None:
        monkeypatch.setattr(decoded_store.Store, "add", build)
        second.ensure(NAMES)
        build(store, frames)

    monkeypatch.setattr(decoded_store.Store, "add", add_after_another)
    first.ensure(NAMES)
    assert len(case.files()) == 2
    check_equal(first, case.source)
    check_equal(second, second.source)


def test_a_disk_that_is_too_small_is_told_before_anything_is_written(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage("/")._replace(free=479)
    monkeypatch.setattr(decoded_store.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(InputError) as caught:
        case.opened()
    # The first frame has 4 x 6 pixels of 5 bytes; four times 120 bytes.
    assert "need about 0.0 MB" in str(caught.value)
    assert str(case.cache) in str(caught.value)
    assert case.files() == []
    usage = usage._replace(free=480)
    check_equal(case.opened(), case.source)


@pytest.mark.parametrize("number", [28, 122])
def test_a_disk_that_fills_up(case: Case, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def full(writer: Any) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(decoded_file.FrameWriter, "publish", full)
        with pytest.raises(InputError, match=r"filled up .*data\.cache=null"):
            case.opened()
    assert [path.name for path in case.cache.glob("*/.*")] == []
    check_equal(case.opened(), case.source)


def test_a_folder_that_cannot_be_written(case: Case) -> None:
    case.cache.write_text("a file")
    with pytest.raises(InputError, match=r"data\.cache: cannot write .*data\.cache=FOLDER"):
        case.opened()


def test_a_whole_cache_is_not_written_to(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """So it may lie where it can only be read; a frame that is damaged makes no difference."""
    (case.source.root / "c.npy").write_bytes(b"none")
    case.opened()

    def refuses(*args: Any, **kwargs: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuses)
    monkeypatch.setattr(decoded_store, "_write_whole", refuses)
    os.utime(case.files()[0], ns=(1, 1))  # compares the checksums, and cannot note it
    check_equal(case.opened(), case.source, ("a", "b", "d"))


def test_an_unreadable_file_speaks_for_itself(case: Case) -> None:
    path = case.source.root / "c.npy"
    content = path.read_bytes()
    path.write_bytes(b"none")
    decoded = case.opened()
    check_equal(decoded, case.source, ("a", "b", "d"))
    case.source.decoded.clear()
    for _ in range(2):
        with pytest.raises(InputError, match=r"c\.npy is no array\."):
            decoded.read("c")
    assert case.source.decoded == [], "known, without another look"
    path.write_bytes(content)
    decoded.ensure(("c",))
    check_equal(decoded, case.source)
    check_equal(case.opened(), case.source)


def test_a_frame_that_became_unreadable_is_not_served(case: Case) -> None:
    case.opened()
    path = case.source.root / "c.npy"
    path.write_bytes(b"x" * path.stat().st_size)  # the same cache
    decoded = case.opened()
    with pytest.raises(InputError, match="no array"):
        decoded.read("c")
    check_equal(decoded, case.source, ("a", "b", "d"))


def test_trouble_of_the_system_is_told_as_well(case: Case) -> None:
    class Faulty(Arrays):
        def read(self, name: str) -> Sample:
            if name == "b":
                raise PermissionError(13, "Permission denied", "b.npy")
            return super().read(name)

    decoded = case.opened(Faulty(case.source.root))
    with pytest.raises(InputError, match=r"b\.npy: Permission denied\."):
        decoded.read("b")
    check_equal(decoded, case.source, ("a", "c", "d"))


OTHER_IMAGES = {
    "half a label": (lambda s: replace(s, label=s.label[:2]), r"label must be .* \(2, 7\)"),
    "a wide label": (lambda s: replace(s, label=s.label.astype(np.int64)), "label must .* int64"),
    "counts": (lambda s: replace(s, thermal=s.thermal.astype(np.uint16)), "thermal must .* uint16"),
    "channels": (lambda s: replace(s, thermal=s.rgb), r"thermal must be .* \(5, 7, 3\)"),
    "grey": (lambda s: replace(s, rgb=s.rgb[..., 0]), r"rgb must be .* \(5, 7, 3\), .* \(5, 7\)"),
    "floats": (lambda s: replace(s, rgb=s.rgb / np.float32(255)), "rgb must be .* float32"),
}


@pytest.mark.parametrize("change", OTHER_IMAGES)
def test_what_it_cannot_hold_is_refused_and_moves_nothing_else(case: Case, change: str) -> None:
    """Readers of one's own may make other arrays; frames after them must stay where they are."""
    changed, sentence = OTHER_IMAGES[change]

    class Own(Arrays):
        def read(self, name: str) -> Sample:
            sample = super().read(name)
            return changed(sample) if name == "b" else sample

    source = Own(case.source.root)
    decoded = case.opened(source)
    with pytest.raises(InputError, match=rf"^'b': {sentence}.* \(data\.cache=null\)\.$"):
        decoded.read("b")
    check_equal(decoded, source, ("a", "c", "d"))
    check_equal(case.opened(source), source, ("a", "c", "d"))


@pytest.mark.parametrize("begun", [False, True])
def test_names_without_files_are_left_out_as_without_a_cache(tmp_path: Path, begun: bool) -> None:
    """data.on_error=skip: PST900 refuses a name of both parts, and says so for its files too."""
    before = PST900(str(write_pst900(tmp_path / "data")))
    if begun:  # the frame is in the cache that the next one begins with
        Decoded(before, tmp_path / "cache", num_threads=1).ensure(before.names("train"))
    source = PST900(str(write_pst900(tmp_path / "data", (), (TRAIN[0],))))
    decoded = Decoded(source, tmp_path / "cache", num_threads=2)
    names = source.names("train")
    decoded.ensure(names)
    found: list[dict[str, str]] = []
    for dataset in (source, decoded):
        skipped: dict[str, str] = {}
        reader = Source(dataset, names, None, skip_errors=True)  # type: ignore[arg-type]
        read = [reader.read(name, skipped) for name in names]
        assert [sample.name for sample in read if sample] == [n for n in names if n != TRAIN[0]]
        found.append(skipped)
    assert list(found[0]) == [TRAIN[0]]
    assert found[0] == found[1]
    check_equal(decoded, source, tuple(name for name in names if name != TRAIN[0]))


def test_nothing_can_be_decoded(case: Case) -> None:
    for name in NAMES:
        (case.source.root / f"{name}.npy").unlink()
    decoded = case.opened()
    assert not case.cache.exists()
    with pytest.raises(InputError, match="no array"):
        decoded.read("a")


def test_travels_to_workers_without_its_map(case: Case) -> None:
    decoded = case.opened()
    (case.source.root / "c.npy").write_bytes(b"none")
    decoded.ensure(("c",))
    text = pickle.dumps(decoded)
    assert len(text) < 4000
    copy = pickle.loads(text)
    check_equal(copy, copy.source, ("a", "b", "d"))
    with pytest.raises(InputError, match="no array"):
        copy.read("c")


def test_a_cache_that_was_removed_does_not_stop_a_worker(case: Case) -> None:
    decoded = case.opened()
    late = pickle.loads(pickle.dumps(decoded))
    for cache in decoded.caches():
        decoded_store.remove(cache)
    assert list(case.cache.iterdir()) == []
    check_equal(decoded, case.source)  # the map is still there
    np.testing.assert_array_equal(late.read("a").rgb, case.source.read("a").rgb)


def test_removes_nothing_of_others(case: Case) -> None:
    decoded = case.opened()
    (cache,) = decoded.caches()
    (cache / "notes.txt").write_text("mine")
    decoded_store.remove(cache)
    assert [path.name for path in cache.iterdir()] == ["notes.txt"]


def test_which_folder(case: Case, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert default_folder() == tmp_path / "xdg" / "rgbt" / "decoded"
    source = case.source
    assert decoded_dataset(source, None, num_threads=1) is source
    found = decoded_dataset(source, "auto", num_threads=1)
    assert isinstance(found, Decoded)
    assert found.folder == default_folder()
    named = decoded_dataset(source, str(tmp_path / "own"), num_threads=1)
    assert isinstance(named, Decoded)
    assert named.folder == tmp_path / "own"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert default_folder() == tmp_path / "home" / ".cache" / "rgbt" / "decoded"


def test_the_command(
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
    with pytest.raises(InputError, match=r"^cache: 'null' names no folder; expected auto or a"):
        entry.run(["cache=null"])


def test_real_pairs_bit_for_bit(tmp_path: Path) -> None:
    shared = Path(os.environ.get("RGBT_SHARED", Path(__file__).parents[3] / "shared"))
    root = shared / "realdata" / "mfnet200"
    if not root.is_dir():
        pytest.skip("real images are not part of the repository")
    source = MFNet(str(root))
    names = source.names("train")[:3]
    decoded = Decoded(source, tmp_path, num_threads=2)
    decoded.ensure(names)
    check_equal(decoded, source, names)
    packed = cv2.imread(str(root / "images" / f"{names[0]}.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decoded.read(names[0]).rgb, packed[..., 2::-1])


def test_the_command_refuses_what_it_does_not_heed(case: Case) -> None:
    with pytest.raises(InputError, match=r"'data\.cache' has no effect here; did you mean 'cache'"):
        entry.run([f"cache={case.cache}", "dataset=synth", "data.cache=/x"])
