"""The augmentation of HeatNet's release: crop, mirror, rotate, drop blocks, scale thermal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Interval, Predicate, doc
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.ranges import Pixels, Share, Size, rising
from rgbt.requirements import Record
from rgbt.transforms.example import image_hw, viewed
from rgbt.transforms.joint import View, whole_view
from rgbt.transforms.rotation import Rotation
from rgbt.types import IGNORE, Example, Sample

MIDDLE = 127.5
"""Grey level that the inputs of HeatNet normalise to 0."""

ROAD = 0
"""Label of pixels that a rotation brings in, as released."""

Angle = Annotated[float, Interval(ge=0, le=180)]
Sides = Annotated[tuple[Pixels, Pixels], Predicate(rising), doc("smallest and largest side")]
Factors = Annotated[tuple[Share, Share], Predicate(rising), doc("smallest and largest factor")]


@dataclass(frozen=True, kw_only=True)
class HeatNetTransform:
    """Resizes, cuts, mirrors and rotates an image; drops blocks and scales thermal by day.

    Images are float32. A block of RGB or of thermal becomes the grey level that the network
    normalises to 0, 127.5; thermal is scaled towards it. The release changes day images alone, so
    the target domain gets neither (`Record.for_target`).

    Source: HeatNet, Sec. IV.   Released: jzuern/heatnet-pub, training script and loader. There the
    decisions about blocks and thermal are common to a batch, and made in the segmentation's steps
    alone; here they are made for every image and in every step. The teacher's labels at night are
    rotated with the image here; there the teacher predicts rotated images. Brought-in pixels have
    label 0 (road) as released, and confidence 0.

    Attributes:
        resize_hw: size of the whole image after resizing, in pixels; the aspect is not kept.
        crop_hw: size of a training example.
        side_margin: columns at either side of the resized image that no training example shows.
        flip_probability: in [0, 1].
        rotate_probability: in [0, 1].
        rotate_degrees: largest angle to either side.
        drop_probability: that one block of RGB or of thermal, with equal odds, is dropped.
        drop_height: smallest and largest number of rows of a block, the largest excluded.
        drop_width: the same for columns.
        thermal_probability: that the thermal image is scaled.
        class_probability: that the thermal pixels of each class are scaled by a factor of their
            own; one of the two releases.
        thermal_range: smallest and largest factor of thermal.

    Raises:
        InputError: crops larger than the image without margins; blocks larger than crops.
    """

    resize_hw: Size
    crop_hw: Size
    side_margin: Annotated[int, Interval(ge=0, le=8192)]
    flip_probability: Share
    rotate_probability: Share
    rotate_degrees: Angle
    drop_probability: Share
    drop_height: Sides
    drop_width: Sides
    thermal_probability: Share
    class_probability: Share
    thermal_range: Factors

    def __post_init__(self) -> None:
        room = (self.resize_hw[0], self.resize_hw[1] - 2 * self.side_margin)
        if self.crop_hw[0] > room[0] or self.crop_hw[1] > room[1]:
            raise InputError(
                f"transform.crop_hw={list(self.crop_hw)} must fit into transform.resize_hw less "
                f"side_margin, {list(room)}."
            )
        if self.drop_height[1] > self.crop_hw[0] or self.drop_width[1] > self.crop_hw[1]:
            raise InputError(
                f"transform.drop_height={list(self.drop_height)} and drop_width="
                f"{list(self.drop_width)} must not exceed transform.crop_hw={list(self.crop_hw)}."
            )

    @property
    def record(self) -> Record:
        """The size of its examples; images of the target keep their blocks and thermal."""
        plain = replace(self, drop_probability=0.0, thermal_probability=0.0, class_probability=0.0)
        is_plain = plain == self
        return Record(crop_hw=self.crop_hw, for_target=None if is_plain else plain)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example of `crop_hw`; no label: all pixels ignored."""
        example = self._rotated(self._cut(sample, rng), rng, labelled=sample.label is not None)
        if rng.random() < self.drop_probability:
            example = self._without_block(example, rng)
        thermal = example.thermal
        if rng.random() < self.thermal_probability:
            thermal = _scaled(thermal, rng.uniform(*self.thermal_range))
        if rng.random() < self.class_probability:
            for label in np.unique(example.label):
                scaled = _scaled(thermal, rng.uniform(*self.thermal_range))
                thermal = np.where(example.label == label, scaled, thermal)
        return replace(example, thermal=thermal)

    def test(self, sample: Sample) -> Example:
        """The whole image at `resize_hw`; the label as it is."""
        view = whole_view(image_hw(sample), self.resize_hw)
        example = viewed(sample, view, np.float32, track_position=False)
        label = np.full(image_hw(sample), IGNORE, np.uint8)
        label = label if sample.label is None else sample.label
        return replace(example, label=label, confidence=sample.confidence)

    def _cut(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Resized, cut and mirrored."""
        top = int(rng.integers(self.resize_hw[0] - self.crop_hw[0] + 1))
        rest = self.resize_hw[1] - 2 * self.side_margin - self.crop_hw[1]
        left = self.side_margin + int(rng.integers(rest + 1))
        flipped = bool(rng.random() < self.flip_probability)
        view = View(image_hw(sample), self.resize_hw, (top, left), self.crop_hw, flipped)
        return viewed(sample, view, np.float32, track_position=False)

    def _rotated(self, example: Example, rng: np.random.Generator, *, labelled: bool) -> Example:
        if rng.random() >= self.rotate_probability:
            return example
        height, width = self.crop_hw
        angle = float(rng.uniform(-self.rotate_degrees, self.rotate_degrees))
        rotation = Rotation(self.crop_hw, angle, ((width - 1) / 2, (height - 1) / 2))
        confidence = example.confidence
        return replace(
            example,
            rgb=rotation.image(example.rgb, (0.0, 0.0, 0.0)),
            thermal=rotation.image(example.thermal, 0.0),
            label=rotation.label(example.label, ROAD if labelled else IGNORE),
            confidence=None if confidence is None else rotation.label(confidence, 0.0),
            centre_yx=rotation.point(*example.centre_yx),
        )

    def _without_block(self, example: Example, rng: np.random.Generator) -> Example:
        """One block of RGB or of thermal at the middle grey level."""
        height, width = (
            int(rng.integers(low, max(high, low + 1)))
            for low, high in (self.drop_height, self.drop_width)
        )
        top = int(rng.integers(self.crop_hw[0] - height + 1))
        left = int(rng.integers(self.crop_hw[1] - width + 1))
        name = "rgb" if rng.random() < 0.5 else "thermal"
        image = (example.rgb if name == "rgb" else example.thermal).copy()
        image[top : top + height, left : left + width] = MIDDLE
        return replace(example, **{name: image})  # type: ignore[arg-type]


def _scaled(thermal: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """Thermal with its distance from the middle grey level times a factor."""
    return (np.float32(MIDDLE) + np.float32(factor) * (thermal - np.float32(MIDDLE))).astype(
        np.float32
    )
