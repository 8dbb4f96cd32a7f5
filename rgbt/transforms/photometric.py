"""Colour jitter in the order of SSD: brightness, contrast, saturation, hue.

One code path for uint8 and float32 images. What the release does to float images differs from what
it means to do, only because OpenCV's HSV has other units there; see `ColourJitter.rgb`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_range

Image = NDArray[Any]


@dataclass(frozen=True)
class ColourJitter:
    """SSD's colour jitter for RGB, and its contrast step for thermal.

    Source: augmentation step 3 of the CRM release (COLOR_AUG_SSD), after SSD (ECCV 2016).

    Attributes:
        probability: of each change, in [0, 1]; 0 switches the jitter off.
        brightness_delta: added value is uniform in [-delta, delta], grey levels.
        contrast_range: factor of all channels is uniform in [low, high].
        saturation_range: factor of the HSV saturation is uniform in [low, high].
        hue_delta: added hue is a whole number uniform in -delta..delta, in OpenCV's units (2
            degrees for uint8 images).
        thermal_contrast_range: factor of thermal is uniform in [low, high].

    Raises:
        InputError: a value out of range.
    """

    probability: float
    brightness_delta: float
    contrast_range: tuple[float, float]
    saturation_range: tuple[float, float]
    hue_delta: int
    thermal_contrast_range: tuple[float, float]

    def __post_init__(self) -> None:
        check_range("transform.colour_probability", self.probability, 0, 1)
        check_range("transform.brightness_delta", self.brightness_delta, 0, 255)
        check_range("transform.hue_delta", self.hue_delta, 0, 180)
        for key in ("contrast_range", "saturation_range", "thermal_contrast_range"):
            low, high = getattr(self, key)
            if not 0 <= low <= high:
                raise InputError(
                    f"transform.{key} must be [low, high] with 0 <= low <= high, got "
                    f"[{low:g}, {high:g}]."
                )

    def rgb(self, image: Image, rng: np.random.Generator) -> Image:
        """Brightness; then, with even odds, contrast, saturation, hue or saturation, hue, contrast.

        A uint8 image stays uint8 to the end, which is what is meant. A float32 image becomes uint8
        with the first brightness or contrast change; a saturation or hue change that comes before
        meets a float image, where OpenCV's saturation lies in 0..1 and its hue in 0..360. The
        scaled saturation is then truncated to 0 or 1, and the hue, in whole degrees, is folded
        modulo 180. This is what the release does, whose images are float32.

        Args:
            image: (H, W, 3), uint8 or float32, RGB, 0..255.
            rng: every draw comes from here.

        Returns:
            (H, W, 3), uint8 or float32, 0..255.
        """
        if self._happens(rng):
            delta = rng.uniform(-self.brightness_delta, self.brightness_delta)
            image = scale_and_truncate(image, offset=delta)
        # The even odds of the order belong to SSD, whatever the probability of each change.
        contrast_first = rng.random() < 0.5
        if contrast_first:
            image = self._contrast(image, self.contrast_range, rng)
        image = self._hue(self._saturation(image, rng), rng)
        if not contrast_first:
            image = self._contrast(image, self.contrast_range, rng)
        return image

    def thermal(self, image: Image, rng: np.random.Generator) -> Image:
        """Contrast alone, with its own draw.

        Args:
            image: (H, W), uint8 or float32, 0..255.
            rng: every draw comes from here.
        """
        return self._contrast(image, self.thermal_contrast_range, rng)

    def _happens(self, rng: np.random.Generator) -> bool:
        return bool(rng.random() < self.probability)

    def _contrast(
        self, image: Image, limits: tuple[float, float], rng: np.random.Generator
    ) -> Image:
        return scale_and_truncate(image, rng.uniform(*limits)) if self._happens(rng) else image

    def _saturation(self, image: Image, rng: np.random.Generator) -> Image:
        if not self._happens(rng):
            return image
        return scale_saturation(image, rng.uniform(*self.saturation_range))

    def _hue(self, image: Image, rng: np.random.Generator) -> Image:
        if not self._happens(rng):
            return image
        return shift_hue(image, int(rng.integers(-self.hue_delta, self.hue_delta + 1)))


def scale_and_truncate(image: Image, factor: float = 1.0, offset: float = 0.0) -> NDArray[np.uint8]:
    """``image * factor + offset``, clipped to 0..255 and truncated to whole numbers (uint8)."""
    if image.dtype == np.uint8:  # the same arithmetic, done once for each of the 256 values
        table = scale_and_truncate(np.arange(256, dtype=np.float32), factor, offset)
        return np.asarray(cv2.LUT(image, table), np.uint8)
    scaled = image.astype(np.float32) * np.float32(factor) + np.float32(offset)
    return scaled.clip(0, 255).astype(np.uint8)


def scale_saturation(image: Image, factor: float) -> Image:
    """HSV saturation times `factor`, truncated to whole numbers of OpenCV's unit (see the module).

    Args:
        image: (H, W, 3), uint8 or float32, RGB, 0..255.
        factor: >= 0.

    Returns:
        Same shape and dtype.
    """
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    hsv[..., 1] = scale_and_truncate(hsv[..., 1], factor)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))


def shift_hue(image: Image, shift: int) -> Image:
    """Hue, truncated to whole numbers, plus `shift`, modulo 180 (see the module).

    Args:
        image: (H, W, 3), uint8 or float32, RGB, 0..255.
        shift: in OpenCV's unit, 2 degrees for uint8 and 1 for float32.

    Returns:
        Same shape and dtype.
    """
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    hsv[..., 0] = (hsv[..., 0].astype(np.int32) + shift) % 180
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))
