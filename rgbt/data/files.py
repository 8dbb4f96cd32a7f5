"""Read bytes, lists, images and arrays, and refuse files that would be misread."""

from __future__ import annotations

import io
import os
import struct
import tokenize
import zlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, TiffImagePlugin, UnidentifiedImageError
from PIL.ExifTags import Base

from rgbt.checks import InputError, one_line

Array = NDArray[np.uint8]

FORMATS = ("PNG", "JPEG", "TIFF", "BMP")
# The last bytes of a file in these formats, which decoders do not require.
ENDS = {"PNG": b"\0\0\0\0IEND\xaeB`\x82", "JPEG": b"\xff\xd9"}

# Pillow's modes that are read, and the bits of a channel in memory.
DEPTHS = {"1": 1, "L": 8, "P": 8, "RGB": 8, "RGBA": 8, "I;16": 16, "I;16B": 16, "I": 32, "F": 32}

# Only libtiff refuses a damaged directory of a TIFF; Pillow warns, and reads the rest.
TiffImagePlugin.READ_LIBTIFF = True

# EXIF orientation -> how the stored rows and columns become those that every viewer shows.
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
# Entries of a PNG that may hold an orientation.
WITH_TAGS = ("exif", "Raw profile type exif", "XML:com.adobe.xmp")

# Bytes at the end of a PNG in which tags may follow the pixels.
TAIL = 2**13

LEFT_OUT = "replace it, or skip unreadable files with data.on_error=skip"

# Exceptions of Pillow for damaged files.
UNREADABLE = (
    OSError,
    ValueError,
    SyntaxError,
    EOFError,
    OverflowError,
    struct.error,
    zlib.error,
    TypeError,
    KeyError,
    IndexError,
    Image.DecompressionBombError,
)


def read_bytes(path: Path) -> bytes:
    """Read every byte; InputError for a missing or irregular file, or an error of the system."""
    try:
        if path.exists() and not path.is_file():  # a pipe would be waited for
            raise InputError(f"{path} is not a regular file; {LEFT_OUT}.")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        link = f" (a link to {path.readlink()})" if path.is_symlink() else ""
        raise InputError(f"{path} is missing{link}; {LEFT_OUT}.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); {LEFT_OUT}.") from error


