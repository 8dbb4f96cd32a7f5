"""Decode files into RGB, thermal and label arrays, and refuse files that would be misread.

OpenCV only decodes here. By default it drops a fourth channel, and it returns B, G, R. The thermal
image is in the alpha channel, so the four channels must not be processed as one image.
"""

from __future__ import annotations

import io
import struct
import tokenize
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rgbt.checks import InputError, one_line
from rgbt.data.integrity import JPEG, LEFT_OUT, PNG, read_image, read_whole

Array = NDArray[np.uint8]

UNREADABLE = (
    *(OSError, ValueError, SyntaxError, EOFError, OverflowError, struct.error, zlib.error),
    Image.DecompressionBombError,
)
"""Exceptions of Pillow for damaged files."""


def read_packed(path: Path, advice: str) -> tuple[Array, Array]:
    """RGB (H, W, 3) and thermal (H, W), both uint8, of a file with channels R, G, B, thermal.

    `advice` ends the message about a file of other channels.
    """
    image = _decode(path)
    if channels(image) != 4:
        raise InputError(
            f"{path}: expected 4 channels (red, green, blue, thermal), got {channels(image)}; "
            f"use the original file, or {advice}."
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGB), np.uint8), image[..., 3].copy()


def read_rgb(path: Path, advice: str = "use the original file") -> Array:
    """RGB (H, W, 3) uint8 of a file of three channels; `advice` ends the message about others."""
    rgb = _decode(path)
    if channels(rgb) != 3:
        raise InputError(
            f"{path}: expected 3 channels (red, green, blue), got {channels(rgb)}; {advice}."
        )
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_BGR2RGB), np.uint8)


def read_indices(path: Path) -> NDArray[Any]:
    """Whole numbers (H, W) of an image of one channel, at its own depth, unchanged.

    Of a PNG with a palette the indices are returned, not the colours.

    Raises:
        InputError: missing, not decodable, several channels, or a format that changes values:
            JPEG, and grey PNG of less than 8 bits, which decoders scale.
    """
    data = read_image(path)
    depth, colours = data[24:26] if data.startswith(PNG) and len(data) > 25 else (8, 0)
    if data.startswith(JPEG) or (colours == 0 and depth < 8):
        kind = "a JPEG, which changes values" if data.startswith(JPEG) else f"a PNG of {depth} bit"
        raise InputError(
            f"{path}: expected unchanged class indices, got {kind}; save labels as PNG of 8 bits."
        )
    label = _palette_indices(data, path) if colours == 3 else _decoded(data, path)
    if channels(label) != 1:
        raise InputError(
            f"{path}: expected one channel of class indices, got {channels(label)} channels; "
            "save the indices themselves, not their colours."
        )
    return label


def read_colours(path: Path) -> Array:
    """Colours of a label (H, W, 3) uint8, in the order R, G, B, unchanged.

    Of a PNG with a palette the colours are returned; an opaque fourth channel is dropped.

    Raises:
        InputError: missing, not decodable, not 8 bit, other channels, or a JPEG.
    """
    data = read_image(path)
    if data.startswith(JPEG):
        raise InputError(
            f"{path}: expected unchanged colours, got a JPEG, which changes them; save labels as "
            "PNG."
        )
    image = _decoded(data, path)
    if channels(image) == 4 and (image[..., 3] == np.iinfo(image.dtype).max).all():
        image = image[..., :3]
    if channels(image) != 3 or image.dtype != np.uint8:
        raise InputError(
            f"{path}: expected colours (red, green, blue of 8 bits), got {channels(image)} "
            f"channel(s) of {image.dtype}; a label of one channel holds indices, see dataset.ids."
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_array(path: Path, what: str) -> NDArray[Any]:
    """The array of a `.npy` file; `what` is the expected content, for the message.

    Raises:
        InputError: missing, damaged, or something else.
    """
    data = read_whole(path)
    if data.startswith(b"PK"):
        raise InputError(f"{path}: expected {what}, got several arrays; use the original file.")
    try:
        array: NDArray[Any] = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, MemoryError, tokenize.TokenError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path} cannot be read as an array ({one_line(error)}): the file is damaged or not "
            f"an array; {LEFT_OUT}."
        ) from error
    return array


def decode(path: Path) -> NDArray[Any]:
    """An image as written, (H, W) or (H, W, C) in the order B, G, R: any depth, every channel.

    All readers of images raise its InputError: missing, cut short, not decodable; and one for
    another depth, or other channels, than they name.
    """
    return _decoded(read_image(path), path)


def channels(image: NDArray[Any]) -> int:
    """Channels of (H, W) or (H, W, C)."""
    return 1 if image.ndim == 2 else image.shape[2]


def _decode(path: Path) -> Array:
    image = decode(path)
    if image.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 bits per channel, got {image.dtype}.")
    return np.asarray(image, np.uint8)


def _decoded(data: bytes, path: Path) -> NDArray[Any]:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:  # a header with more pixels than possible
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError(f"{path} cannot be decoded, because its pixels do not fit") from error
        image = None
    if image is None:
        raise InputError(
            f"{path} cannot be decoded, because the file is damaged or not an image; {LEFT_OUT}."
        )
    return np.asarray(image)


def _palette_indices(data: bytes, path: Path) -> Array:
    # OpenCV returns the colours of the palette, which do not determine the indices.
    try:
        with Image.open(io.BytesIO(data)) as image:
            return np.array(image, np.uint8)
    except UNREADABLE as error:
        raise InputError(
            f"{path} cannot be decoded, because the file is damaged or not an image; {LEFT_OUT}."
        ) from error
