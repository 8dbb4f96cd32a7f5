"""Thermal images of 8 bits, of one channel or of three almost equal ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.files import channels, decode

Array = NDArray[np.uint8]


def read_grey(path: Path, *, advice: str, most_tint: int = 0) -> Array:
    """Grey levels of a thermal image, (H, W) uint8: its one channel, or the mean of its three.

        grey = floor((c1 + c2 + c3) / 3 + 1/2)

    `advice` ends the messages. Channels of a pixel may differ by `most_tint` levels, 0 to 255.

    Raises:
        InputError: as `decode`; not 8 bit, other channels, or channels further apart.
    """
    image = decode(path)
    if image.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 bits per channel, got {image.dtype}; {advice}.")
    if image.ndim == 2:
        return np.asarray(image, np.uint8)
    tint = _tint(image) if channels(image) == 3 else None
    if tint is None or tint > most_tint:
        apart = "" if tint is None else f" that differ by up to {tint} levels"
        within = f" to within {most_tint} levels" if most_tint else ""
        raise InputError(
            f"{path}: expected a thermal image of one channel or of three equal ones{within}, got "
            f"{channels(image)} channels{apart}; {advice}."
        )
    if tint == 0:
        return np.ascontiguousarray(image[..., 0], np.uint8)
    total = image.sum(axis=-1, dtype=np.uint16)
    # A third is never one half, so that halves need no rule: 1/3 goes down, 2/3 up.
    return np.asarray((total + 1) // 3, np.uint8)


def _tint(image: NDArray[np.uint8]) -> int:
    """Largest difference between two channels of one pixel."""
    one, two, three = map(np.asarray, cv2.split(image))
    lowest = np.minimum(np.minimum(one, two), three)
    highest = np.maximum(np.maximum(one, two), three)
    return int((highest - lowest).max())
