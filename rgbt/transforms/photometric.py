"""Colour jitter in the order of SSD: brightness, contrast, saturation, hue.

One code path for uint8 and float32 images. What the release does to float images differs from what
it means to do, only because OpenCV's HSV has other units there; see `Colours.rgb`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Interval, Predicate, doc
from numpy.typing import NDArray

from rgbt.ranges import GreyLevel, Share, rising

Image = NDArray[Any]
"""(H, W, 3) RGB, or (H, W) of thermal; uint8 or float32, 0..255."""

LEVELS = np.arange(256, dtype=np.uint8)
"""Every value of an 8-bit image."""

WIDEST_VECTOR = 64
"""8-bit values that the widest vector unit takes at a time (AVX-512)."""

Factor = Annotated[float, Interval(ge=0, le=100)]
FactorRange = Annotated[tuple[Factor, Factor], Predicate(rising), doc("the smaller one first")]
HueDelta = Annotated[int, Interval(ge=0, le=180)]


@dataclass(frozen=True)
class ColourJitter:
    """SSD's colour jitter for RGB, and its contrast step for thermal; 0 <= `probability` <= 1.

    Factors and the added brightness (grey levels) are uniform real numbers; the added hue is a
    whole number, both ends included, in OpenCV's units (2 degrees for uint8 images).

    Source: augmentation step 3 of the CRM release (COLOR_AUG_SSD), after SSD (ECCV 2016).
    """

    probability: Share
    brightness_delta: GreyLevel
    contrast_range: FactorRange
    saturation_range: FactorRange
    hue_delta: HueDelta
    thermal_contrast_range: FactorRange

    def draw(self, rng: np.random.Generator) -> Colours:
        """What happens to one example; every draw comes from `rng`."""

        def drawn(low: float, high: float) -> float | None:
            return rng.uniform(low, high) if rng.random() < self.probability else None

        brightness = drawn(-self.brightness_delta, self.brightness_delta)
        # The even odds of the order belong to SSD, whatever the probability of each change.
        contrast_first = bool(rng.random() < 0.5)
        contrast = drawn(*self.contrast_range) if contrast_first else None
        saturation = drawn(*self.saturation_range)
        hue = None
        if rng.random() < self.probability:
            hue = int(rng.integers(-self.hue_delta, self.hue_delta + 1))
        if not contrast_first:
            contrast = drawn(*self.contrast_range)
        thermal = drawn(*self.thermal_contrast_range)
        return Colours(brightness, contrast_first, contrast, saturation, hue, thermal)


@dataclass(frozen=True)
class Colours:
    """Changes of one example, drawn by `ColourJitter.draw`; None where one does not happen.

    `contrast_first` is whether contrast comes before saturation and hue, or after them.
    """

    brightness: float | None
    contrast_first: bool
    contrast: float | None
    saturation: float | None
    hue: int | None
    thermal_contrast: float | None

    def rgb(self, image: Image) -> Image:
        """Brightness; then contrast, saturation, hue or saturation, hue, contrast.

        A uint8 image stays uint8 to the end, which is what is meant. A float32 image becomes uint8
        with the first brightness or contrast change; a saturation or hue change that comes before
        meets a float image, where OpenCV's saturation lies in 0..1 and its hue in 0..360. The
        scaled saturation is then truncated to 0 or 1, and the hue, in whole degrees, is folded
        modulo 180. This is what the release does, whose images are float32.
        """
        if self.brightness is not None:
            image = scale_and_truncate(image, offset=self.brightness)
        if self.contrast_first:
            image = _contrast(image, self.contrast)
        if self.saturation is not None:
            image = scale_saturation(image, self.saturation)
        if self.hue is not None:
            image = shift_hue(image, self.hue)
        return image if self.contrast_first else _contrast(image, self.contrast)

    def thermal(self, image: Image) -> Image:
        """Contrast alone."""
        return _contrast(image, self.thermal_contrast)


def _contrast(image: Image, factor: float | None) -> Image:
    return image if factor is None else scale_and_truncate(image, factor)


def scale_and_truncate(image: Image, factor: float = 1.0, offset: float = 0.0) -> NDArray[np.uint8]:
    """``image * factor + offset``, clipped to 0..255 and truncated to whole numbers (uint8)."""
    if image.dtype == np.uint8:  # the same arithmetic, done once for each of the 256 values
        table = scale_and_truncate(LEVELS.astype(np.float32), factor, offset)
        return np.asarray(cv2.LUT(image, table), np.uint8)
    scaled = image.astype(np.float32) * np.float32(factor) + np.float32(offset)
    return scaled.clip(0, 255).astype(np.uint8)


def scale_saturation(image: Image, factor: float) -> Image:
    """HSV saturation times `factor`, truncated to whole numbers of OpenCV's unit."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    hsv[..., 1] = scale_and_truncate(np.ascontiguousarray(hsv[..., 1]), factor)
    return _rgb_of(hsv)


def shift_hue(image: Image, shift: int) -> Image:
    """Hue, truncated to whole numbers, plus `shift`, modulo 180.

    The unit is OpenCV's: 2 degrees for uint8 and 1 for float32.
    """
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    hsv[..., 0] = (hsv[..., 0].astype(np.int32) + shift) % 180
    return _rgb_of(hsv)


def _rgb_of(hsv: Image) -> Image:
    """HSV to RGB by OpenCV, with a result that does not depend on the position in a row.

    OpenCV 5 truncates in its vector code and rounds in what is left of a row of 8-bit pixels, so
    that a pixel would depend on the width of the image and on the processor. One long row of a
    length that every vector divides has nothing left.
    """
    if hsv.dtype != np.uint8:
        return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))
    pixels = hsv.reshape(-1, 3)
    rest = -len(pixels) % WIDEST_VECTOR
    row = np.concatenate([pixels, np.zeros((rest, 3), np.uint8)]) if rest else pixels
    rgb = cv2.cvtColor(row[None], cv2.COLOR_HSV2RGB)[0, : len(pixels)]
    return np.asarray(rgb).reshape(hsv.shape)
