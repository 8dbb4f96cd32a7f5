"""Decoding of files into RGB, thermal and label arrays, refusing what would be misread.

OpenCV only decodes here. It drops a fourth channel unless told otherwise and returns B, G, R; the
thermal image lies in the alpha slot, so that nothing may treat the four channels as one image.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.types import IGNORE

Array = NDArray[np.uint8]
Counts = NDArray[np.uint16]


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
    advice = "dataset.layout=packed reads images with thermal as fourth channel"
    return read_rgb(rgb_path, advice), _read_thermal(thermal_path)


def read_rgb(path: Path, advice: str = "use the original file") -> Array:
    """RGB (H, W, 3) uint8 of a file of three channels; `advice` says what to do with another one.

    Raises:
        InputError: missing, not decodable, not 8 bit, or other channels.
    """
    rgb = _decode(path)
    if _channels(rgb) != 3:
        raise InputError(
            f"{path}: expected 3 channels (red, green, blue), got {_channels(rgb)}; {advice}."
        )
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_BGR2RGB), np.uint8)


def read_counts(path: Path) -> Counts:
    """Counts of a thermal camera, (H, W) uint16, at their full depth.

    Raises:
        InputError: missing, not decodable, not 16 bit, or several channels.
    """
    counts = _decoded(path)
    if counts.dtype != np.uint16:
        raise InputError(
            f"{path}: expected a thermal image of 16 bits (counts of the camera), got "
            f"{counts.dtype}; use the original file, a converted one no longer holds the counts "
            "that dataset.thermal_range cuts."
        )
    if counts.ndim != 2:
        raise InputError(
            f"{path}: expected a thermal image of one channel, got {counts.shape[2]}; use the "
            "original file."
        )
    return np.asarray(counts, np.uint16)


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
    _check_values(label, num_classes, path)
    return label


def read_label_array(path: Path, num_classes: int) -> Array:
    """Class indices of a `.npy` file, as `read_label`.

    Raises:
        InputError: missing, no array of whole numbers (H, W), or a value that is no class.
    """
    if not path.is_file():
        raise InputError(f"{path} is missing.")
    try:
        label = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path} cannot be read as an array ({error}): the file is damaged or none; replace "
            "it, or use data.on_error=skip to leave it out."
        ) from error
    if not isinstance(label, np.ndarray) or label.dtype.kind not in "iu" or label.ndim != 2:
        what = f"{label.shape} {label.dtype}" if isinstance(label, np.ndarray) else "several arrays"
        raise InputError(
            f"{path}: expected class indices, whole numbers of shape (rows, columns), got {what}; "
            "use the original file."
        )
    _check_values(label, num_classes, path)
    return label.astype(np.uint8)


def _check_values(label: NDArray[Any], num_classes: int, path: Path) -> None:
    wrong = ((label < 0) | (label >= num_classes)) & (label != IGNORE)
    if wrong.any():
        values = ", ".join(str(value) for value in np.unique(label[wrong])[:8])
        raise InputError(
            f"{path}: label value {values} is out of range; expected 0 to {num_classes - 1}, or "
            f"{IGNORE} to ignore a pixel."
        )


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
    image = _decoded(path)
    if image.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 bits per channel, got {image.dtype}.")
    return np.asarray(image, np.uint8)


def _decoded(path: Path) -> NDArray[Any]:
    """The file as it lies: unchanged means at any depth and with every channel."""
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
    return np.asarray(image)


def _channels(image: Array) -> int:
    return 1 if image.ndim == 2 else image.shape[2]
