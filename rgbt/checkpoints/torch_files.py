"""Read files of torch.save: zip archives since torch 1.6, sequences of pickles before.

A zip archive is checked before its content is interpreted. An archive of rgbt ends with its
digest, in the comment of the zip archive:

    sha256 = SHA-256 of the file as torch.save wrote it, that is without the comment

so that a copy carries it. Files without one (older ones, foreign ones) are checked with the CRC-32
of every entry. torch compresses nothing: what an entry declares lies in the file, or is refused.

Tensors of an archive are views of the mapped file. The mapping is private: writing to a tensor does
not reach the file.
"""

from __future__ import annotations

import hashlib
import mmap
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import IO, Any, cast

import torch
from torch import Tensor

from rgbt.checkpoints.names import STORAGES, UNTYPED
from rgbt.checkpoints.pickles import DamagedError, Name, RefusedError, unpickle

COMMENT = b"rgbt sha256 %s"
COMMENT_LENGTH = len(COMMENT % bytes(64))
END = struct.Struct("<4s16xH")
"""Last record of a zip archive: its mark, and the length of the comment behind it."""

END_MARK = b"PK\x05\x06"
LOCAL_HEADER = struct.Struct("<26xHH")
"""Of a zip entry: lengths of name and extra field, behind which the content begins."""

ENCRYPTED = 1
UNREADABLE = (zipfile.BadZipFile, NotImplementedError, ValueError, EOFError, OSError, struct.error)
"""What zipfile raises for a table of contents that is cut short or overwritten."""

MAGIC = 0x1950A86A20F9469CFC6C
"""Value of the first pickle of a file from before 1.6."""

PROTOCOL = 1001
ALIGNED = 8
"""Bytes of the largest number, at a multiple of which numbers are read where they lie."""

BIG_ENDIAN = "was written on a big-endian machine, which is not supported."
Buffer = mmap.mmap | bytes


def mapped(path: Path) -> mmap.mmap:
    """The file as a private memory map; writing to it does not change the file."""
    with path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)


def read_zip(path: Path) -> Any:
    """The value that torch.save wrote into a zip archive.

    Raises:
        RefusedError: another zip archive, a program, another byte order.
        DamagedError: cut short, overwritten.
    """
    buffer = mapped(path)
    listed = _listed(path)
    root = next((name[:-8] for name in listed if name.endswith("data.pkl")), None)
    if root is None:
        raise RefusedError(
            "is a zip archive, but not of torch.save; unpack it and name a file in it."
        )
    if f"{root}constants.pkl" in listed:
        raise RefusedError(
            "is a TorchScript program, which would have to be executed; give a file that holds "
            "its state_dict()."
        )
    spans = _verified(buffer, listed)
    start, end = spans.get(f"{root}byteorder", (0, 0))
    if buffer[start:end] not in (b"", b"little"):
        raise RefusedError(BIG_ENDIAN)

    def locate(key: str, dtype: torch.dtype, count: int) -> Tensor:
        start, end = spans[f"{root}data/{key}"]
        if end - start < count * dtype.itemsize:
            raise DamagedError("a tensor is longer than its entry")
        return _numbers(buffer, start, dtype, count)

    start, end = spans[f"{root}data.pkl"]
    return unpickle(BytesIO(buffer[start:end]), _Storages(locate), NESTED)


