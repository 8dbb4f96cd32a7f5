"""The augmentation of the RTFNet and MFNet releases: mirror, cut the borders, stretch the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval

from rgbt.ranges import Pixels, Share, Size
from rgbt.requirements import Record
from rgbt.transforms.example import evaluated, image_hw, viewed
from rgbt.transforms.joint import Part, View
from rgbt.types import Example, Sample


@dataclass(frozen=True, kw_only=True)
class RtfnetTransform:
    """Mirrors, cuts a drawn share off every side, stretches what is left to a fixed size.

    Source: RTFNet and MFNet releases (random flip, random crop). RTFNet's paper names the flip
    alone.
    The releases leave the resampling of images to Pillow: nearest in the version that MFNet pins,
    bicubic in newer ones, where thermal, stored as the alpha channel, also weights the colours.
    Here RGB and thermal are resized for themselves, bilinearly, and labels by nearest.

    Attributes:
        flip_probability: in [0, 1].
        cut_share: largest part of a side that is cut off at either end, in [0, 0.5].
        crop_hw: size of the result in pixels, always; the aspect is not kept.
        test_short_edge: short edge of evaluated images in pixels; None keeps their size.
        track_position: whether examples carry the map of source positions.
    """

    flip_probability: Share
    cut_share: Annotated[float, Interval(ge=0, le=0.5)]
    crop_hw: Size
    test_short_edge: Pixels | None
    track_position: bool

    @property
    def record(self) -> Record:
        """The size of its examples."""
        return Record(crop_hw=self.crop_hw)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example of `crop_hw`."""
        source_hw = image_hw(sample)
        flipped = bool(rng.random() < self.flip_probability)
        top, bottom = draw_ends(source_hw[0], self.cut_share, rng)
        left, right = draw_ends(source_hw[1], self.cut_share, rng)
        if flipped:  # the releases cut the mirrored image; a view cuts first
            left, right = source_hw[1] - right, source_hw[1] - left
        part = Part(top, left, bottom - top, right - left)
        view = View(source_hw, self.crop_hw, (0, 0), self.crop_hw, flipped, part)
        return viewed(sample, view, np.uint8, track_position=self.track_position)

    def test(self, sample: Sample) -> Example:
        """Whole image, resized to `test_short_edge` where that is set; the label as it is."""
        return evaluated(sample, self.test_short_edge, track_position=self.track_position)


def draw_ends(length: int, share: float, rng: np.random.Generator) -> tuple[int, int]:
    """First pixel and end of what is left of one axis.

        n = floor(share * length)
        first in 0..n-1, end in length-n..length, uniform

    So at most n - 1 pixels are cut off at the start and n at the end.

    Source: RTFNet and MFNet releases, share 0.1.

    Args:
        length: of the axis in pixels.
        share: in [0, 0.5]; nothing is cut off where n is 0.
        rng: both draws come from here.
    """
    largest = int(share * length)
    first = int(rng.integers(max(1, largest)))
    return first, length - largest + int(rng.integers(largest + 1))
