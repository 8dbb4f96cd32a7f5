"""Whether files are those that a frame was decoded from. Part of `rgbt.data.decoded`."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import NamedTuple


class Stamp(NamedTuple):
    """How a file looked.

    Attributes:
        size: bytes, -1 where there was no file.
        mtime_ns: time of the last change, nanoseconds.
        crc: CRC-32 of its bytes; tells a copy from a change where the times differ.
    """

    size: int
    mtime_ns: int
    crc: int


NOTHING_THERE = Stamp(-1, 0, 0)


def stamp_of(path: Path) -> Stamp:
    """The stamp of a file as it is now; `NOTHING_THERE` where it cannot be looked at."""
    return Stamp(*_status(path), _crc(path))


def is_fresh(paths: tuple[Path, ...], stamps: tuple[Stamp, ...]) -> bool:
    """Whether the files at `paths` are those of `stamps`.

    The system is asked once for every file; opened are those alone that differ in time and not in
    length.
    """
    now = [_status(path) for path in paths]
    if [size for size, _ in now] != [stamp.size for stamp in stamps]:
        return False
    return all(
        mtime_ns == stamp.mtime_ns or _crc(path) == stamp.crc
        for path, (_, mtime_ns), stamp in zip(paths, now, stamps, strict=True)
    )


def _status(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except OSError:
        return NOTHING_THERE.size, NOTHING_THERE.mtime_ns
    return status.st_size, status.st_mtime_ns


def _crc(path: Path) -> int:
    try:
        return zlib.crc32(path.read_bytes())
    except OSError:
        return NOTHING_THERE.crc
