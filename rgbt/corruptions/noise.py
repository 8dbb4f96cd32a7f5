"""Noise of the sensor."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import check_range
from rgbt.corruptions.corruption import IMAGES, NAMES, Images, RngOf, Severities, check_ladder
from rgbt.types import Sample


class Noise:
    """Gaussian noise on every pixel and channel, independent, rounded and cut at 0 and 255.

    Cutting makes it smaller where the image is nearly black or white.

    Args:
        image: which images are noisy.
        severities: standard deviations in grey levels (0..255).

    Raises:
        InputError: a severity out of range.
    """

    unit = "grey levels (std)"

    def __init__(self, *, image: Images, severities: Severities) -> None:
        self.image: Images = image
        self.severities = severities
        self.title = f"noise, {NAMES[image]}"
        check_ladder(self)

    def check(self, severity: float) -> None:
        """A standard deviation in grey levels, above 0 and up to 255."""
        check_range("severity (standard deviation in grey levels)", severity, 0, 255)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """See `OfPixels`."""
        changed: dict[str, Any] = {
            image: _noisy(getattr(sample, image), severity, rng_of(f"noise {image}"))
            for image in IMAGES[self.image]
        }
        return replace(sample, **changed)


def _noisy(image: NDArray[np.uint8], std: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    return np.rint(image + np.float32(std) * noise).clip(0, 255).astype(np.uint8)
