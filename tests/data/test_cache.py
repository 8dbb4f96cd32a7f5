from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import pickle
import runpy
import shutil
import signal
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.cache import dataset as cache_dataset
from rgbt.data.cache import sample_map
from rgbt.data.cache.__main__ import entry
from rgbt.data.cache.dataset import CachedDataset, cached_dataset, default_folder, remove
from rgbt.data.mfnet import MFNet
from rgbt.files import atomic
from rgbt.types import Sample

NAMES = ("a", "b", "c", "d")
SIZES = {"a": (4, 6), "b": (5, 7), "c": (4, 6), "d": (3, 3)}


class Arrays:
    """Samples as .npy: R, G, B, thermal and, except for "d", label. Records what it decodes."""

    name, num_classes, classes, unscored, background = "arrays", 2, ("x", "y"), (), ()
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
        sizes = [(path.name, path.stat().st_size) for path in sorted(self.root.iterdir())]
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


Reported = list[tuple[str, int, int]]


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


def test_read_returns_read_only_views(case: Case) -> None:
    sample = case.opened().read("b")
    for image in (sample.rgb, sample.thermal, sample.label):
        assert image.flags.c_contiguous
        assert not image.flags.owndata
        assert not image.flags.writeable
    assert sample.rgb.shape == (5, 7, 3)
    assert np.shares_memory(sample.rgb[1:3, 2:4], sample.rgb)


def test_each_name_is_in_one_file(case: Case) -> None:
    cached = CachedDataset(case.source, case.cache, num_threads=1)
    cached.ensure(("a",))
    case.source.decoded.clear()
    cached.read("b")
    assert case.source.decoded == ["b"]
    cached.ensure(("c", "b", "c", "a"))
    check_equal(cached, case.source, ("a", "b", "c"))
    cached.ensure(("c", "a"))
    maps = [sample_map.SampleMap(path) for path in case.files()]
    assert sorted(sorted(each.records) for each in maps) == [["a"], ["b", "c"]]


def test_progress_counts_decoded_samples(case: Case) -> None:
    reported: Reported = []
    cached = CachedDataset(case.source, case.cache, num_threads=2)
    cached.ensure(NAMES, lambda *each: reported.append(each))
    assert reported == [("decoding", n, 4) for n in (1, 2, 3, 4)]
    reported.clear()
    cached.ensure(NAMES, lambda *each: reported.append(each))
    assert reported == []


def rewrite(case: Case) -> None:
    write(case.source.root, "b", seed=1)  # as long as it was


def rewrite_in_its_time(case: Case) -> None:
    path = case.source.root / "b.npy"
    before = path.stat()
    while path.stat().st_ctime_ns == before.st_ctime_ns:  # the clock of a disk ticks in ms
        write(case.source.root, "b", seed=1)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_mtime_ns == before.st_mtime_ns


def change_second_file(case: Case) -> None:
    (case.source.root / "a.txt").write_text("y")


def change_length_in_its_time(case: Case) -> None:
    path = case.source.root / "c.npy"
    time = path.stat().st_mtime_ns
    np.save(path, np.zeros((2, 2, 5), np.uint8))
    os.utime(path, ns=(time, time))


CHANGES = [rewrite, rewrite_in_its_time, change_second_file, change_length_in_its_time]


@pytest.mark.parametrize("change", CHANGES)
def test_changed_file_of_data_set_is_noticed(case: Case, change: Any) -> None:
    (case.source.root / "a.txt").write_text("x")
    os.utime(case.source.root / "a.txt", ns=(1, 1))
    case.opened()
    change(case)
    cached = case.opened()
    assert set(case.source.decoded) == set(NAMES)
    check_equal(cached, case.source)
    assert len({path.name for path in case.files()}) == 1
    case.opened()
    assert case.source.decoded == []


def test_copy_with_other_times_uses_same_cache(case: Case, tmp_path: Path) -> None:
    case.opened()
    shutil.copytree(case.source.root, tmp_path / "copy", copy_function=shutil.copyfile)
    copy = Arrays(tmp_path / "copy")
    check_equal(case.opened(copy), case.source)
    assert set(copy.decoded) == set(), "equal bytes"


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
    check_equal(case.opened(other), other)
    check_equal(case.opened(), case.source)


