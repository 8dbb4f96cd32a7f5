"""One file of decoded samples, with an index.

    samples           one after the other, each begins at a multiple of 64 bytes:
                      rgb (H, W, 3), thermal (H, W), label (H, W) if it has one; uint8
    index             JSON, one entry per sample (`SampleRecord`)
    end, 20 bytes     "rgbtdec1", length and CRC-32 of the index

A file is complete or absent: it is written under another name, flushed and renamed. Part of
`rgbt.data.cache`.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rgbt.data.cache.file_state import FileState
from rgbt.types import Sample

MAGIC = b"rgbtdec1"
END = struct.Struct("<8sQI")
ALIGNMENT = 64
"""Bytes of a cache line of the processor."""

Array = NDArray[np.uint8]


class SampleRecord(NamedTuple):
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


def bytes_of(sample: Sample) -> int:
    """Bytes of `sample` in a file, without alignment and index."""
    return sample.thermal.size * (5 if sample.label is not None else 4)


def crc_of(sample: Sample) -> int:
    """CRC-32 of the bytes of `sample` in the order of the file."""
    crc = 0
    for image in _images(sample):
        crc = zlib.crc32(image.data, crc)
    return crc


class SampleFileWriter:
    """Writes one file, which does not exist under its name before `publish`.

    Args:
        path: its final name.

    Attributes:
        length: bytes written so far.
        records: of the samples added.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.length = 0
        self.records: list[SampleRecord] = []
        self._temporary = path.with_name(f".{path.name}.part")
        self._file = self._temporary.open("wb")

    def add(self, sample: Sample, crc: int, sources: tuple[FileState, ...]) -> None:
        """Append a sample; `crc` is that of `crc_of`."""
        gap = -self.length % ALIGNMENT
        self._file.write(bytes(gap))
        offset = self.length + gap
        height, width = sample.thermal.shape
        for image in _images(sample):
            self._file.write(image.data)
        labelled = sample.label is not None
        record = SampleRecord(sample.name, offset, height, width, labelled, crc, sources)
        self.records.append(record)
        self.length = offset + record.num_bytes

    def publish(self) -> None:
        """Write the index and give the file its name."""
        index = json.dumps(self.records).encode()
        self._file.write(index)
        self._file.write(END.pack(MAGIC, len(index), zlib.crc32(index)))
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._temporary.replace(self.path)

    def discard(self) -> None:
        """Remove what has been written, unless it was published."""
        try:
            self._file.close()
        except OSError:
            pass  # on a full disk, closing flushes again and fails again
        finally:
            self._temporary.unlink(missing_ok=True)


class SampleFile:
    """A published file, mapped into memory and read-only.

    A process that receives it by `pickle` maps the file again; a forked one inherits the map.

    Args:
        path: the file.

    Attributes:
        path: of the file.
        length: its bytes.
        mtime_ns: time of its last change, nanoseconds.

    Raises:
        ValueError: not a complete file of this format.
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        status = path.stat()
        self.length, self.mtime_ns = status.st_size, status.st_mtime_ns
        self._index = self._find_index()

    @cached_property
    def _map(self) -> mmap.mmap:
        with self.path.open("rb") as file:
            if os.fstat(file.fileno()).st_size != self.length or not self.length:
                raise ValueError(f"{self.path} is not a complete file of decoded samples")
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in vars(self).items() if key != "_map"}

    def records(self) -> Iterator[SampleRecord]:
        """The entries of the index."""
        for *values, sources in json.loads(self._map[self._index]):
            states = tuple(FileState(*state) for state in sources)
            yield SampleRecord._make([*values, states])

    def read(self, record: SampleRecord) -> Sample:
        """The sample as read-only views of the map; nothing is copied.

        Raises:
            ValueError: the file has changed since.
            OSError: it cannot be opened.
        """
        hw = (record.height, record.width)
        pixels = record.height * record.width
        label = self._view(record.offset + 4 * pixels, hw) if record.labelled else None
        return Sample(
            rgb=self._view(record.offset, (*hw, 3)),
            thermal=self._view(record.offset + 3 * pixels, hw),
            label=label,
            name=record.name,
        )

    def is_intact(self, record: SampleRecord) -> bool:
        """Whether the bytes of a sample are those that were written."""
        return zlib.crc32(self._view(record.offset, (record.num_bytes,)).data) == record.crc

    def _view(self, offset: int, shape: tuple[int, ...]) -> Array:
        flat = np.frombuffer(self._map, np.uint8, count=int(np.prod(shape)), offset=offset)
        return flat.reshape(shape)

    def _find_index(self) -> slice:
        end = self.length - END.size
        if end >= 0:
            magic, size, crc = END.unpack_from(self._map, end)
            index = slice(end - size, end)
            if magic == MAGIC and size <= end and zlib.crc32(self._map[index]) == crc:
                return index
        raise ValueError(f"{self.path} is not a complete file of decoded samples")


def _images(sample: Sample) -> list[Array]:
    images = [sample.rgb, sample.thermal, *([] if sample.label is None else [sample.label])]
    return [np.ascontiguousarray(image) for image in images]
