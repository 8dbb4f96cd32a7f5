"""One folder of the image cache: which samples it holds, which are intact, and adding others.

    about.json             the data set: class, decoding settings, fingerprint, and its root then
    NNNN-XXXXXXXX.frames   `rgbt.data.cache.sample_file`; the last file that has a sample counts
    verified.json          file -> length and time of change when its checksums were last compared,
                           and the names of the samples that were damaged
    lock                   held while files are added; the system releases it with the process

Part of `rgbt.data.cache`; `rgbt.data.cache.dataset` decides which samples are added.
"""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from rgbt.checks import InputError
from rgbt.data.cache.file_state import FileState
from rgbt.data.cache.sample_file import SampleFile, SampleFileWriter, SampleRecord
from rgbt.files.budgets import read_json, sealed
from rgbt.types import Sample

LOG = logging.getLogger(__name__)

ABOUT, VERIFIED, LOCK, SAMPLES = "about.json", "verified.json", "lock", "*.frames"
FINGERPRINT, ROOT = "fingerprint", "root"
"""Keys of about.json: the fingerprint of the data set, and its root when the folder was made."""

FILE_BYTES = 256 * 2**20
"""A file is closed at this size, so that a killed process loses only seconds of decoding."""

OnProgress = Callable[[str, int, int], object]
"""(name of the work, number done, total number)."""


class CachedSample(NamedTuple):
    """A sample of the cache: its file and its position there."""

    file: SampleFile
    record: SampleRecord


class NewSample(NamedTuple):
    """A decoded sample to be added; see `SampleFileWriter.add`."""

    sample: Sample
    crc: int
    sources: tuple[FileState, ...]


