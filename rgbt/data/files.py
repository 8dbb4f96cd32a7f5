"""Decoding of PNG files into RGB, thermal and label arrays, refusing what would be misread.

OpenCV only decodes here. It drops a fourth channel unless told otherwise and returns B, G, R; the
thermal image lies in the alpha slot, so that nothing may treat the four channels as one image.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.types import IGNORE

Array = NDArray[np.uint8]


def read_packed(path: Path) -> tuple[Array, Array]:
    """RGB (H, W, 3) and thermal (H, W), both uint8, of a file with channels R, G, B, thermal.

    Raises:
        InputError: missing, not decodable, not 8 bit, or not four channels.
    """
    image = _decode(path)
    if _channels(image) != 4:
        raise InputError(
            f"{path}: expected 4 channels (red, green, blue, thermal), got {_channels(image)}; "
            "use the original file, or dataset.layout=folders for separate images."
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGB), np.uint8), image[..., 3].copy()


def read_channels(rgb_path: Path, thermal_path: Path) -> tuple[Array, Array]:
    """RGB (H, W, 3) and thermal (H, W), both uint8, of two files.

    Thermal may have one channel or three equal ones.

    Raises:
        InputError: missing, not decodable, not 8 bit, or other channels.
    """
    rgb = _decode(rgb_path)
    if _channels(rgb) != 3:
        raise InputError(
            f"{rgb_path}: expected 3 channels (red, green, blue), got {_channels(rgb)}; "
            "dataset.layout=packed reads images with thermal as fourth channel."
        )
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_BGR2RGB), np.uint8), _read_thermal(thermal_path)


def read_label(path: Path, num_classes: int) -> Array:
    """Class indices (H, W) uint8 below `num_classes`, or 255 = ignore.

    Raises:
        InputError: missing, not decodable, not 8 bit, several channels, or another value.
    """
    label = _decode(path)
    if _channels(label) != 1:
        raise InputError(
            f"{path}: expected one channel of class indices, got {_channels(label)} channels; "
            "save the indices themselves, not their colours."
        )
    wrong = (label >= num_classes) & (label != IGNORE)
    if wrong.any():
        values = ", ".join(str(value) for value in np.unique(label[wrong])[:8])
        raise InputError(
            f"{path}: label value {values} is out of range; expected 0 to {num_classes - 1}, or "
            f"{IGNORE} to ignore a pixel."
        )
    return label


def _read_thermal(path: Path) -> Array:
    thermal = _decode(path)
    if thermal.ndim == 2:
        return thermal
    equal = (thermal[..., :1] == thermal[..., 1:]).all()
    if _channels(thermal) != 3 or not equal:
        raise InputError(
            f"{path}: expected a thermal image of one channel or three equal ones, got "
            f"{_channels(thermal)} channels{'' if equal else ' that differ'}."
        )
    return thermal[..., 0].copy()


def _decode(path: Path) -> Array:
    if not path.is_file():
        copies = (
            "; the list names a mirrored copy: write it, or point dataset.splits to a list without "
            "such names"
        )
        raise InputError(f"{path} is missing{copies if path.stem.endswith('_flip') else ''}.")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(
            f"{path} cannot be decoded, the file is damaged or no image; replace it, or use "
            "data.on_error=skip to leave it out."
        )
    if image.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 bits per channel, got {image.dtype}.")
    return np.asarray(image, np.uint8)


def _channels(image: Array) -> int:
    return 1 if image.ndim == 2 else image.shape[2]
