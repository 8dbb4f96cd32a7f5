"""An image out of focus."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2

from rgbt.checks import check_range
from rgbt.corruptions.corruption import (
    IMAGES,
    NAMES,
    REFERENCE_HEIGHT,
    Images,
    RngOf,
    Severities,
    at_height,
    check_ladder,
)
from rgbt.types import Sample


class Blur:
    """Gaussian blur; the image is mirrored at its edges.

    Args:
        image: which images are out of focus.
        severities: standard deviations in pixels at 480 rows (`REFERENCE_HEIGHT`).

    Raises:
        InputError: a severity out of range.
    """

    unit = "pixels at 480 rows (sigma)"

    def __init__(self, *, image: Images, severities: Severities) -> None:
        self.image: Images = image
        self.severities = severities
        self.title = f"blur, {NAMES[image]}"
        check_ladder(self)

    def check(self, severity: float) -> None:
        """A standard deviation in pixels, above 0 and up to a quarter of the height."""
        check_range("severity (sigma in pixels)", severity, 0, REFERENCE_HEIGHT / 4)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """See `OfPixels`."""
        del rng_of  # nothing is drawn
        sigma = at_height(severity, sample.thermal.shape[0])
        changed: dict[str, Any] = {
            image: cv2.GaussianBlur(getattr(sample, image), (0, 0), sigma)
            for image in IMAGES[self.image]
        }
        return replace(sample, **changed)
