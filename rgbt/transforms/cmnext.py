"""The augmentation of the CMNeXt release: colours, mirror, blur, resize by a factor, crop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Interval, Predicate, doc
from numpy.typing import NDArray

from rgbt.ranges import Pixels, Share, Size, rising
from rgbt.requirements import Record
from rgbt.transforms.cmx import padded
from rgbt.transforms.example import evaluated, image_hw, viewed
from rgbt.transforms.joint import View
from rgbt.transforms.photometric import FactorRange
from rgbt.types import Example, Sample

Pixels8 = NDArray[np.uint8]
SizeFactor = Annotated[float, Interval(ge=0.01, le=16)]
SizeFactors = Annotated[
    tuple[SizeFactor, SizeFactor], Predicate(rising), doc("smallest and largest factor")
]
Deviation = Annotated[float, Interval(gt=0, le=10), doc("pixels")]
LUMA = (0.2989, 0.587, 0.114)
"""Shares of R, G, B in the luma of torchvision."""


@dataclass(frozen=True, kw_only=True)
class CmnextTransform:
    """Colours and blur of RGB, mirror, resize by a drawn factor, crop; the rest is black padding.

    Source: CMNeXt release (DELIVER), MFNet configuration; colours and blur as torchvision makes
    them of 8-bit images, resizing without smoothing. The release normalises after padding, so that
    padding is black, and not the mean, for the network.

    Attributes:
        colour_probability: that brightness, contrast and saturation of RGB change, all three.
        colour_range: smallest and largest factor of each of them.
        flip_probability: in [0, 1].
        blur_probability: that RGB is blurred by a Gaussian kernel of 3x3 pixels.
        blur_deviation: of this kernel.
        scale_range: smallest and largest factor of both sides of the file, drawn uniformly.
        crop_hw: size of the result in pixels, always.
        test_short_edge: short edge of evaluated images in pixels; None keeps their size.
        track_position: whether examples carry the map of source positions.
    """

    colour_probability: Share
    colour_range: FactorRange
    flip_probability: Share
    blur_probability: Share
    blur_deviation: Deviation
    scale_range: SizeFactors
    crop_hw: Size
    test_short_edge: Pixels | None
    track_position: bool

    @property
    def record(self) -> Record:
        """The size of its examples."""
        return Record(crop_hw=self.crop_hw)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example of `crop_hw`; what is padding is 0, and 255 in its label."""
        rgb = sample.rgb
        if rng.random() < self.colour_probability:
            rgb = recoloured(rgb, *rng.uniform(*self.colour_range, size=3))
        flipped = bool(rng.random() < self.flip_probability)
        # A symmetric kernel: blurred before it is mirrored is the same as after it.
        if rng.random() < self.blur_probability:
            rgb = np.asarray(cv2.GaussianBlur(rgb, (3, 3), self.blur_deviation), np.uint8)
        source_hw = image_hw(sample)
        factor = float(rng.uniform(*self.scale_range))
        resized_hw = max(1, round(source_hw[0] * factor)), max(1, round(source_hw[1] * factor))
        top, height = draw_offset(resized_hw[0], self.crop_hw[0], rng)
        left, width = draw_offset(resized_hw[1], self.crop_hw[1], rng)
        # The release cuts the mirrored image; a view cuts first, so its window is mirrored.
        corner_yx = (top, resized_hw[1] - left - width if flipped else left)
        view = View(source_hw, resized_hw, corner_yx, (height, width), flipped)
        example = viewed(
            replace(sample, rgb=rgb), view, np.uint8, track_position=self.track_position
        )
        return padded(example, self.crop_hw, np.zeros(3), 0, corner_yx=(0, 0))

    def test(self, sample: Sample) -> Example:
        """Whole image, resized to `test_short_edge` where that is set; the label as it is."""
        return evaluated(sample, self.test_short_edge, track_position=self.track_position)


def draw_offset(length: int, crop: int, rng: np.random.Generator) -> tuple[int, int]:
    """First pixel and number of pixels of a crop along one axis.

    Every first pixel from 0 to max(length - crop, 0) + 1 is as likely. The last one lies one too
    far: a pixel of the crop is missing, also where the whole axis would fit.

    Source: CMNeXt release.

    Args:
        length: of the axis in pixels.
        crop: wanted length in pixels.
        rng: the draw comes from here.
    """
    first = min(int(rng.integers(max(length - crop, 0) + 2)), length - 1)
    return first, min(crop, length - first)


def recoloured(image: Pixels8, brightness: float, contrast: float, saturation: float) -> Pixels8:
    """Factors of brightness, contrast and saturation, one after the other.

        mix(x, y, f) = f x + (1 - f) y, clipped to 0..255 and truncated
        a = mix(x, 0, brightness),  b = mix(a, mean luma of a, contrast)
        result = mix(b, luma of b, saturation)

    Source: torchvision (adjust_brightness, adjust_contrast, adjust_saturation).

    `image` is (H, W, 3); factors are at least 0, 1 changes nothing.
    """
    image = _mixed(image, np.zeros(1, np.float32), brightness)
    image = _mixed(image, luma(image).mean(dtype=np.float32), contrast)
    return _mixed(image, luma(image)[..., None], saturation)


def luma(image: Pixels8) -> Pixels8:
    """(H, W, 3) RGB -> (H, W), truncated."""
    return (image.astype(np.float32) @ np.array(LUMA, np.float32)).astype(np.uint8)


def _mixed(image: Pixels8, other: NDArray[np.generic] | np.generic, factor: float) -> Pixels8:
    share = np.float32(factor)
    mixed = share * image.astype(np.float32) + (1 - share) * np.asarray(other, np.float32)
    return mixed.clip(0, 255).astype(np.uint8)
