"""The augmentation chain of CRM and SpatialSeg: resize, crop, flip, colours of SSD."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.ranges import GreyLevel, Lengths, Pixels, Rising, Share, Size
from rgbt.requirements import TransformRecord
from rgbt.transforms.maps import Maps, drawn_window, evaluated, short_edge_hw
from rgbt.types import Example, Sample

# (H, W, 3) RGB, or (H, W) of thermal; uint8 or float32, 0..255.
Image = NDArray[Any]

# Every value of an 8-bit image.
LEVELS = np.arange(256, dtype=np.uint8)

Factor = Annotated[float, Interval(ge=0, le=100)]


@dataclass(frozen=True, kw_only=True)
class CrmTransform:
    """Resizes the short edge to a drawn length, crops, flips, jitters colours.

    Factors and the added brightness (grey levels) are uniform real numbers; the added hue is a
    whole number, both ends included, in OpenCV's units (2 degrees for uint8 images). Thermal gets
    the contrast step alone.

    Source: CRM, Sec. 4.1 (implementation details), and its release (COLOR_AUG_SSD, after SSD, ECCV
    2016); SpatialSeg uses the same chain.
    Paper: images are uint8 to the end, resized ones rounded: ``colour="intended"``.
    Released: images are float32 before resizing, and become uint8 with the first brightness or
        contrast change; saturation and hue changes before that meet a float image, where OpenCV's
        saturation lies in 0..1 and its hue in 0..360. So the scaled saturation is truncated to 0 or
        1, and the hue, in whole degrees, is folded modulo 180: ``colour="released"``.
    """

    colour_probability: Share
    brightness_delta: GreyLevel
    contrast_range: Rising[Factor]
    saturation_range: Rising[Factor]
    hue_delta: Annotated[int, Interval(ge=0, le=180)]
    thermal_contrast_range: Rising[Factor]
    sizes: Lengths | None
    max_size: Pixels | None
    crop_hw: Size | None
    flip_probability: Share
    colour: Literal["intended", "released"]
    test_short_edge: Pixels | None
    track_position: bool

    @property
    def dtype(self) -> type[np.uint8 | np.float32]:
        """Return the type of the images of its examples."""
        return np.uint8 if self.colour == "intended" else np.float32

    @property
    def record(self) -> TransformRecord:
        """State the size of its examples."""
        return TransformRecord(crop_hw=self.crop_hw)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Make an augmented example."""
        maps = Maps.of(sample)
        hw = maps.hw
        if self.sizes is not None:
            hw = short_edge_hw(hw, int(rng.choice(self.sizes)), self.max_size)
        window = drawn_window(hw, self.crop_hw or hw, rng)
        flipped = rng.random() < self.flip_probability
        # Colours change pixel by pixel, so that it does not matter that the flip comes before.
        shown = maps.resize(hw, window, dtype=self.dtype).flip(flipped)
        example = shown.example(self.track_position)
        rgb, thermal = (
            image.astype(self.dtype, copy=False)
            for image in self.coloured(example.rgb, example.thermal, rng)
        )
        return replace(example, rgb=rgb, thermal=thermal)

    def test(self, sample: Sample) -> Example:
        """Resize the whole image to `test_short_edge` where that is set; the label stays."""
        sizes, track = (self.test_short_edge, self.max_size), self.track_position
        return evaluated(sample, *sizes, track_position=track, dtype=self.dtype)

    def coloured(self, rgb: Image, thermal: Image, rng: np.random.Generator) -> tuple[Image, Image]:
        """Change RGB and thermal as drawn from `rng`."""

        def changed(image: Image, change: Callable[..., Image], low: float, high: float) -> Image:
            happens = rng.random() < self.colour_probability
            return change(image, rng.uniform(low, high)) if happens else image

        delta = self.brightness_delta
        rgb = changed(rgb, lambda image, by: scale_and_truncate(image, 1.0, by), -delta, delta)
        # The even odds of the order belong to SSD, whatever the probability of each change.
        contrast_first = rng.random() < 0.5
        if contrast_first:
            rgb = changed(rgb, scale_and_truncate, *self.contrast_range)
        rgb = changed(rgb, scale_saturation, *self.saturation_range)
        if rng.random() < self.colour_probability:
            rgb = shift_hue(rgb, int(rng.integers(-self.hue_delta, self.hue_delta + 1)))
        if not contrast_first:
            rgb = changed(rgb, scale_and_truncate, *self.contrast_range)
        return rgb, changed(thermal, scale_and_truncate, *self.thermal_contrast_range)


def scale_and_truncate(image: Image, factor: float = 1.0, offset: float = 0.0) -> NDArray[np.uint8]:
    """Return ``image * factor + offset``, clipped to 0..255, truncated to whole numbers (uint8)."""
    if image.dtype == np.uint8:  # the same arithmetic, done once for each of the 256 values
        table = scale_and_truncate(LEVELS.astype(np.float32), factor, offset)
        return np.asarray(cv2.LUT(image, table), np.uint8)
    scaled = image.astype(np.float32) * np.float32(factor) + np.float32(offset)
    return scaled.clip(0, 255).astype(np.uint8)


def scale_saturation(image: Image, factor: float) -> Image:
    """Multiply HSV saturation by `factor`, truncated to whole numbers of OpenCV's unit."""
    return with_hsv(image, 1, lambda saturation: scale_and_truncate(saturation, factor))


def shift_hue(image: Image, shift: int) -> Image:
    """Add `shift` to the hue, truncated to whole numbers of OpenCV's unit, modulo 180."""
    return with_hsv(image, 0, lambda hue: (hue.astype(np.int32) + shift) % 180)


def with_hsv(image: Image, channel: int, change: Callable[[Image], Image]) -> Image:
    """Change a channel of the HSV of RGB, in OpenCV's units for the dtype of `image`.

    OpenCV 5 truncates in its vector code and rounds in what is left of a row of 8-bit pixels, so
    that a pixel would depend on the width of the image and on the processor. One long row of a
    length that every vector divides has nothing left.
    """
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    if hsv.dtype != np.uint8:
        hsv[..., channel] = change(hsv[..., channel])
        return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))
    tables = np.repeat(LEVELS[:, None], 3, axis=1)
    tables[:, channel] = change(LEVELS)
    pixels = cv2.LUT(hsv, tables[None]).reshape(-1, 3)
    # AVX-512, the widest vector unit, takes 64 values at a time.
    row = np.concatenate([pixels, np.zeros((-len(pixels) % 64, 3), np.uint8)])
    rgb = cv2.cvtColor(row[None], cv2.COLOR_HSV2RGB)[0, : len(pixels)]
    return np.asarray(rgb).reshape(hsv.shape)