def test_unchanged_files_are_not_opened(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    case.opened()

    def refuses(path: Path) -> int:
        raise AssertionError(f"{path} was read")

    monkeypatch.setattr(sample_map, "_crc", refuses)
    check_equal(case.opened(), case.source)


def test_changed_data_set_has_new_cache_beside_old(
    case: Case, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (old,) = case.opened().caches()
    np.save(case.source.root / "c.npy", np.zeros((2, 2, 5), np.uint8))
    with caplog.at_level(logging.WARNING):
        cached = case.opened()
    assert "arrays has changed" in caplog.text
    assert str(old) in caplog.text
    check_equal(cached, case.source)
    assert old in cached.caches()
    assert len(cached.caches()) == 2
    case.source.root.rename(tmp_path / "moved")
    moved = Arrays(tmp_path / "moved")
    check_equal(case.opened(moved), moved)
    assert len(CachedDataset(moved, case.cache, num_threads=1).caches()) == 1, "of its own root"


class Inverted(Arrays):
    """Another reader of the same files."""

    def read(self, name: str) -> Sample:
        sample = super().read(name)
        return replace(sample, thermal=255 - sample.thermal)


@pytest.mark.parametrize(
    ("kind", "name", "decoding"),
    [(Inverted, "arrays", {}), (Arrays, "others", {}), (Arrays, "arrays", {"crop": (0, 1)})],
)
def test_other_class_name_or_setting_has_own_cache(
    case: Case, kind: type[Arrays], name: str, decoding: dict[str, Any]
) -> None:
    case.opened()
    other = kind(case.source.root, decoding)
    other.name = name
    cached = case.opened(other)
    assert set(other.decoded) == set(NAMES)
    check_equal(cached, other)
    assert len(cached.caches()) == 1
    assert len(case.files()) == 2


def flip(path: Path, offset: int) -> None:
    content = bytearray(path.read_bytes())
    content[offset] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(1, 1))


@pytest.mark.parametrize("image", ["rgb", "thermal", "label"])
def test_damaged_sample_is_decoded_again(case: Case, image: str) -> None:
    case.opened()
    (path,) = case.files()
    record = sample_map.SampleMap(path).records["b"]
    flip(path, record.offset + {"rgb": 0, "thermal": 3 * 35, "label": 5 * 35 - 1}[image])
    check_equal(case.opened(), case.source)
    assert case.files() == [path]


def test_checksums_are_compared_once(case: Case) -> None:
    case.opened()
    (path,) = case.files()
    reported: Reported = []
    os.utime(path, ns=(1, 1))
    for expected in (["comparing checksums"] * 4, []):
        reported.clear()
        cached = CachedDataset(case.source, case.cache, num_threads=2)
        cached.ensure(("a",), lambda *each: reported.append(each))
        assert [what for what, *_ in reported] == expected


@pytest.mark.parametrize("damage", ["cut", "index", "length", "end", "empty", "end alone"])
def test_incomplete_file_is_written_again(case: Case, damage: str) -> None:
    case.opened()
    (path,) = case.files()
    content = path.read_bytes()
    if damage in ("index", "length", "end"):
        flip(path, len(content) - {"index": 40, "length": 8, "end": 20}[damage])
    else:
        kept = {"cut": slice(len(content) // 2), "empty": slice(0), "end alone": slice(-20, None)}
        path.write_bytes(content[kept[damage]])
    check_equal(case.opened(), case.source)


def kills(number: int) -> Any:
    """Ends the process at its n-th call, like a kill."""
    calls = iter(range(number))

    def call(*args: Any, **kwargs: Any) -> Any:
        if next(calls) == number - 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return bytes(3)

    return call


STEPS: dict[str, tuple[Any, str, int]] = {
    "first sample": (sample_map.Record, "_replace", 1),
    "index": (sample_map, "sealed", 1),
    "time": (sample_map.os, "utime", 1),
    "flush": (atomic.os, "fsync", 3),
    "rename": (Path, "replace", 2),
}
"""The first rename and the first two flushes are of about.json."""


@pytest.mark.parametrize("step", STEPS)
def test_process_killed_at_any_step_leaves_valid_cache(
    case: Case, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    def build() -> None:
        owner, function, number = STEPS[step]
        monkeypatch.setattr(owner, function, kills(number))
        case.opened()

    process = multiprocessing.get_context("fork").Process(target=build)
    process.start()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    assert case.files() == []
    assert len(list(case.cache.glob("*/.*"))) == 1, "what it had started"
    check_equal(case.opened(), case.source)
    assert list(case.cache.glob("*/.*")) == []


def test_two_processes_decode_once(case: Case) -> None:
    barrier = threading.Barrier(2)

    def build(source: Arrays) -> tuple[CachedDataset, Reported]:
        reported: Reported = []
        cached = CachedDataset(source, case.cache, num_threads=1)
        barrier.wait()
        cached.ensure(NAMES, lambda *each: reported.append(each))
        return cached, reported

    sources = [Arrays(case.source.root), Arrays(case.source.root)]
    with ThreadPoolExecutor(2) as pool:
        built = list(pool.map(build, sources))
    assert sorted(len(reported) for _, reported in built) == [0, 4], "one waited"
    assert len(case.files()) == 1
    for cached, _ in built:
        check_equal(cached, cached.source)


def test_two_processes_without_locks_build_valid_cache(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*args: Any) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(atomic.fcntl, "flock", no_locks)
    fork = multiprocessing.get_context("fork")  # temporary names hold the number of the process
    barrier = fork.Barrier(2)

    def build() -> None:
        source = Arrays(case.source.root)
        barrier.wait()
        check_equal(case.opened(source), source)

    processes = [fork.Process(target=build) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
    assert [process.exitcode for process in processes] == [0, 0]
    assert len(case.files()) == 1
    check_equal(case.opened(), case.source)


def test_too_small_disk_is_refused_before_writing(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage("/")._replace(free=479)
    monkeypatch.setattr(cache_dataset.shutil, "disk_usage", lambda path: usage)
    # The first frame has 4 x 6 pixels of 5 bytes; four times 120 bytes.
    with pytest.raises(InputError, match=rf"need about 0\.0 MB in {case.cache}.* 0\.0 MB left"):
        case.opened()
    assert case.files() == []
    usage = usage._replace(free=480)
    check_equal(case.opened(), case.source)


@pytest.mark.parametrize("number", [28, 122])
def test_full_disk_is_refused(case: Case, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def full(*args: Any) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(sample_map.os, "utime", full)
        with pytest.raises(InputError, match=r"is full .*data\.cache=null"):
            case.opened()
    assert list(case.cache.glob("*/.*")) == []
    check_equal(case.opened(), case.source)


def test_unwritable_folder_is_refused(case: Case) -> None:
    case.cache.write_text("a file")
    with pytest.raises(InputError, match=r"data\.cache: cannot write .*data\.cache=FOLDER"):
        case.opened()


def test_complete_cache_is_not_written_to(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """So it may be in a read-only folder, copied there, even if a sample cannot be decoded."""
    (case.source.root / "c.npy").write_bytes(b"none")
    case.opened()
    os.utime(case.files()[0], ns=(1, 1))  # compares the checksums, cannot record the result

    def refuses(*args: Any, **kwargs: Any) -> None:
        raise PermissionError(13, "Permission denied")

    for owner, function in ((Path, "mkdir"), (sample_map.os, "utime"), (Path, "replace")):
        monkeypatch.setattr(owner, function, refuses)
    check_equal(case.opened(), case.source, ("a", "b", "d"))


@pytest.mark.parametrize("before", [False, True])
def test_unreadable_file_raises_message_of_data_set(case: Case, before: bool) -> None:
    path = case.source.root / "c.npy"
    content = path.read_bytes()
    if before:
        case.opened()
    path.write_bytes(b"x" * len(content))
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


@pytest.mark.parametrize("started", [False, True])
def test_name_without_files_raises_message_of_data_set(
    case: Case, monkeypatch: pytest.MonkeyPatch, started: bool
) -> None:
    """PST900 refuses a name of both parts, and says so for its files too."""
    if started:  # the frame is in the cache
        case.opened()
    real = case.source.files

    def files(name: str) -> tuple[Path, ...]:
        if name == "b":
            raise InputError("b is of both parts.")
        return real(name)

    monkeypatch.setattr(case.source, "files", files)
    cached = case.opened()
    with pytest.raises(InputError, match="both parts"):
        cached.read("b")
    check_equal(cached, case.source, ("a", "c", "d"))


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


def test_removed_or_replaced_cache_does_not_stop_worker(case: Case) -> None:
    cached = case.opened()
    cached.read("a")  # maps the file
    late = pickle.loads(pickle.dumps(cached))
    write(case.source.root, "b", seed=1)
    expected = case.opened().read("b").rgb
    np.testing.assert_array_equal(late.read("b").rgb, expected)
    late = pickle.loads(pickle.dumps(cached))
    (cache,) = cached.caches()
    (cache / "notes.txt").write_text("mine")
    remove(cache)
    assert [path.name for path in cache.iterdir()] == ["notes.txt"]
    assert cached.read("a").rgb.shape == (4, 6, 3), "the map is still there"
    np.testing.assert_array_equal(late.read("a").rgb, case.source.read("a").rgb)


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
    with pytest.raises(InputError, match="'remove'"):
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


def test_former_command_warns_and_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["rgbt.data.decoded", "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("rgbt.data.decoded", run_name="__main__")
    assert not ended.value.code
    done = capsys.readouterr()
    assert "to the image cache" in done.out
    assert "was renamed to rgbt.data.cache" in done.err


def test_command_refuses_setting_without_effect(case: Case) -> None:
    with pytest.raises(InputError, match=r"'data\.cache' has no effect here; did you mean 'cache'"):
        entry.run([f"cache={case.cache}", "dataset=synth", "data.cache=/x"])
