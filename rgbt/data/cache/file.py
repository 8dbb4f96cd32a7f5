"""One file of decoded frames, and what it says about each of them.

    frames            one after the other, each begins at a multiple of 64 bytes:
                      rgb (H, W, 3), thermal (H, W), label (H, W) where there is one; uint8
    index             JSON, one entry per frame (`Frame`)
    end, 20 bytes     "rgbtdec1", length and CRC-32 of the index

A file is whole or absent: it is written under another name, flushed, renamed. Part of
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

from rgbt.data.cache.stamps import Stamp
from rgbt.types import Sample

MAGIC = b"rgbtdec1"
END = struct.Struct("<8sQI")
ALIGNMENT = 64
"""Bytes; a line of a processor's cache."""

Array = NDArray[np.uint8]


class Frame(NamedTuple):
    """Where a frame lies in its file.

    Attributes:
        name: as the split list has it.
        offset: its first byte.
        height: of all its images, pixels.
        width: the same.
        labelled: whether a label follows the thermal image.
        crc: CRC-32 of its bytes.
        stamps: of the files that it was decoded from.
    """

    name: str
    offset: int
    height: int
    width: int
    labelled: bool
    crc: int
    stamps: tuple[Stamp, ...]

    @property
    def num_bytes(self) -> int:
        """Bytes of rgb, thermal and label."""
        return self.height * self.width * (5 if self.labelled else 4)


def bytes_of(sample: Sample) -> int:
    """Bytes that `sample` takes in a file, but for alignment and index."""
    return sample.thermal.size * (5 if sample.label is not None else 4)


def crc_of(sample: Sample) -> int:
    """CRC-32 of the bytes of `sample` in the order in which they are written."""
    crc = 0
    for image in _images(sample):
        crc = zlib.crc32(image.data, crc)
    return crc


class FrameWriter:
    """Writes one file; nothing lies under its name before `publish`.

    Args:
        path: its final name.

    Attributes:
        length: bytes written so far.
        frames: what has been added.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.length = 0
        self.frames: list[Frame] = []
        self._temporary = path.with_name(f".{path.name}.part")
        self._file = self._temporary.open("wb")

    def add(self, sample: Sample, crc: int, stamps: tuple[Stamp, ...]) -> None:
        """Append a frame; `crc` as of `crc_of`."""
        gap = -self.length % ALIGNMENT
        self._file.write(bytes(gap))
        offset = self.length + gap
        height, width = sample.thermal.shape
        for image in _images(sample):
            self._file.write(image.data)
        frame = Frame(sample.name, offset, height, width, sample.label is not None, crc, stamps)
        self.frames.append(frame)
        self.length = offset + frame.num_bytes

    def publish(self) -> None:
        """Write the index and give the file its name."""
        index = json.dumps(self.frames).encode()
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
            pass  # what a full disk did not take is flushed once more, and fails once more
        finally:
            self._temporary.unlink(missing_ok=True)


class FrameFile:
    """A published file, mapped into memory and read-only.

    A process that gets it by `pickle` makes its own map; one that is forked has it already.

    Args:
        path: the file.

    Attributes:
        path: the same.
        length: its bytes.
        mtime_ns: time of its last change, nanoseconds.

    Raises:
        ValueError: no whole file of this format.
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
                raise ValueError(f"{self.path} is no whole file of decoded frames")
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in vars(self).items() if key != "_map"}

    def frames(self) -> Iterator[Frame]:
        """What its index says."""
        for *where, stamps in json.loads(self._map[self._index]):
            name, offset, height, width, labelled, crc = where
            kept = tuple(Stamp(*stamp) for stamp in stamps)
            yield Frame(name, offset, height, width, labelled, crc, kept)

    def read(self, frame: Frame) -> Sample:
        """The frame as views of the map: nothing is copied, nothing can be written.

        Raises:
            ValueError: the file is another one by now.
            OSError: it cannot be opened.
        """
        hw = (frame.height, frame.width)
        pixels = frame.height * frame.width
        label = self._view(frame.offset + 4 * pixels, hw) if frame.labelled else None
        return Sample(
            rgb=self._view(frame.offset, (*hw, 3)),
            thermal=self._view(frame.offset + 3 * pixels, hw),
            label=label,
            name=frame.name,
        )

    def is_whole(self, frame: Frame) -> bool:
        """Whether the bytes of `frame` are those that were written."""
        return zlib.crc32(self._view(frame.offset, (frame.num_bytes,)).data) == frame.crc

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
        raise ValueError(f"{self.path} is no whole file of decoded frames")


def _images(sample: Sample) -> list[Array]:
    images = [sample.rgb, sample.thermal, *([] if sample.label is None else [sample.label])]
    return [np.ascontiguousarray(image) for image in images]
