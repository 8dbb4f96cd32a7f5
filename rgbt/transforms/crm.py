"""The augmentation chain of CRM and SpatialSeg: resize, crop, colour, flip.

Results are not padded: networks pad images to a multiple of 32 with their mean colour, and losses
pad labels with "ignore" (`rgbt.geometry.padding`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rgbt.ranges import GreyLevel, Lengths, Pixels, Share, Size
from rgbt.requirements import Record
from rgbt.transforms.maps import Maps, drawn_window, evaluated, short_edge_hw
from rgbt.transforms.photometric import ColourJitter, FactorRange, HueDelta
from rgbt.types import Example, Sample


@dataclass(kw_only=True, eq=False)
class CrmTransform:
    """Resizes the short edge to a drawn length, crops, jitters colours, flips.

    Source: CRM, Sec. 4.1 (implementation details), and the dataset mapper of its release;
    SpatialSeg uses the same chain.
    Paper: random crop, colour jitter and horizontal flip of ordinary 8-bit images:
        ``colour="intended"``. Images stay uint8 and are resized as such (rounded).
    Released: images are float32 before resizing, which changes what the colour steps do
        (`Colours.rgb`): ``colour="released"``. Values between steps are not rounded.
    Both resize bilinearly with half-pixel centres and without antialiasing, and labels by nearest.
    """

    sizes: Lengths | None
    max_size: Pixels | None
    crop_hw: Size | None
    flip_probability: Share
    colour: Literal["intended", "released"]
    colour_probability: Share
    brightness_delta: GreyLevel
    contrast_range: FactorRange
    saturation_range: FactorRange
    hue_delta: HueDelta
    thermal_contrast_range: FactorRange
    test_short_edge: Pixels | None
    track_position: bool

    def __post_init__(self) -> None:
        self.dtype = np.uint8 if self.colour == "intended" else np.float32
        self.jitter = ColourJitter(
            probability=self.colour_probability,
            brightness_delta=self.brightness_delta,
            contrast_range=self.contrast_range,
            saturation_range=self.saturation_range,
            hue_delta=self.hue_delta,
            thermal_contrast_range=self.thermal_contrast_range,
        )

    @property
    def record(self) -> Record:
        """The size of its examples."""
        return Record(crop_hw=self.crop_hw)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example."""
        maps = Maps.of(sample)
        hw = maps.hw
        if self.sizes is not None:
            hw = short_edge_hw(hw, int(rng.choice(self.sizes)), self.max_size)
        window = drawn_window(hw, self.crop_hw or hw, rng)
        flipped = bool(rng.random() < self.flip_probability)
        # Colours change pixel by pixel, so that it does not matter that the flip comes before.
        shown = maps.resize(hw, window, dtype=self.dtype).flip(flipped)
        example, colours = shown.example(self.track_position), self.jitter.draw(rng)
        return replace(
            example,
            rgb=colours.rgb(example.rgb).astype(self.dtype, copy=False),
            thermal=colours.thermal(example.thermal).astype(self.dtype, copy=False),
        )

    def test(self, sample: Sample) -> Example:
        """Whole image, resized to `test_short_edge` where that is set; the label as it is."""
        return evaluated(
            sample,
            self.test_short_edge,
            track_position=self.track_position,
            max_size=self.max_size,
            dtype=self.dtype,
        )
