"""Whether files are the same as when a sample was decoded from them; part of `rgbt.data.cache`."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import NamedTuple


class FileState(NamedTuple):
    """What identifies the content of a file.

    Attributes:
        size: bytes, -1 where the file is missing.
        mtime_ns: time of the last change of the bytes, nanoseconds; copies may keep it.
        ctime_ns: time of the last change of the file, which only the system sets.
        inode: number of the file on its file system.
        crc: CRC-32 of its bytes; distinguishes a copy from a change where another field differs.
    """

    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int
    crc: int


MISSING = FileState(-1, 0, 0, 0, 0)


def state_of(path: Path) -> FileState:
    """The present state of a file; `MISSING` if it cannot be accessed."""
    return FileState(*_status(path), _crc(path))


def are_unchanged(paths: tuple[Path, ...], states: tuple[FileState, ...]) -> bool:
    """Whether the files at `paths` still have these states.

    There is one system call per file. A file is opened only if its length is the same and its
    times or its inode differ.
    """
    now = [_status(path) for path in paths]
    if [status[0] for status in now] != [state.size for state in states]:
        return False
    return all(
        status == state[:-1] or _crc(path) == state.crc
        for path, status, state in zip(paths, now, states, strict=True)
    )


def _status(path: Path) -> tuple[int, int, int, int]:
    """The state without the CRC."""
    try:
        status = path.stat()
    except OSError:
        return MISSING[:4]
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def _crc(path: Path) -> int:
    try:
        return zlib.crc32(path.read_bytes())
    except OSError:
        return MISSING.crc