def read_names(path: Path, key: str) -> tuple[str, ...]:
    """Read the stripped lines of a list file in order, without empty ones.

    Raises:
        InputError: as `read_bytes`, not a text in UTF-8, or no line; `key` begins the message.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    except InputError as error:
        raise InputError(f"{key}: {error}") from None
    names = tuple(line.strip() for line in text.splitlines() if line.strip())
    if "\0" in text or not names:
        raise InputError(f"{key}: '{path}': expected a text in UTF-8 with one name per line.")
    return names


def within(path: Path, root: Path) -> Path:
    """Return `path` if it is below `root` after resolving all links; InputError if outside.

    A reader checks every file that it opens: a line of a list may contain "../..", and a link in a
    downloaded folder may lead anywhere. A missing file passes; `read_bytes` reports it.
    """
    home = _resolved(str(root))
    # Folders hold thousands of files: a folder is resolved once, and a file only if it is a link.
    folder, name = os.path.split(path)
    is_plain = name not in ("", os.curdir, os.pardir) and not path.is_symlink()
    found = f"{_resolved(folder)}{os.sep}{name}" if is_plain else os.path.realpath(path)
    # `os.path`, because `Path` raises for a folder without permission, which is not outside.
    if found.startswith(home.rstrip(os.sep) + os.sep) or not os.path.exists(found):  # noqa: PTH110
        return path
    raise InputError(
        f"{path} leads out of dataset.root, to {found}. Set dataset.root to the folder that holds "
        "the files themselves, or copy the files (cp -rL)."
    )


@lru_cache(maxsize=4096)
def _resolved(folder: str) -> str:
    return os.path.realpath(folder)


def opened(path: Path) -> tuple[Image.Image, int]:
    """Decode an image, upright by its EXIF orientation; also returns bits per channel.

    The checksums of a PNG are compared. JPEG, TIFF and BMP have none: damage inside them is
    refused if the decoder fails, and otherwise changes pixels.

    Raises:
        InputError: missing, damaged, another format or colour mode, or more bits than are decoded.
    """
    data = read_bytes(path)
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            image.verify()
        image = Image.open(io.BytesIO(data), formats=FORMATS)
        image.load()
        tags = getattr(image, "tag_v2", {})  # of a TIFF
        # The header of a PNG is its first chunk.
        bits = data[24] if image.format == "PNG" else max(np.ravel(tags.get(258, 8)).tolist())
        is_turned = image.format == "TIFF"  # by `load`
        turn = None if is_turned else TURNS.get(image.getexif().get(Base.Orientation, 1))
    except UNREADABLE as error:
        is_other = isinstance(error, UnidentifiedImageError)  # whose message has an address
        reason = f"no {', '.join(FORMATS)}" if is_other else one_line(error)
        raise InputError(f"{path} cannot be decoded ({reason}); {LEFT_OUT}.") from error
    if ENDS.get(str(image.format), b"") not in data:
        raise InputError(f"{path} cannot be decoded (its end is missing); {LEFT_OUT}.")
    if bits > DEPTHS.get(image.mode, 0):
        raise InputError(
            f"{path}: {image.mode} images of {bits} bits per channel are not read; save 8 bits per "
            "channel, or one channel of 16."
        )
    if turn is None:
        return image, bits
    upright = image.transpose(turn)
    upright.format = image.format
    return upright, bits


def stored_hw(path: Path) -> tuple[int, int]:
    """Return (height, width) of `opened`, but read little of the file; InputError as there."""
    if not path.is_file():
        raise InputError(f"{path} is missing, or no regular file; {LEFT_OUT}.")
    try:
        with path.open("rb") as file, Image.open(file, formats=FORMATS) as image:
            # A TIFF has the size after turning; the tags of a PNG without these would decode it.
            is_plain = image.format == "PNG" and image.info.keys().isdisjoint(WITH_TAGS)
            tags = {} if is_plain or image.format == "TIFF" else image.getexif()
            is_turned = tags.get(Base.Orientation) in range(5, 9)
            width, height = image.size
            file.seek(-min(path.stat().st_size, TAIL), os.SEEK_END)
            is_late = is_plain and b"eXIf" in file.read(TAIL)
    except UNREADABLE as error:
        raise InputError(f"{path} cannot be decoded ({one_line(error)}); {LEFT_OUT}.") from error
    if is_late:
        width, height = opened(path)[0].size
    return (width, height) if is_turned else (height, width)


def values_of(image: Image.Image) -> NDArray[Any]:
    """Return (H, W) or (H, W, C) as decoded; sixteen bits in the order of this machine."""
    array = np.asarray(image)
    return array.astype(np.uint16) if image.mode.startswith("I;16") else array


def decode(path: Path) -> NDArray[Any]:
    """Decode an image as written, (H, W) or (H, W, C) as R, G, B, A; InputError as `opened`.

    Palettes become the colours that are shown.
    """
    image: Image.Image = opened(path)[0]
    if image.mode == "P":
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    return values_of(image)


def decode_bytes(path: Path, number: int, advice: str) -> Array:
    """Decode `number` channels of 8 bits; InputError, which ends in `advice`, for others."""
    image = decode(path)
    if image.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 bits per channel, got {image.dtype}.")
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels != number:
        raise InputError(
            f"{path}: expected {number} channels (red, green, blue{', thermal' * (number == 4)}), "
            f"got {channels}; {advice}."
        )
    return image


def read_packed(path: Path, advice: str) -> tuple[Array, Array]:
    """Read RGB (H, W, 3) and thermal (H, W), both uint8, of a file of R, G, B, thermal."""
    image = decode_bytes(path, 4, f"use the original file, or {advice}")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), np.uint8), image[..., 3].copy()


def read_rgb(path: Path, advice: str = "use the original file") -> Array:
    """Read RGB (H, W, 3) uint8 of a file of three channels; `advice` ends the message else."""
    return decode_bytes(path, 3, advice)


def open_indices(path: Path) -> Image.Image:
    """Decode an image of one channel that holds whole numbers, perhaps with a palette.

    Raises:
        InputError: as `opened`, several channels, or a format that changes values: JPEG, and grey
            PNG of less than 8 bits, which decoders scale.
    """
    image, bits = opened(path)
    whole = image.mode == "P" or (image.mode in ("L", "I", "I;16", "I;16B") and bits >= 8)
    if image.format == "JPEG" or not whole:
        raise InputError(
            f"{path}: expected one channel of class indices of 8 bits, got {image.format} of mode "
            f"{image.mode}; save the indices themselves as PNG, not their colours."
        )
    return image


def read_colours(path: Path) -> Array:
    """Read colours of a label (H, W, 3) uint8, in the order R, G, B, unchanged.

    Of a PNG with a palette the colours are returned; an opaque fourth channel is dropped.

    Raises:
        InputError: as `opened`, a JPEG, one channel, or a pixel that is transparent.
    """
    image, _ = opened(path)
    if image.format == "JPEG" or image.mode not in ("P", "RGB", "RGBA"):
        raise InputError(
            f"{path}: expected unchanged colours (red, green, blue of 8 bits), got {image.format} "
            f"of mode {image.mode}; save a PNG, or read indices instead."
        )
    rgba = np.array(image.convert("RGBA"))
    if (rgba[..., 3] < 255).any():
        raise InputError(f"{path}: some pixels are transparent; save colours without transparency.")
    return np.asarray(cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB), np.uint8)


def read_array(path: Path, what: str) -> NDArray[Any]:
    """Read the array of a `.npy` file; InputError if it is missing, damaged, or not `what`."""
    try:
        file = io.BytesIO(read_bytes(path))
        array = np.load(file, allow_pickle=False)
        if not isinstance(array, np.ndarray) or file.read(1):
            raise ValueError("several arrays, or more bytes than its header announces")
    except InputError:
        raise
    except (ValueError, EOFError, MemoryError, OSError, tokenize.TokenError) as error:
        raise InputError(
            f"{path} cannot be read as an array of {what} ({one_line(error)}); {LEFT_OUT}."
        ) from error
    return array