class CacheFolder:
    """See the module.

    Args:
        folder: need not exist.
        about: written into it when the first sample is added.
        num_threads: samples whose checksums are compared at a time.

    Attributes:
        samples: name -> sample, of every intact one; filled by `load`.
    """

    def __init__(self, folder: Path, about: dict[str, Any], num_threads: int) -> None:
        self.folder = folder
        self.about = about
        self.num_threads = num_threads
        self.samples: dict[str, CachedSample] = {}
        self._notes: dict[str, dict[str, Any]] = {}
        self._locked = False

    def load(self, on_progress: OnProgress) -> None:
        """List the samples; compare checksums of files that changed since the last comparison."""
        files = [file for path in self._paths() if (file := _opened(path)) is not None]
        kept = {**_read_notes(self.folder / VERIFIED), **self._notes}
        self._notes = {file.path.name: note for file in files if (note := _fitting(file, kept))}
        unknown = [file for file in files if file.path.name not in self._notes]
        if unknown:
            self._verify(unknown, on_progress)
        self.samples = {}
        for file in files:
            damaged = set(self._notes[file.path.name]["damaged"])
            for record in file.records():
                if record.name not in damaged:
                    self.samples[record.name] = CachedSample(file, record)

    @contextmanager
    def building(self) -> Iterator[None]:
        """Hold the lock while samples are added; call `load` again after waiting for it.

        Raises:
            InputError: the folder cannot be written, or is full.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with _lock(self.folder / LOCK) as self._locked:
                self._tidy()
                yield
        except OSError as error:
            raise InputError(_refusal(self.folder, error)) from error
        finally:
            self._locked = False

    def check_space(self, needed: int) -> None:
        """InputError if the disk has less than `needed` bytes left."""
        free = shutil.disk_usage(self.folder).free
        if free < needed:
            raise InputError(
                f"data.cache: the decoded images need about {gigabytes(needed)} in {self.folder}, "
                f"but the disk has {gigabytes(free)} left; free some space, name a folder on "
                "another disk with data.cache=FOLDER, or decode at every step with data.cache=null."
            )

    def add(self, samples: Iterator[NewSample]) -> None:
        """Write `samples` into new files; called inside `building`.

        Files that were complete before an exception are kept.
        """
        writer: SampleFileWriter | None = None
        try:
            for each in samples:
                writer = writer or SampleFileWriter(self._next_path())
                writer.add(*each)
                if writer.length >= FILE_BYTES:
                    self._publish(writer)
                    writer = None
            if writer is not None:
                self._publish(writer)
        finally:
            if writer is not None:
                writer.discard()
        self._remove_superseded()

    def adopt(self, other: Path) -> None:
        """Link the files of the cache folder `other` into this one."""
        for path in sorted(other.glob(SAMPLES)):
            with suppress(OSError):  # another disk, or no links: those samples are decoded again
                os.link(path, self.folder / path.name)
        self._notes = {**_read_notes(other / VERIFIED), **self._notes}
        self._write_notes()

    def _paths(self) -> list[Path]:
        return sorted(self.folder.glob(SAMPLES))

    def _next_path(self) -> Path:
        last = max((int(path.name[:4]) for path in self._paths()), default=-1)
        # The second part keeps two processes apart where the file system has no locks.
        return self.folder / f"{last + 1:04d}-{secrets.token_hex(4)}.frames"

    def _publish(self, writer: SampleFileWriter) -> None:
        writer.publish()
        file = SampleFile(writer.path)
        self._notes[file.path.name] = _note(file, [])
        self._write_notes()
        self.samples |= {each.name: CachedSample(file, each) for each in file.records()}

    def _verify(self, files: list[SampleFile], on_progress: OnProgress) -> None:
        samples = [CachedSample(file, record) for file in files for record in file.records()]
        damaged: dict[str, list[str]] = {file.path.name: [] for file in files}
        with ThreadPoolExecutor(self.num_threads) as pool:
            results = pool.map(lambda each: each.file.is_intact(each.record), samples)
            for done, (sample, is_intact) in enumerate(zip(samples, results, strict=True), 1):
                on_progress("comparing checksums", done, len(samples))
                if not is_intact:
                    damaged[sample.file.path.name].append(sample.record.name)
        for file in files:
            self._notes[file.path.name] = _note(file, damaged[file.path.name])
        with suppress(OSError):  # a read-only folder: compared again next time
            self._write_notes()

    def _write_notes(self) -> None:
        _write_whole(self.folder / VERIFIED, self._notes)

    def _tidy(self) -> None:
        if not (self.folder / ABOUT).is_file():
            _write_whole(self.folder / ABOUT, self.about)
        if not self._locked:
            return
        for path in self.folder.glob(".*.part"):  # of a killed process
            path.unlink(missing_ok=True)
        for path in self._paths():
            if _opened(path) is None:
                path.unlink(missing_ok=True)

    def _remove_superseded(self) -> None:
        used = {sample.file.path for sample in self.samples.values()}
        for path in self._paths():
            if self._locked and path not in used:
                path.unlink(missing_ok=True)


def gigabytes(num_bytes: int) -> str:
    """A size in decimal units: 2410000000 -> "2.41 GB", 1500000 -> "1.5 MB"."""
    return f"{num_bytes / 1e9:.2f} GB" if num_bytes >= 1e8 else f"{num_bytes / 1e6:.1f} MB"


def caches_like(folder: Path, about: dict[str, Any]) -> list[Path]:
    """Caches in `folder` of the same data set with the same decoding settings as those in `about`.

    The data set is the same if its files are equal, or if its root is.
    """
    alike = []
    for path in sorted(folder.glob(f"*/{ABOUT}")):
        other = _read_json(path)
        differing = [key for key, value in about.items() if other.get(key) != value]
        if differing in ([], [FINGERPRINT], [ROOT]):
            alike.append(path.parent)
    return alike


def size_of(cache: Path) -> int:
    """Bytes of the files of a cache."""
    return sum(path.stat().st_size for path in cache.iterdir())


def remove(cache: Path) -> None:
    """Delete the files of a cache, and its folder if nothing else is in it."""
    for path in [*cache.glob(SAMPLES), *cache.glob(".*.part")]:
        path.unlink(missing_ok=True)
    for name in (VERIFIED, LOCK, ABOUT):
        (cache / name).unlink(missing_ok=True)
    with suppress(OSError):
        cache.rmdir()


def _opened(path: Path) -> SampleFile | None:
    """The file; None if it is damaged, not readable or has just been removed."""
    try:
        return SampleFile(path)
    except (ValueError, OSError):
        return None


def _note(file: SampleFile, damaged: list[str]) -> dict[str, Any]:
    return {"length": file.length, "mtime_ns": file.mtime_ns, "damaged": damaged}


def _fitting(file: SampleFile, notes: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    note = notes.get(file.path.name)
    return note if note and note == _note(file, note.get("damaged", [])) else None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        values: dict[str, Any] = read_json(path, dict[str, Any], "")
    except InputError:  # missing or damaged: its values are determined again
        return {}
    return values


def _read_notes(path: Path) -> dict[str, dict[str, Any]]:
    return {key: note for key, note in _read_json(path).items() if isinstance(note, dict)}


def _write_whole(path: Path, content: dict[str, Any]) -> None:
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(sealed(content), file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _lock(path: Path) -> Iterator[bool]:
    """Hold the lock; False if the file system has none, so that two may do the same work."""
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            LOG.warning("waiting for another process that writes to %s", path.parent)
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL):
                raise
            yield False
            return
        yield True


def _refusal(folder: Path, error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return (
            f"data.cache: the disk of {folder} is full ({error.strerror}); images decoded so far "
            "are kept. Free some space, name another folder with data.cache=FOLDER, or decode at "
            "every step with data.cache=null."
        )
    return (
        f"data.cache: cannot write {folder} ({error.strerror or error}); name a writable "
        "folder with data.cache=FOLDER, or decode at every step with data.cache=null."
    )
