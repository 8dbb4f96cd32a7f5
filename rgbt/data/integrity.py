"""Read the bytes of a file, and refuse damaged files.

Some decoders accept damaged files without an error. Refused here are a truncated image, a wrong
checksum, a broken link, and a folder or a pipe instead of a file. Decoding is in `rgbt.data.files`.
"""

from __future__ import annotations

import os
import zlib
from functools import lru_cache
from pathlib import Path

from rgbt.checks import InputError

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
"""First bytes of these formats, independent of the suffix of the name."""

PNG_END = b"IEND\xaeB`\x82"
"""The last chunk of every PNG, with its checksum but without its length, which is 0."""

JPEG_SCAN, JPEG_END = 0xDA, b"\xff\xd9"

LEFT_OUT = "replace it, or skip unreadable files with data.on_error=skip"


def read_whole(path: Path, advice: str = LEFT_OUT) -> bytes:
    """Every byte of `path`; `advice` is the end of the message.

    Raises:
        InputError: a missing file, a broken link, not a regular file, no permission, or an error of
            the disk.
    """
    try:
        if path.exists() and not path.is_file():  # a pipe would be waited for
            raise InputError(f"{path} is not a regular file; {advice}.")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        why = ""
        if os.path.islink(path):  # noqa: PTH114
            why = (
                f": it is a link to {path.readlink()}, which does not exist; restore that file, "
                "or skip unreadable files with data.on_error=skip"
            )
        raise InputError(f"{path} is missing{why}.") from None
    except PermissionError:
        raise InputError(
            f"{path} cannot be read: permission denied; allow access (chmod a+r, and a+x for the "
            "folders above it), or skip unreadable files with data.on_error=skip."
        ) from None
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); {advice}.") from error


def read_image(path: Path, advice: str = LEFT_OUT) -> bytes:
    """Every byte of an image that is not truncated.

    The checksums of a PNG are compared, so damage cannot change pixels. In a JPEG the end marker
    is searched after the start of the main image, as a thumbnail has an end of its own. JPEG, TIFF
    and BMP have no checksums: damage inside them is refused if the decoder fails, and otherwise
    changes pixels. Bytes after the end are ignored.

    Args:
        path: of the file.
        advice: end of the message for a refused file.

    Raises:
        InputError: as `read_whole`, an empty or truncated file, or a damaged PNG.
    """
    data = read_whole(path, advice)
    if not data:
        raise InputError(f"{path} cannot be decoded, because the file is empty; {advice}.")
    cut_png = data.startswith(PNG) and data.rfind(PNG_END) < 0
    cut_jpeg = data.startswith(JPEG) and data.rfind(JPEG_END, _scan(data)) < 0
    if cut_png or cut_jpeg:
        raise InputError(
            f"{path} cannot be decoded, because the file is truncated (its end is missing after "
            f"{len(data)} bytes, as after an interrupted copy); {advice}."
        )
    if data.startswith(PNG) and not _is_whole_png(data):
        raise InputError(
            f"{path} cannot be decoded, because the file is damaged (a checksum of the PNG does "
            f"not match); {advice}."
        )
    return data


def is_there(path: Path) -> bool:
    """Whether `path` exists; broken links and links without permission count too.

    For readers with their own message for a missing file; `read_whole` reports other errors.
    """
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True
    return True


def read_names(path: Path, key: str) -> tuple[str, ...]:
    """Stripped lines of a list file in order, without empty ones; `key` begins the messages.

    Raises:
        InputError: as `read_whole`, not a text in UTF-8, or no line.
    """
    try:
        text = read_whole(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    except InputError as error:
        raise InputError(f"{key}: {error}") from None
    if "\0" in text:
        raise InputError(
            f"{key}: '{path}' is not UTF-8 text; give a list of one name per line, saved as plain "
            "text."
        )
    names = tuple(line.strip() for line in text.splitlines() if line.strip())
    if not names:
        raise InputError(f"{key}: the list '{path}' is empty; expected one name per line.")
    return names


def within(path: Path, root: Path) -> Path:
    """`path`, if it is below `root` after resolving all links.

    A reader checks every file that it opens: a line of a list may contain "../..", and a link in a
    downloaded folder may lead anywhere. A missing file passes; `read_whole` reports it.

    Raises:
        InputError: it is outside `root`.
    """
    home, found = _resolved(str(root)), _resolved_file(path)
    # `os.path`, because `Path` raises for a folder without permission, which is not outside.
    if found.startswith(home.rstrip(os.sep) + os.sep) or not os.path.exists(found):  # noqa: PTH110
        return path
    raise InputError(
        f"{path} leads out of dataset.root, to {found}. Set dataset.root to the folder that holds "
        "the files themselves, or copy the files (cp -rL, or rgbt prepare)."
    )


def _resolved_file(path: Path) -> str:
    # Folders hold thousands of files: a folder is resolved once, and a file only if it is a link.
    folder, name = os.path.split(path)
    is_plain = name not in ("", os.curdir, os.pardir) and not os.path.islink(path)  # noqa: PTH114
    return f"{_resolved(folder)}{os.sep}{name}" if is_plain else os.path.realpath(path)


@lru_cache(maxsize=4096)
def _resolved(folder: str) -> str:
    return os.path.realpath(folder)


def _is_whole_png(data: bytes) -> bool:
    """Whether the checksum of every chunk up to the last one is correct."""
    at, view = len(PNG), memoryview(data)
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(view[at : at + 4], "big")
        check_sum = int.from_bytes(view[end - 4 : end], "big")
        if end > len(data) or zlib.crc32(view[at + 4 : end - 4]) != check_sum:
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False


def _scan(data: bytes) -> int:
    """Offset of the main image of a JPEG; the length of the file if it ends before."""
    offset = 2
    while 0 <= (offset := data.find(b"\xff", offset)) < len(data) - 3:
        marker = data[offset + 1]
        if marker == JPEG_SCAN:
            return offset
        # 0xFF may be repeated before a marker; every other marker has the length of its segment.
        is_fill = marker == 0xFF
        offset += 1 if is_fill else 2 + int.from_bytes(data[offset + 2 : offset + 4], "big")
    return len(data)
