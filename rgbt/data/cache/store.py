"""A folder of decoded frames: which are there, which are whole, and adding others.

    about.json          what it was decoded from: class, decoding, fingerprint; and its folder then
    NNNN-XXXXXXXX.frames   `rgbt.data.cache.file`; of a frame in several of them, the last counts
    verified.json       file -> length and time of change when its checksums were last compared, and
                        the frames that were damaged then
    lock                held while files are added; freed by the system when its process ends

Part of `rgbt.data.cache`, which decides what belongs into it.
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
from rgbt.data.cache.file import Frame, FrameFile, FrameWriter
from rgbt.data.cache.stamps import Stamp
from rgbt.files.budgets import read_json, sealed
from rgbt.types import Sample

LOG = logging.getLogger(__name__)

ABOUT, VERIFIED, LOCK, FRAMES = "about.json", "verified.json", "lock", "*.frames"
FINGERPRINT, ROOT = "fingerprint", "root"
"""Entries of about.json: the state of a data set, and where it lay when the store was begun."""

FILE_BYTES = 256 * 2**20
"""A file is closed when it holds this much: what a killed build loses, seconds of decoding."""

Told = Callable[[str, int, int], object]
"""(what is being done, how many are done, of how many)."""


class Placed(NamedTuple):
    """A frame and the file that holds it."""

    file: FrameFile
    frame: Frame


class Fresh(NamedTuple):
    """A frame on its way into a store: see `FrameWriter.add`."""

    sample: Sample
    crc: int
    stamps: tuple[Stamp, ...]


class Store:
    """See the module.

    Args:
        folder: need not exist.
        about: written into it when something is added first.
        num_threads: frames whose checksums are compared at a time.

    Attributes:
        frames: name -> where it lies, of every whole frame; filled by `load`.
    """

    def __init__(self, folder: Path, about: dict[str, Any], num_threads: int) -> None:
        self.folder = folder
        self.about = about
        self.num_threads = num_threads
        self.frames: dict[str, Placed] = {}
        self._notes: dict[str, dict[str, Any]] = {}
        self._locked = False

    def load(self, told: Told) -> None:
        """Find what is there; compare checksums of files that changed since that was last done."""
        files = [file for path in self._paths() if (file := _opened(path)) is not None]
        kept = {**_read_notes(self.folder / VERIFIED), **self._notes}
        self._notes = {file.path.name: note for file in files if (note := _fitting(file, kept))}
        unknown = [file for file in files if file.path.name not in self._notes]
        if unknown:
            self._verify(unknown, told)
        self.frames = {}
        for file in files:
            damaged = set(self._notes[file.path.name]["damaged"])
            for frame in file.frames():
                if frame.name not in damaged:
                    self.frames[frame.name] = Placed(file, frame)

    @contextmanager
    def building(self) -> Iterator[None]:
        """Be the one process that adds frames; waits for another one, then `load` anew.

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
        """InputError where the disk has less than `needed` bytes left."""
        free = shutil.disk_usage(self.folder).free
        if free < needed:
            raise InputError(
                f"data.cache: the decoded frames need about {gigabytes(needed)} in {self.folder}, "
                f"and the disk has {gigabytes(free)} left; free some, name a folder on another disk"
                " with data.cache=FOLDER, or decode at every step with data.cache=null."
            )

    def add(self, frames: Iterator[Fresh]) -> None:
        """Write `frames` into new files; called inside `building`.

        What was complete before an exception stays.
        """
        writer: FrameWriter | None = None
        try:
            for each in frames:
                writer = writer or FrameWriter(self._next_path())
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
        """Take the files of the store `other` as well, without a copy where the disk can do so."""
        for path in sorted(other.glob(FRAMES)):
            with suppress(OSError):  # another disk, or one without links: decoded again then
                os.link(path, self.folder / path.name)
        self._notes = {**_read_notes(other / VERIFIED), **self._notes}
        self._write_notes()

    def _paths(self) -> list[Path]:
        return sorted(self.folder.glob(FRAMES))

    def _next_path(self) -> Path:
        last = max((int(path.name[:4]) for path in self._paths()), default=-1)
        # The second part keeps two builders apart where the disk knows no locks.
        return self.folder / f"{last + 1:04d}-{secrets.token_hex(4)}.frames"

    def _publish(self, writer: FrameWriter) -> None:
        writer.publish()
        file = FrameFile(writer.path)
        self._notes[file.path.name] = _note(file, [])
        self._write_notes()
        self.frames.update((frame.name, Placed(file, frame)) for frame in file.frames())

    def _verify(self, files: list[FrameFile], told: Told) -> None:
        asked = [(file, frame) for file in files for frame in file.frames()]
        damaged: dict[str, list[str]] = {file.path.name: [] for file in files}
        with ThreadPoolExecutor(self.num_threads) as pool:
            whole = pool.map(lambda pair: pair[0].is_whole(pair[1]), asked)
            for done, ((file, frame), is_whole) in enumerate(zip(asked, whole, strict=True), 1):
                told("comparing checksums", done, len(asked))
                if not is_whole:
                    damaged[file.path.name].append(frame.name)
        for file in files:
            self._notes[file.path.name] = _note(file, damaged[file.path.name])
        with suppress(OSError):  # a folder that may only be read: compared again next time
            self._write_notes()

    def _write_notes(self) -> None:
        _write_whole(self.folder / VERIFIED, self._notes)

    def _tidy(self) -> None:
        if not (self.folder / ABOUT).is_file():
            _write_whole(self.folder / ABOUT, self.about)
        if not self._locked:
            return
        for path in self.folder.glob(".*.part"):  # of a builder that was killed
            path.unlink(missing_ok=True)
        for path in self._paths():
            if _opened(path) is None:
                path.unlink(missing_ok=True)

    def _remove_superseded(self) -> None:
        alive = {placed.file.path for placed in self.frames.values()}
        for path in self._paths():
            if self._locked and path not in alive:
                path.unlink(missing_ok=True)


