"""Augmentations that rotate: semseg (PSPNet) and HeatNet's own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Interval, Predicate, doc
from numpy.typing import ArrayLike, NDArray

from rgbt.checks import InputError
from rgbt.ranges import GreyLevel, Pixels, Share, Size, rising
from rgbt.requirements import Record
from rgbt.transforms.fixed_size import OddPixels, SizeFactors, gaussian_blurred, scaled_hw
from rgbt.transforms.maps import Maps, drawn_window, evaluated
from rgbt.types import IGNORE, Example, Sample

Angle = Annotated[float, Interval(ge=0, le=180)]


def rotated(
    example: Example,
    angle: float,
    centre_xy: tuple[float, float],
    fill: tuple[ArrayLike, float, int],
) -> Example:
    """Images bilinear, label and confidence nearest, rotated about a point that does not move.

    Args:
        example: without a map of positions.
        angle: degrees, counter-clockwise.
        centre_xy: column and row; centres of pixels are whole numbers.
        fill: RGB, thermal and label of pixels that are brought in; their confidence is 0.
    """
    height, width = example.label.shape
    matrix = np.asarray(cv2.getRotationMatrix2D(centre_xy, angle, 1.0))

    def warped(array: NDArray[Any], value: ArrayLike, how: int) -> NDArray[Any]:
        border = np.asarray(value, np.float64).ravel().tolist()
        return np.asarray(
            cv2.warpAffine(
                array,
                matrix,
                (width, height),
                flags=how,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=border,
            )
        )

    x, y = matrix @ np.array([*example.centre_yx[::-1], 1.0])
    confidence = example.confidence
    return replace(
        example,
        rgb=warped(example.rgb, fill[0], cv2.INTER_LINEAR),
        thermal=warped(example.thermal, fill[1], cv2.INTER_LINEAR),
        label=warped(example.label, fill[2], cv2.INTER_NEAREST),
        confidence=None if confidence is None else warped(confidence, 0.0, cv2.INTER_NEAREST),
        centre_yx=nearest_inside((y, x), (height, width)),
    )


def nearest_inside(point_yx: tuple[float, float], hw: tuple[int, int]) -> tuple[int, int]:
    """The pixel of an image of `hw` that is nearest to a point."""
    row, column = (
        int(np.rint(at).clip(0, side - 1)) for at, side in zip(point_yx, hw, strict=True)
    )
    return row, column


@dataclass(frozen=True, kw_only=True)
class SemsegTransform:
    """Scales by a drawn factor, rotates, blurs, mirrors, and cuts out a crop.

    Pixels that a rotation or padding brings in have the mean colour and are ignored in the label.
    Images are float32.

    Source: semseg (PSPNet), training script; thesis (J. Sun), configuration of its teacher (scale
    0.5 to 2, 10 degrees, crop 473 x 473).
    """

    scale_range: SizeFactors
    rotate_probability: Share
    rotate_degrees: Angle
    blur_probability: Share
    blur_kernel: OddPixels
    flip_probability: Share
    crop_hw: Size
    padding_rgb: tuple[GreyLevel, GreyLevel, GreyLevel]
    padding_thermal: GreyLevel
    test_short_edge: Pixels | None

    @property
    def record(self) -> Record:
        """The size of its examples."""
        return Record(crop_hw=self.crop_hw)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example of `crop_hw`."""
        maps = Maps.of(sample)
        hw = scaled_hw(maps.hw, float(rng.uniform(*self.scale_range)))
        example = maps.resize(hw, dtype=np.float32).example(False)
        if rng.random() < self.rotate_probability:
            angle = float(rng.uniform(-self.rotate_degrees, self.rotate_degrees))
            # semseg rotates about half the number of rows and columns.
            fill = (self.padding_rgb, self.padding_thermal, IGNORE)
            example = rotated(example, angle, (hw[1] / 2, hw[0] / 2), fill)
        if rng.random() < self.blur_probability:
            example = gaussian_blurred(example, self.blur_kernel)
        flipped = bool(rng.random() < self.flip_probability)
        full = (max(hw[0], self.crop_hw[0]), max(hw[1], self.crop_hw[1]))
        framed = _around(example).flip(flipped).pad(full, self.padding_rgb, self.padding_thermal)
        return framed.crop(drawn_window(full, self.crop_hw, rng)).example(False)

    def test(self, sample: Sample) -> Example:
        """Whole image, resized to `test_short_edge` where that is set; the label as it is."""
        return evaluated(sample, self.test_short_edge, track_position=False, dtype=np.float32)


def _around(example: Example) -> Maps:
    """The maps of an example, with places that are counted from its centre."""
    height, width = example.label.shape
    (row, column), source_hw = example.centre_yx, example.original_hw
    return Maps(
        *(example.rgb, example.thermal, example.label, example.confidence),
        rows=np.arange(height) - row + source_hw[0] // 2,
        columns=np.arange(width) - column + source_hw[1] // 2,
        source_hw=source_hw,
        name=example.name,
    )


MIDDLE = 127.5
"""Grey level that the inputs of HeatNet normalise to 0."""

ROAD = 0
"""Label of pixels that a rotation brings in, as released."""

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
            raise InputError(f"transform.crop_hw={list(self.crop_hw)} exceeds {list(room)}.")
        if self.drop_height[1] > self.crop_hw[0] or self.drop_width[1] > self.crop_hw[1]:
            raise InputError("transform.drop_height, drop_width: blocks exceed transform.crop_hw.")

    @property
    def record(self) -> Record:
        """The size of its examples; images of the target keep their blocks and thermal."""
        plain = replace(self, drop_probability=0.0, thermal_probability=0.0, class_probability=0.0)
        is_plain = plain == self
        return Record(crop_hw=self.crop_hw, for_target=None if is_plain else plain)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example of `crop_hw`; no label: all pixels ignored."""
        height, width = self.crop_hw
        room = (self.resize_hw[0], self.resize_hw[1] - 2 * self.side_margin)
        window = drawn_window(room, self.crop_hw, rng)
        window = window._replace(left=window.left + self.side_margin)
        flipped = bool(rng.random() < self.flip_probability)
        maps = Maps.of(sample).resize(self.resize_hw, window, dtype=np.float32)
        example = maps.flip(flipped).example(False)
        if rng.random() < self.rotate_probability:
            angle = float(rng.uniform(-self.rotate_degrees, self.rotate_degrees))
            fill = ((0.0, 0.0, 0.0), 0.0, IGNORE if sample.label is None else ROAD)
            example = rotated(example, angle, ((width - 1) / 2, (height - 1) / 2), fill)
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
        maps = Maps.of(sample)
        example = maps.resize(self.resize_hw, dtype=np.float32).example(False)
        return replace(example, label=maps.label, confidence=maps.confidence)

    def _without_block(self, example: Example, rng: np.random.Generator) -> Example:
        """One block of RGB or of thermal at the middle grey level."""
        height, width = (
            int(rng.integers(low, max(high, low + 1)))
            for low, high in (self.drop_height, self.drop_width)
        )
        top, left, _, _ = drawn_window(self.crop_hw, (height, width), rng)
        name = "rgb" if rng.random() < 0.5 else "thermal"
        image = (example.rgb if name == "rgb" else example.thermal).copy()
        image[top : top + height, left : left + width] = MIDDLE
        return replace(example, **{name: image})  # type: ignore[arg-type]


def _scaled(thermal: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """Thermal with its distance from the middle grey level times a factor."""
    return np.float32(MIDDLE) + np.float32(factor) * (thermal - np.float32(MIDDLE))
