"""Augmentations whose examples always have one size: CMX, CMNeXt, RTFNet with MFNet, the thesis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import cv2
import numpy as np
from annotated_types import Interval, Len, Predicate, doc
from numpy.typing import NDArray

from rgbt.ranges import GreyLevel, Pixels, Share, Size, rising
from rgbt.requirements import Record
from rgbt.transforms.crm import FactorRange
from rgbt.transforms.maps import Maps, Window, evaluated, mixed
from rgbt.types import Example, Sample

SizeFactor = Annotated[float, Interval(ge=0.01, le=16)]
SizeFactors = Annotated[
    tuple[SizeFactor, SizeFactor], Predicate(rising), doc("smallest and largest factor")
]
OddPixels = Annotated[
    int,
    Interval(ge=1, le=255),
    Predicate(lambda side: side % 2 == 1),
    doc("an odd number of pixels"),
]
LUMA = (0.2989, 0.587, 0.114)
"""Shares of R, G, B in the luma of torchvision."""


@dataclass(frozen=True, kw_only=True)
class FixedSize:
    """What the transforms here share."""

    crop_hw: Size
    flip_probability: Share
    test_short_edge: Pixels | None
    track_position: bool

    @property
    def record(self) -> Record:
        """The size of its examples."""
        return Record(crop_hw=self.crop_hw)

    def test(self, sample: Sample) -> Example:
        """Whole image, resized to `test_short_edge` where that is set; the label as it is."""
        return evaluated(sample, self.test_short_edge, track_position=self.track_position)


@dataclass(frozen=True, kw_only=True)
class CmxTransform(FixedSize):
    """Mirrors, resizes by a drawn factor, crops; what the image does not fill is padding.

    Source: CMX release (training preprocessing). There, padding is 0 in the normalised images.
    Networks here normalise images themselves (`rgbt.models.inputs`), so padding is their mean
    colour: 0 for them but for rounding to whole grey levels, and, where thermal is repeated for
    three channels of different means, but for the distance of each mean from the three's mean.
    """

    factors: Annotated[tuple[SizeFactor, ...], Len(1, 1000)]
    padding_rgb: tuple[GreyLevel, GreyLevel, GreyLevel]
    padding_order: Literal["rgb", "bgr"]
    padding_thermal: Annotated[tuple[GreyLevel, ...], Len(1, 3)]

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example; what is padding is 255 in its label."""
        maps = Maps.of(sample).flip(bool(rng.random() < self.flip_probability))
        factor = float(rng.choice(self.factors))
        hw = max(1, int(maps.hw[0] * factor)), max(1, int(maps.hw[1] * factor))
        top, height = draw_span(hw[0], self.crop_hw[0], rng)
        left, width = draw_span(hw[1], self.crop_hw[1], rng)
        shown = maps.resize(hw, Window(top, left, height, width))
        rgb = np.rint(self.padding_rgb[:: 1 if self.padding_order == "rgb" else -1])
        padded = shown.pad(self.crop_hw, rgb, np.rint(np.mean(self.padding_thermal)))
        return padded.example(self.track_position)


def draw_span(length: int, crop: int, rng: np.random.Generator) -> tuple[int, int]:
    """First pixel and number of pixels of a crop along one axis.

    All of an axis that is not longer than the crop. Of a longer one, every first pixel from 0 to
    length - crop + 1 is as likely: the last lies one too far, and the crop lacks a pixel.

    Source: CMX release.
    """
    if length <= crop:
        return 0, length
    first = int(rng.integers(length - crop + 2))
    return first, min(crop, length - first)


