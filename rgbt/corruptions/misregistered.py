"""A thermal image that does not lie on the colour image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_range
from rgbt.corruptions.corruption import (
    REFERENCE_HEIGHT,
    RngOf,
    Severities,
    at_height,
    check_ladder,
    nearest_whole,
)
from rgbt.types import Sample

DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""(rows, columns): up, down, left, right."""


class Misregistered:
    """Thermal is moved by n pixels up, down, left or right, as drawn for each image.

    Whole pixels, so that nothing is interpolated and the effect is that of the position alone. What
    comes in from outside repeats the edge: a black stripe would be a corruption of its own. The
    colour image and the label stay.

    Args:
        severities: n in pixels at 480 rows (`REFERENCE_HEIGHT`).

    Raises:
        InputError: a severity out of range.
    """

    title = "misregistered thermal"
    unit = "pixels at 480 rows"

    def __init__(self, *, severities: Severities) -> None:
        self.severities = severities
        check_ladder(self)

    def check(self, severity: float) -> None:
        """A distance in pixels, above 0 and up to half the height."""
        check_range("severity (pixels)", severity, 0, REFERENCE_HEIGHT / 2)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """See `OfPixels`; InputError where the distance is less than half a pixel of the file."""
        height = sample.thermal.shape[0]
        distance = nearest_whole(at_height(severity, height))
        if distance == 0:
            raise InputError(
                f"misregistered by {severity:g} pixels at {REFERENCE_HEIGHT} rows is less than "
                f"half a pixel of an image of {height} rows; give a severity of at least "
                f"{0.5 * REFERENCE_HEIGHT / height:g}."
            )
        rows, columns = DIRECTIONS[int(rng_of("misregistered").integers(len(DIRECTIONS)))]
        return replace(sample, thermal=moved(sample.thermal, rows * distance, columns * distance))


def moved(image: NDArray[np.uint8], down: int, right: int) -> NDArray[np.uint8]:
    """(H, W) `image` moved by whole pixels (negative: up, left); the edge is repeated."""
    rows, columns = (
        np.arange(size) - by for size, by in zip(image.shape, (down, right), strict=True)
    )
    height, width = image.shape
    return np.asarray(image[np.ix_(rows.clip(0, height - 1), columns.clip(0, width - 1))])
