"""Whether files are those that a frame was decoded from. Part of `rgbt.data.cache`."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import NamedTuple


class Stamp(NamedTuple):
    """How a file looked.

    Attributes:
        size: bytes, -1 where there was no file.
        mtime_ns: time of the last change of the bytes, nanoseconds; copies may keep it.
        ctime_ns: time of the last change of the file, which nothing but the system sets.
        inode: number of the file on its disk.
        crc: CRC-32 of its bytes; tells a copy from a change where one of the others differs.
    """

    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int
    crc: int


NOTHING_THERE = Stamp(-1, 0, 0, 0, 0)


def stamp_of(path: Path) -> Stamp:
    """The stamp of a file as it is now; `NOTHING_THERE` where it cannot be looked at."""
    return Stamp(*_status(path), _crc(path))


def is_fresh(paths: tuple[Path, ...], stamps: tuple[Stamp, ...]) -> bool:
    """Whether the files at `paths` are those of `stamps`.

    The system is asked once for every file; opened are those alone that are other files, or have
    other times, and the same length.
    """
    now = [_status(path) for path in paths]
    if [status[0] for status in now] != [stamp.size for stamp in stamps]:
        return False
    return all(
        status == stamp[:-1] or _crc(path) == stamp.crc
        for path, status, stamp in zip(paths, now, stamps, strict=True)
    )


def _status(path: Path) -> tuple[int, int, int, int]:
    """All of a stamp but the CRC."""
    try:
        status = path.stat()
    except OSError:
        return NOTHING_THERE[:4]
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def _crc(path: Path) -> int:
    try:
        return zlib.crc32(path.read_bytes())
    except OSError:
        return NOTHING_THERE.crc
