"""The augmentation of the CMX release: mirror, resize by a factor, crop with padding."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval, Len
from numpy.typing import ArrayLike, NDArray

from rgbt.ranges import GreyLevel, Pixels, Share, Size
from rgbt.requirements import Record
from rgbt.transforms.example import evaluated, image_hw, viewed
from rgbt.transforms.joint import View
from rgbt.types import IGNORE, Example, Sample

SizeFactor = Annotated[float, Interval(ge=0.01, le=16)]


@dataclass(kw_only=True, eq=False)
class CmxTransform:
    """Mirrors, resizes by a drawn factor, crops; what the image does not fill is padding.

    Source: CMX release (training preprocessing). There, padding is 0 in the normalised images.
    Networks here normalise images themselves (`rgbt.models.inputs`), so padding is their mean
    colour: 0 for them but for rounding to whole grey levels, and, where thermal is repeated for
    three channels of different means, but for the distance of each mean from the three's mean.

    Attributes:
        flip_probability: in [0, 1].
        factors: of the size of the file, one is drawn with equal odds.
        crop_hw: size of the result in pixels, always.
        padding_rgb: mean colour in grey levels 0..255, in the order of `padding_order`.
        padding_order: "rgb", or "bgr" for a network that is fed blue first.
        padding_thermal: mean of every channel that the network takes thermal for, likewise.
        test_short_edge: short edge of evaluated images in pixels; None keeps their size.
        track_position: whether examples carry the map of source positions.
    """

    flip_probability: Share
    factors: Annotated[tuple[SizeFactor, ...], Len(1, 1000)]
    crop_hw: Size
    padding_rgb: tuple[GreyLevel, GreyLevel, GreyLevel]
    padding_order: Literal["rgb", "bgr"]
    padding_thermal: Annotated[tuple[GreyLevel, ...], Len(1, 3)]
    test_short_edge: Pixels | None
    track_position: bool

    def __post_init__(self) -> None:
        colour = self.padding_rgb[:: 1 if self.padding_order == "rgb" else -1]
        self.padding = (
            np.rint(colour).astype(np.uint8),
            np.rint(np.mean(self.padding_thermal)).astype(np.uint8),
        )

    @property
    def record(self) -> Record:
        """The size of its examples."""
        return Record(crop_hw=self.crop_hw)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example of `crop_hw`; what is padding is 255 in its label."""
        source_hw = image_hw(sample)
        flipped = bool(rng.random() < self.flip_probability)
        factor = float(rng.choice(self.factors))
        resized_hw = max(1, int(source_hw[0] * factor)), max(1, int(source_hw[1] * factor))
        top, height = draw_span(resized_hw[0], self.crop_hw[0], rng)
        left, width = draw_span(resized_hw[1], self.crop_hw[1], rng)
        # The release cuts the mirrored image; a view cuts first, so its window is mirrored.
        corner_yx = (top, resized_hw[1] - left - width if flipped else left)
        view = View(source_hw, resized_hw, corner_yx, (height, width), flipped)
        example = viewed(sample, view, np.uint8, track_position=self.track_position)
        return padded(example, self.crop_hw, *self.padding)

    def test(self, sample: Sample) -> Example:
        """Whole image, resized to `test_short_edge` where that is set; the label as it is."""
        return evaluated(sample, self.test_short_edge, track_position=self.track_position)


def draw_span(length: int, crop: int, rng: np.random.Generator) -> tuple[int, int]:
    """First pixel and number of pixels of a crop along one axis.

    All of an axis that is not longer than the crop. Of a longer one, every first pixel from 0 to
    length - crop + 1 is as likely: the last lies one too far, and the crop lacks a pixel.

    Source: CMX release.

    Args:
        length: of the axis in pixels.
        crop: wanted length in pixels.
        rng: the draw comes from here.
    """
    if length <= crop:
        return 0, length
    first = int(rng.integers(length - crop + 2))
    return first, min(crop, length - first)


def padded(
    example: Example,
    hw: tuple[int, int],
    rgb: ArrayLike,
    thermal: ArrayLike,
    *,
    corner_yx: tuple[int, int] | None = None,
) -> Example:
    """An example in the middle of padding; of odd padding the larger half is below and right.

    Args:
        example: images and label of one size, not above `hw` on either side.
        hw: size of the result in pixels.
        rgb: (3,) colour of the padding, grey levels.
        thermal: () grey level of the padding.
        corner_yx: pixel of the result where the example begins; None: in the middle.

    Returns:
        images of `hw` and dtypes of `example`; padding is 255 in the label and 0 in its confidence,
        and where positions are tracked it has that of the nearest pixel of the image.
    """
    height, width = example.label.shape
    top, left = corner_yx or ((hw[0] - height) // 2, (hw[1] - width) // 2)
    margins = (top, hw[0] - height - top), (left, hw[1] - width - left)

    def framed(values: NDArray[Any], padding: ArrayLike) -> NDArray[Any]:
        canvas = np.empty((*hw, *values.shape[2:]), values.dtype)
        canvas[:] = padding
        canvas[top : top + height, left : left + width] = values
        return canvas

    position, confidence = example.position, example.confidence
    return replace(
        example,
        rgb=framed(example.rgb, rgb),
        thermal=framed(example.thermal, thermal),
        label=framed(example.label, IGNORE),
        confidence=None if confidence is None else framed(confidence, 0.0),
        centre_yx=(example.centre_yx[0] + top, example.centre_yx[1] + left),
        position=None if position is None else np.pad(position, ((0, 0), *margins), mode="edge"),
    )