def _listed(path: Path) -> dict[str, zipfile.ZipInfo]:
    """The table of contents of a zip archive; nothing of it is verified."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except UNREADABLE as error:
        raise DamagedError("no table of contents") from error
    listed = {entry.filename: entry for entry in entries}
    if len(listed) < len(entries):
        raise DamagedError("two entries have one name")
    return listed


def _verified(
    buffer: mmap.mmap, listed: Mapping[str, zipfile.ZipInfo]
) -> dict[str, tuple[int, int]]:
    """Where the content of every entry begins and ends, by name; all of it is as it was written.

    Raises:
        RefusedError: compressed, encrypted, or made to take far more time than it has bytes.
        DamagedError: digest, checksum or layout are not what was written.
    """
    spans = {name: _span(buffer, entry) for name, entry in listed.items()}
    if sum(end - start for start, end in spans.values()) > len(buffer):
        raise RefusedError.greedy()
    # torch writes no checksums where they are disabled (set_crc32_options).
    if _check_digest(buffer) or not any(entry.CRC for entry in listed.values()):
        return spans
    for name, entry in listed.items():
        with memoryview(buffer) as content, content[slice(*spans[name])] as part:
            if zlib.crc32(part) != entry.CRC:
                raise DamagedError("an entry does not match its checksum")
    return spans


def _span(buffer: mmap.mmap, entry: zipfile.ZipInfo) -> tuple[int, int]:
    """Where the content of a zip entry lies."""
    if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & ENCRYPTED:
        raise RefusedError(
            "is compressed; unpack it and save it with torch.save, or repack it without "
            "compression."
        )
    header = buffer[entry.header_offset : entry.header_offset + LOCAL_HEADER.size]
    if len(header) < LOCAL_HEADER.size:
        raise DamagedError("an entry lies outside the file")
    start = entry.header_offset + LOCAL_HEADER.size + sum(LOCAL_HEADER.unpack(header))
    if start + entry.file_size > len(buffer):
        raise DamagedError("an entry reaches outside the file")
    return start, start + entry.file_size


def _check_digest(buffer: mmap.mmap) -> bool:
    """Whether the file has a digest, which then fits."""
    for length in (0, COMMENT_LENGTH):
        start = len(buffer) - END.size - length
        if start >= 0 and END.unpack(buffer[start : start + END.size]) == (END_MARK, length):
            break
    else:
        raise DamagedError("no end")
    if not length:
        return False
    with memoryview(buffer) as content, content[: -length - 2] as written:
        digest = hashlib.sha256(written)
    digest.update(bytes(2))  # the length of the comment, before there was one
    if buffer[-length:] != COMMENT % digest.hexdigest().encode():
        raise DamagedError("the content does not match its digest")
    return True


def _numbers(buffer: Buffer, start: int, dtype: torch.dtype, count: int) -> Tensor:
    """(count,) numbers at a place in the file."""
    end = start + count * dtype.itemsize
    if end > len(buffer):
        raise DamagedError("the file ends within a tensor")
    if count == 0:
        return torch.empty(0, dtype=dtype)
    if start % ALIGNED or isinstance(buffer, bytes):
        return torch.frombuffer(bytearray(buffer[start:end]), dtype=dtype)
    return torch.frombuffer(buffer, dtype=dtype, count=count, offset=start)


class _Storages:
    """Storages that a pickle refers to, by key.

    Args:
        locate: (key, dtype, count) -> (count,) numbers.
    """

    def __init__(self, locate: Callable[[str, torch.dtype, int], Tensor]) -> None:
        self.locate = locate
        self.found: dict[str, Tensor] = {}

    def __call__(self, reference: Any) -> Tensor:
        """The storage of ("storage", class, key, device, count[, view of another storage]).

        Raises:
            RefusedError: a whole module with its source, which torch kept before 1.0.
        """
        if reference[0] == "module":
            raise RefusedError(
                "holds a whole network with its source code, which would have to be executed; "
                "give a file that holds its state_dict()."
            )
        word, kind, key, _, count, *view = reference
        types = type(kind), type(key), type(count)
        if word != "storage" or types != (Name, str, int) or count < 0:
            raise TypeError("not a storage")
        dtype = STORAGES[kind.full]
        if key not in self.found:
            self.found[key] = self.locate(key, dtype, count)
        storage = self.found[key]
        is_same = storage.dtype == dtype or kind.full == UNTYPED
        if not is_same or storage.nbytes != count * dtype.itemsize:
            raise TypeError("one storage of two types")
        if not view or view[0] is None:
            return storage
        # A part of a storage, as files from before 0.4 have them.
        _, start, length = view[0]
        if min(start, length) < 0 or start + length > len(storage):
            raise DamagedError("a view reaches outside its storage")
        return storage[start : start + length]


def read_pickles(buffer: Buffer) -> tuple[Any, str]:
    """The value of a file that is one pickle, or torch's sequence of pickles and numbers.

    Returns:
        the value, and the name of the format.
    """
    stream = cast(IO[bytes], buffer) if isinstance(buffer, mmap.mmap) else BytesIO(buffer)
    first = unpickle(stream, extra=NESTED)
    if first != MAGIC or type(first) is not int:
        return first, "pickle"
    return _sequence(buffer, stream, NESTED), "torch.save before 1.6"


def _sequence(buffer: Buffer, stream: IO[bytes], extra: Mapping[str, Any]) -> Any:
    """What follows the magic number: protocol, machine, value, keys, numbers."""
    protocol, machine = unpickle(stream), unpickle(stream)
    if protocol != PROTOCOL or not isinstance(machine, dict):
        raise DamagedError("another protocol")
    if machine.get("little_endian") is not True:
        raise RefusedError(BIG_ENDIAN)
    left = len(buffer)

    def reserve(_: str, dtype: torch.dtype, count: int) -> Tensor:
        """Memory for numbers that are read later, never more than the file holds."""
        nonlocal left
        left -= count * dtype.itemsize
        if left < 0:
            raise DamagedError("the file ends within a tensor")
        return torch.empty(count, dtype=dtype)

    storages = _Storages(reserve)
    value = unpickle(stream, storages, extra)
    keys = unpickle(stream)
    if type(keys) is not list or sorted(keys) != sorted(storages.found):
        raise DamagedError("other storages than the pickle names")
    for storage in (storages.found[key] for key in keys):
        start = stream.tell() + 8
        if int.from_bytes(buffer[start - 8 : start], "little") != len(storage):
            raise DamagedError("a storage is not as long as announced")
        storage.copy_(_numbers(buffer, start, storage.dtype, len(storage)))
        stream.seek(start + storage.nbytes)
    return value


def _nested(content: Any) -> Tensor:
    """A storage that lies as a whole file in a pickle: tensors written by plain pickle."""
    stream = BytesIO(content)
    if unpickle(stream) != MAGIC:
        raise TypeError("not a file of torch.save")
    storage = _sequence(content, stream, {})
    if not isinstance(storage, Tensor):
        raise TypeError("not a storage")
    return storage


NESTED = {"torch.storage._load_from_bytes": _nested}
"""What a whole file may call besides; a file inside it may not, so that there is one level."""
