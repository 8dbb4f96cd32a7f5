"""The bytes of a file, read once, or the sentence that says why it cannot be had whole.

What decoders pass over in silence is refused here: an image that ends before its end or does not
agree with its check sums, a link that leads nowhere, a folder or a pipe in the place of a file. So
is an image that would fill the memory. What the bytes mean is said by `rgbt.data.files`.
"""

from __future__ import annotations

import io
import math
import os
import struct
import warnings
import zlib
from functools import lru_cache
from pathlib import Path

from PIL import Image

from rgbt.checks import InputError
from rgbt.files.budgets import CONTENT, PIXELS, read_bytes

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
"""How files of these kinds begin, whatever their names end in."""

PNG_END = b"IEND\xaeB`\x82"
"""The last chunk of every PNG without its length, which is 0, and with its check sum."""

JPEG_SCAN, JPEG_END = 0xDA, b"\xff\xd9"

Image.MAX_IMAGE_PIXELS = None  # `PIXELS` is checked instead, which the user can set
warnings.filterwarnings("ignore", module=r"PIL\.")  # on damaged files, which are refused

LEFT_OUT = "replace it, or use data.on_error=skip to leave it out"


UNREADABLE = (OSError, ValueError, SyntaxError, EOFError, OverflowError, struct.error)
"""What Pillow raises on headers that are damaged, or of no image."""


def read_whole(path: Path, advice: str = LEFT_OUT) -> bytes:
    """Every byte of `path`; `advice` says what to do without it.

    Raises:
        InputError: nothing is there, a link that leads nowhere, no regular file, no permission,
            larger than `CONTENT` allows, or a fault of the disk.
    """
    try:
        return read_bytes(path, CONTENT, advice)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path} is missing{_why_missing(path)}.") from None
    except PermissionError:
        raise InputError(
            f"{path} may not be read, permission is denied; allow it (chmod a+r, and a+x for the "
            "folders above it), or use data.on_error=skip to leave it out."
        ) from None
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); {advice}.") from error


def read_image(path: Path, advice: str = LEFT_OUT) -> bytes:
    """Every byte of an image that is not cut short and not too large.

    The check sums of a PNG are compared, so that no other pixels come out of a damaged one. Of a
    JPEG the marker of the end comes after the beginning of the picture: a thumbnail before it has
    an end of its own. JPEG, TIFF and BMP have no check sums: damage inside them is refused where
    the decoder cannot go on, and gives other pixels where it can. Bytes after the end do no harm.

    Args:
        path: of the file.
        advice: what to do with a file that is refused.

    Raises:
        InputError: as `read_whole`, an empty file, one that ends before its end, a damaged PNG, or
            more pixels than `PIXELS` allows.
    """
    data = read_whole(path, advice)
    if not data:
        raise InputError(f"{path} cannot be decoded, the file is empty; {advice}.")
    cut_png = data.startswith(PNG) and data.rfind(PNG_END) < 0
    cut_jpeg = data.startswith(JPEG) and data.rfind(JPEG_END, _scan(data)) < 0
    if cut_png or cut_jpeg:
        raise InputError(
            f"{path} cannot be decoded, the file is cut short (its end is missing after "
            f"{len(data)} bytes, as after an interrupted copy); {advice}."
        )
    if data.startswith(PNG) and not _is_whole_png(data):
        raise InputError(
            f"{path} cannot be decoded, the file is damaged (a check sum of the PNG is another "
            f"one); {advice}."
        )
    try:
        PIXELS.check(path, math.prod(_size(data)))
    except UNREADABLE as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path} cannot be decoded, the file is damaged or no image; {advice}."
        ) from error
    return data


def is_there(path: Path) -> bool:
    """Whether `path` names something: a link that leads nowhere or may not be followed does too.

    For readers that say themselves what a missing file was; `read_whole` says all else.
    """
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True
    return True


def read_names(path: Path, key: str) -> tuple[str, ...]:
    """Lines of a list file, without what surrounds them and without empty ones, in order.

    Args:
        path: text in UTF-8, one name per line.
        key: of the configuration, which names the list; begins the messages.

    Raises:
        InputError: as `read_whole`, no text in UTF-8, or no line.
    """
    try:
        text = read_whole(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    except InputError as error:
        raise InputError(f"{key}: {error}") from None
    if "\0" in text:
        raise InputError(
            f"{key}: '{path}' is no text in UTF-8; give a list of one name per line, saved as "
            "plain text."
        )
    names = tuple(line.strip() for line in text.splitlines() if line.strip())
    if not names:
        raise InputError(f"{key}: the list '{path}' is empty; expected one name per line.")
    return names


def within(path: Path, root: Path) -> Path:
    """`path`, which lies below `root` once every link is followed.

    A reader asks this of every file that it opens: a line of a list may say "../..", and a link in
    a folder that somebody else packed may lead anywhere. A path at which nothing is passes:
    `read_whole` says so.

    Raises:
        InputError: it leads out of `root`.
    """
    home, found = _resolved(str(root)), _resolved_file(path)
    # `os.path` where `Path` would raise: a folder that may not be looked into is no way out.
    if found.startswith(home.rstrip(os.sep) + os.sep) or not os.path.exists(found):  # noqa: PTH110
        return path
    raise InputError(
        f"{path} leads out of dataset.root, to {found}; give dataset.root the folder in which the "
        "files themselves lie, or copy the files (cp -rL, or python -m rgbt.data.prepare)."
    )


def _resolved_file(path: Path) -> str:
    # Folders hold thousands of files: each is followed once, and of a file only its last link.
    folder, name = os.path.split(path)
    is_plain = name not in ("", os.curdir, os.pardir) and not os.path.islink(path)  # noqa: PTH114
    return f"{_resolved(folder)}{os.sep}{name}" if is_plain else os.path.realpath(path)


@lru_cache(maxsize=4096)
def _resolved(folder: str) -> str:
    return os.path.realpath(folder)


def _why_missing(path: Path) -> str:
    if os.path.islink(path):  # noqa: PTH114
        return (
            f": it is a link to {path.readlink()}, where nothing is; restore that file, or use "
            "data.on_error=skip to leave it out"
        )
    if path.stem.endswith("_flip"):
        return (
            "; the list names a mirrored copy: write it, or point dataset.splits to a list without "
            "such names"
        )
    return ""


def _is_whole_png(data: bytes) -> bool:
    """Whether every chunk up to the last one agrees with its check sum."""
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


def _size(data: bytes) -> tuple[int, int]:
    """Pixels by the header; nothing is decoded. The first chunk of a PNG begins with them."""
    if data.startswith(PNG):
        width, height = struct.unpack_from(">II", data, 16)
        return width, height
    with Image.open(io.BytesIO(data)) as image:
        return image.size


def _scan(data: bytes) -> int:
    """Where the picture of a JPEG begins; its length where the file ends before."""
    place = 2
    while 0 <= (place := data.find(b"\xff", place)) < len(data) - 3:
        marker = data[place + 1]
        if marker == JPEG_SCAN:
            return place
        # 0xFF may be repeated before a marker; every other marker says how long its segment is.
        is_fill = marker == 0xFF
        place += 1 if is_fill else 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return len(data)