@dataclass(frozen=True, kw_only=True)
class CmnextTransform(FixedSize):
    """Colours and blur of RGB, mirror, resize by a drawn factor, crop; the rest is black padding.

    Source: CMNeXt release (DELIVER), MFNet configuration; colours and blur as torchvision makes
    them of 8-bit images, resizing without smoothing. The release normalises after padding, so that
    padding is black, and not the mean, for the network.
    """

    colour_probability: Share
    colour_range: FactorRange
    blur_probability: Share
    blur_deviation: Annotated[float, Interval(gt=0, le=10), doc("pixels")]
    scale_range: SizeFactors

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example; what is padding is 0, and 255 in its label."""
        rgb = sample.rgb
        if rng.random() < self.colour_probability:
            rgb = recoloured(rgb, *rng.uniform(*self.colour_range, size=3))
        flipped = bool(rng.random() < self.flip_probability)
        # A symmetric kernel: blurred before it is mirrored is the same as after it.
        if rng.random() < self.blur_probability:
            rgb = np.asarray(cv2.GaussianBlur(rgb, (3, 3), self.blur_deviation), np.uint8)
        maps = Maps.of(replace(sample, rgb=rgb)).flip(flipped)
        hw = scaled_hw(maps.hw, float(rng.uniform(*self.scale_range)))
        top, height = draw_offset(hw[0], self.crop_hw[0], rng)
        left, width = draw_offset(hw[1], self.crop_hw[1], rng)
        shown = maps.resize(hw, Window(top, left, height, width))
        return shown.pad(self.crop_hw, 0, 0, (0, 0)).example(self.track_position)


def scaled_hw(hw: tuple[int, int], factor: float) -> tuple[int, int]:
    """Both sides times a factor, rounded, at least one pixel."""
    return max(1, round(hw[0] * factor)), max(1, round(hw[1] * factor))


def draw_offset(length: int, crop: int, rng: np.random.Generator) -> tuple[int, int]:
    """First pixel and number of pixels of a crop along one axis.

    Every first pixel from 0 to max(length - crop, 0) + 1 is as likely. The last one lies one too
    far: a pixel of the crop is missing, also where the whole axis would fit.

    Source: CMNeXt release.
    """
    first = min(int(rng.integers(max(length - crop, 0) + 2)), length - 1)
    return first, min(crop, length - first)


def recoloured(
    image: NDArray[np.uint8], brightness: float, contrast: float, saturation: float
) -> NDArray[np.uint8]:
    """Factors of brightness, contrast and saturation of (H, W, 3), one after the other.

        mix(x, y, f) = f x + (1 - f) y, clipped to 0..255 and truncated
        a = mix(x, 0, brightness),  b = mix(a, mean luma of a, contrast)
        result = mix(b, luma of b, saturation)

    Source: torchvision (adjust_brightness, adjust_contrast, adjust_saturation).
    """

    def mix(
        image: NDArray[np.uint8], other: NDArray[np.generic] | np.generic | int, factor: float
    ) -> NDArray[np.uint8]:
        share = np.float32(factor)
        both = share * image.astype(np.float32) + (1 - share) * np.asarray(other, np.float32)
        return both.clip(0, 255).astype(np.uint8)

    def luma(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return (image.astype(np.float32) @ np.array(LUMA, np.float32)).astype(np.uint8)

    image = mix(image, 0, brightness)
    image = mix(image, luma(image).mean(dtype=np.float32), contrast)
    return mix(image, luma(image)[..., None], saturation)


@dataclass(frozen=True, kw_only=True)
class RtfnetTransform(FixedSize):
    """Mirrors, cuts a drawn share off every side, stretches what is left to a fixed size.

    Source: RTFNet and MFNet releases (random flip, random crop). RTFNet's paper names the flip
    alone.
    The releases leave the resampling of images to Pillow: nearest in the version that MFNet pins,
    bicubic in newer ones, where thermal, stored as the alpha channel, also weights the colours.
    Here RGB and thermal are resized for themselves, bilinearly, and labels by nearest.
    """

    cut_share: Annotated[float, Interval(ge=0, le=0.5)]

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example; the aspect is not kept."""
        maps = Maps.of(sample).flip(bool(rng.random() < self.flip_probability))
        top, bottom = draw_ends(maps.hw[0], self.cut_share, rng)
        left, right = draw_ends(maps.hw[1], self.cut_share, rng)
        cut = maps.crop(Window(top, left, bottom - top, right - left))
        return cut.resize(self.crop_hw).example(self.track_position)


def draw_ends(length: int, share: float, rng: np.random.Generator) -> tuple[int, int]:
    """First pixel and end of what is left of one axis.

        n = floor(share * length)
        first in 0..n-1, end in length-n..length, uniform

    So at most n - 1 pixels are cut off at the start and n at the end; nothing where n is 0.

    Source: RTFNet and MFNet releases, share 0.1.
    """
    largest = int(share * length)
    first = int(rng.integers(max(1, largest)))
    return first, length - largest + int(rng.integers(largest + 1))


@dataclass(frozen=True, kw_only=True)
class ThesisTransform(FixedSize):
    """Resizes the whole image to a fixed size, mirrors it, blurs RGB and thermal together.

    Source: thesis (J. Sun), its code: mirrored alone (networks with one or two heads); mirrored
    and blurred (maximum squares; by its text, HeatNet too). Images are 640 x 1280, cut from the
    frames, and are shrunk to 320 x 640 by area.
    Intended: labels by nearest.   Released: labels bilinearly, so that pixels at the border of
    two classes get the number of a third: ``label_resize="bilinear"``. Where an ignored pixel
    takes part, the pixel is ignored; the thesis has none.

    Confidences of labels are resized by nearest, and mirrored with the image, the label and the
    thermal image (the thesis' code forgets them).
    """

    blur_probability: Share
    blur_kernel: OddPixels
    label_resize: Literal["nearest", "bilinear"]

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example; the aspect is not kept, nothing is cut."""
        flipped = bool(rng.random() < self.flip_probability)
        blurred = bool(rng.random() < self.blur_probability)
        maps = Maps.of(sample)
        shown = maps.resize(self.crop_hw, area=True)
        if self.label_resize == "bilinear":
            shown = replace(shown, label=mixed(maps.label, self.crop_hw))
        example = shown.flip(flipped).example(self.track_position)
        return gaussian_blurred(example, self.blur_kernel) if blurred else example

    def test(self, sample: Sample) -> Example:
        """As `FixedSize.test`, shrunk by area."""
        position = self.track_position
        return evaluated(sample, self.test_short_edge, track_position=position, area=True)


def gaussian_blurred(example: Example, kernel: int) -> Example:
    """RGB and thermal blurred by OpenCV's kernel of a side in pixels."""
    rgb, thermal = (
        cv2.GaussianBlur(each, (kernel, kernel), 0) for each in (example.rgb, example.thermal)
    )
    return replace(example, rgb=rgb, thermal=thermal)
