"""Zip archives of torch.save, checked before anything in them is made sense of.

A file of ours ends with its digest, in the comment that every zip archive may have:

    sha256 = SHA-256 of the file as torch.save wrote it, that is without the comment

so that a copy carries it. Files without one (older ones, foreign ones) are held against the CRC-32
of every entry. torch compresses nothing: what an entry declares lies in the file, or is refused.
"""

from __future__ import annotations

import hashlib
import mmap
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

from rgbt.checkpoints.records import DamagedError, RefusedError

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


def mapped(path: Path) -> mmap.mmap:
    """The file as memory that is read where it is touched; writing to it leaves the file alone."""
    with path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)


def comment_of(digest: str) -> bytes:
    """The comment for a SHA-256 in hexadecimal."""
    return COMMENT % digest.encode()


def listed_in(path: Path) -> dict[str, zipfile.ZipInfo]:
    """The table of contents of a zip archive; nothing of it is verified.

    Raises:
        DamagedError: there is none, or two entries have one name.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except UNREADABLE as error:
        raise DamagedError("no table of contents") from error
    listed = {entry.filename: entry for entry in entries}
    if len(listed) < len(entries):
        raise DamagedError("two entries have one name")
    return listed


def verified(
    buffer: mmap.mmap, listed: Mapping[str, zipfile.ZipInfo]
) -> dict[str, tuple[int, int]]:
    """Where the content of every entry begins and ends, by name; all of it is as it was written.

    Args:
        buffer: the file, mapped.
        listed: its table of contents.

    Raises:
        RefusedError: compressed, encrypted, or made to take far more time than it has bytes.
        DamagedError: digest, checksum or layout are not what was written.
    """
    found = {name: _span(buffer, entry) for name, entry in listed.items()}
    if sum(end - start for start, end in found.values()) > len(buffer):
        raise RefusedError.greedy()
    # torch writes no checksums where they are disabled (set_crc32_options).
    if _check_digest(buffer) or not any(entry.CRC for entry in listed.values()):
        return found
    for name, entry in listed.items():
        with memoryview(buffer) as content, content[slice(*found[name])] as part:
            if zlib.crc32(part) != entry.CRC:
                raise DamagedError("an entry is not what its checksum says")
    return found


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
    if buffer[-length:] != comment_of(digest.hexdigest()):
        raise DamagedError("the content is not what its digest says")
    return True


def _span(buffer: mmap.mmap, entry: zipfile.ZipInfo) -> tuple[int, int]:
    """Where the content of a zip entry lies."""
    if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & ENCRYPTED:
        raise RefusedError(
            "was packed again with compression; unpack it and pack it with torch.save, or store it "
            "uncompressed."
        )
    header = buffer[entry.header_offset : entry.header_offset + LOCAL_HEADER.size]
    if len(header) < LOCAL_HEADER.size:
        raise DamagedError("an entry lies outside the file")
    start = entry.header_offset + LOCAL_HEADER.size + sum(LOCAL_HEADER.unpack(header))
    if start + entry.file_size > len(buffer):
        raise DamagedError("an entry reaches outside the file")
    return start, start + entry.file_size