def gigabytes(num_bytes: int) -> str:
    """A size as disks are sold: 2410000000 -> "2.41 GB", 1500000 -> "1.5 MB"."""
    return f"{num_bytes / 1e9:.2f} GB" if num_bytes >= 1e8 else f"{num_bytes / 1e6:.1f} MB"


def stores_like(folder: Path, about: dict[str, Any]) -> list[Path]:
    """Stores in `folder` that were decoded in the same way from the same data set.

    That is from equal files anywhere, or from any files that lay in the same place.

    Args:
        folder: holds stores.
        about: of the store that others are compared with.
    """
    found = []
    for path in sorted(folder.glob(f"*/{ABOUT}")):
        other = _read_json(path)
        differing = [key for key, value in about.items() if other.get(key) != value]
        if differing in ([], [FINGERPRINT], [ROOT]):
            found.append(path.parent)
    return found


def size_of(store: Path) -> int:
    """Bytes of the files in `store`."""
    return sum(path.stat().st_size for path in store.iterdir())


def remove(store: Path) -> None:
    """Delete a store, and nothing else that somebody may have put beside its files."""
    for path in [*store.glob(FRAMES), *store.glob(".*.part")]:
        path.unlink(missing_ok=True)
    for name in (VERIFIED, LOCK, ABOUT):
        (store / name).unlink(missing_ok=True)
    with suppress(OSError):
        store.rmdir()


def _opened(path: Path) -> FrameFile | None:
    """The file; None where it is damaged, may not be read or has just been removed."""
    try:
        return FrameFile(path)
    except (ValueError, OSError):
        return None


def _note(file: FrameFile, damaged: list[str]) -> dict[str, Any]:
    return {"length": file.length, "mtime_ns": file.mtime_ns, "damaged": damaged}


def _fitting(file: FrameFile, notes: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    note = notes.get(file.path.name)
    return note if note and note == _note(file, note.get("damaged", [])) else None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = read_json(path, dict[str, Any], "")
    except InputError:  # missing or damaged: what it said is found out again
        return {}
    return found


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
    """Hold the lock; False where the disk knows no locks, so that two may do the same work."""
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            LOG.warning("waiting for another process that decodes into %s", path.parent)
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
            f"data.cache: the disk of {folder} filled up ({error.strerror}); what was decoded "
            "stays. Free some space, name another folder with data.cache=FOLDER, or decode at "
            "every step with data.cache=null."
        )
    return (
        f"data.cache: cannot write {folder} ({error.strerror or error}); name a folder that can be "
        "written with data.cache=FOLDER, or decode at every step with data.cache=null."
    )
