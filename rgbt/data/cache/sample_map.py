"""Write and read one memory-mapped file of decoded samples with an index.

    samples           one after the other, each begins at a multiple of 64 bytes:
                      rgb (H, W, 3), thermal (H, W), label (H, W) if it has one; uint8
    index             JSON with a checksum: time of writing, and one `Record` per sample
    end, 20 bytes     "rgbtdec3", length and CRC-32 of the index

A file is complete or absent: it is written under another name, flushed and renamed.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rgbt.files.atomic import replacing
from rgbt.files.plain_files import parse_json, sealed
from rgbt.types import Sample

MAGIC = b"rgbtdec3"
END = struct.Struct("<8sQI")
ALIGNMENT = 64
"""Bytes of a cache line of the processor."""

Array = NDArray[np.uint8]

OnProgress = Callable[[str, int, int], object]
"""(name of the work, number done, total number)."""


FileState = tuple[int, int, int, int, int]
"""State that identifies the content of a file: bytes (-1: missing), time of the last change of its
bytes and of the file (nanoseconds; copies may keep the former, only the system sets the latter),
inode, CRC-32. The CRC distinguishes a copy from a change where times or inode differ."""

MISSING = (-1, 0, 0, 0, 0)


def state_of(path: Path) -> FileState:
    """The present state of a file; `MISSING` if it cannot be accessed."""
    return (*_status(path), _crc(path))


def are_unchanged(paths: tuple[Path, ...], states: tuple[FileState, ...]) -> bool:
    """Whether the files at `paths` still have these states.

    There is one system call per file. A file is opened only if its length is the same and its
    times or its inode differ.
    """
    now = [_status(path) for path in paths]
    if [status[0] for status in now] != [state[0] for state in states]:
        return False
    return all(
        status == state[:-1] or _crc(path) == state[-1]
        for path, status, state in zip(paths, now, states, strict=True)
    )


def _status(path: Path) -> tuple[int, int, int, int]:
    try:
        status = path.stat()
    except OSError:
        return MISSING[:4]
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def _crc(path: Path) -> int:
    try:
        return zlib.crc32(path.read_bytes())
    except OSError:
        return MISSING[-1]


class Record(NamedTuple):
    """Position and size of a sample in its file.

    Attributes:
        name: as in the split list.
        offset: its first byte.
        height: of all its images, pixels.
        width: the same.
        labelled: whether a label follows the thermal image.
        crc: CRC-32 of its bytes.
        sources: states of the files that it was decoded from.
    """

    name: str
    offset: int
    height: int
    width: int
    labelled: bool
    crc: int
    sources: tuple[FileState, ...]

    @property
    def num_bytes(self) -> int:
        """Bytes of rgb, thermal and label."""
        return self.height * self.width * (5 if self.labelled else 4)


@dataclass(frozen=True)
class Index:
    """Of a file; `written_s` is also its time of change, in seconds since 1970."""

    written_s: int
    samples: list[Record]


class NewSample:
    """A decoded sample to be written; its images are uint8 and of one size.

    Args:
        sample: named as in the split list.
        sources: states of its files before it was decoded.
    """

    def __init__(self, sample: Sample, sources: tuple[FileState, ...]) -> None:
        images = (sample.rgb, sample.thermal, sample.label)
        self.images = [np.ascontiguousarray(image) for image in images if image is not None]
        crc = 0
        for image in self.images:
            crc = zlib.crc32(image.data, crc)
        (height, width), labelled = sample.thermal.shape, sample.label is not None
        self.record = Record(sample.name, 0, height, width, labelled, crc, sources)


def write_map(path: Path, samples: Iterator[NewSample]) -> None:
    """Write a file of samples; OSError if that is not possible."""
    records = []
    written_s = int(time.time())
    with replacing(path) as file:
        for each in samples:
            file.write(bytes(-file.tell() % ALIGNMENT))
            records.append(each.record._replace(offset=file.tell()))
            for image in each.images:
                file.write(image.data)
        index = json.dumps(sealed({"written_s": written_s, "samples": records})).encode()
        file.write(index + END.pack(MAGIC, len(index), zlib.crc32(index)))
        file.flush()
        os.utime(file.fileno(), (written_s, written_s))


class SampleMap:
    """A complete file of samples, mapped into memory and read-only.

    A process that receives it by `pickle` maps the file again; a forked one inherits the map.

    Args:
        path: the file.

    Attributes:
        path: of the file.
        records: by name.

    Raises:
        ValueError: not a complete file of this format.
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as file:
            length = file.seek(0, os.SEEK_END)
            file.seek(max(0, length - END.size))
            self._end = file.read()
            magic, size, _ = END.unpack(self._end) if len(self._end) == END.size else (b"", 0, 0)
            if magic != MAGIC or size > length - END.size:
                raise ValueError(f"{path} is not a complete file of decoded samples")
            file.seek(length - END.size - size)
            index: Index = parse_json(file.read(size), Index)
        self.records = {record.name: record for record in index.samples}
        self._written_s = index.written_s

    @cached_property
    def _map(self) -> mmap.mmap:
        with self.path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if mapped[-END.size :] != self._end:
            raise ValueError(f"{self.path} has been replaced")
        return mapped

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in vars(self).items() if key != "_map"}

    def is_intact(self, num_threads: int, on_progress: OnProgress) -> bool:
        """Whether the bytes are those that were written.

        Checksums are compared if the time of the file shows a change or a copy.
        """
        if self.path.stat().st_mtime == self._written_s:
            return True

        def is_damaged(record: Record) -> bool:
            view = self._view(record.offset, (record.num_bytes,))
            return zlib.crc32(view.data) != record.crc

        with ThreadPoolExecutor(num_threads) as pool:
            for done, damaged in enumerate(pool.map(is_damaged, self.records.values()), 1):
                on_progress("comparing checksums", done, len(self.records))
                if damaged:
                    return False
        with suppress(OSError):  # a read-only folder: compared again next time
            os.utime(self.path, (self._written_s, self._written_s))
        return True

    def read(self, name: str) -> Sample:
        """The sample as read-only views of the map; nothing is copied.

        Raises:
            ValueError: the file has been replaced.
            OSError: it cannot be opened.
        """
        record = self.records[name]
        hw = (record.height, record.width)
        pixels = record.height * record.width
        label = self._view(record.offset + 4 * pixels, hw) if record.labelled else None
        return Sample(
            rgb=self._view(record.offset, (*hw, 3)),
            thermal=self._view(record.offset + 3 * pixels, hw),
            label=label,
            name=name,
        )

    def _view(self, offset: int, shape: tuple[int, ...]) -> Array:
        flat = np.frombuffer(self._map, np.uint8, count=int(np.prod(shape)), offset=offset)
        return flat.reshape(shape)
