"""The augmentation of semseg (PSPNet): scale, rotate, blur, mirror, crop with padding."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Interval, Predicate, doc
from numpy.typing import NDArray

from rgbt.ranges import GreyLevel, Pixels, Share, Size, rising
from rgbt.requirements import Record
from rgbt.transforms.cmx import padded
from rgbt.transforms.example import evaluated, image_hw, viewed
from rgbt.transforms.joint import View, whole_view
from rgbt.transforms.rotation import Rotation
from rgbt.transforms.thesis import OddPixels
from rgbt.types import IGNORE, Example, Sample

SizeFactor = Annotated[float, Interval(ge=0.01, le=16)]
Factors = Annotated[
    tuple[SizeFactor, SizeFactor], Predicate(rising), doc("smallest and largest factor")
]


@dataclass(frozen=True, kw_only=True)
class SemsegTransform:
    """Scales by a drawn factor, rotates, blurs, mirrors, and cuts out a crop.

    Pixels that a rotation or padding brings in have the mean colour and are ignored in the label.
    Images are float32.

    Source: semseg (PSPNet), training script; thesis (J. Sun), configuration of its teacher (scale
    0.5 to 2, 10 degrees, crop 473 x 473).

    Attributes:
        scale_range: smallest and largest factor of both sides, drawn uniformly.
        rotate_probability: in [0, 1].
        rotate_degrees: largest angle to either side.
        blur_probability: that RGB and thermal are blurred.
        blur_kernel: side of OpenCV's Gaussian kernel in pixels, odd.
        flip_probability: in [0, 1].
        crop_hw: size of the result in pixels, always.
        padding_rgb: mean colour in grey levels, red first.
        padding_thermal: mean grey level of thermal; of three channels, that of all.
        test_short_edge: short edge of evaluated images in pixels; None keeps their size.
    """

    scale_range: Factors
    rotate_probability: Share
    rotate_degrees: Annotated[float, Interval(ge=0, le=180)]
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
        source_hw = image_hw(sample)
        factor = float(rng.uniform(*self.scale_range))
        resized_hw = max(1, round(source_hw[0] * factor)), max(1, round(source_hw[1] * factor))
        view = whole_view(source_hw, resized_hw)
        example = self._rotated(viewed(sample, view, np.float32, track_position=False), rng)
        if rng.random() < self.blur_probability:
            blurred = {"rgb": self._blur(example.rgb), "thermal": self._blur(example.thermal)}
            example = replace(example, **blurred)  # type: ignore[arg-type]
        flipped = bool(rng.random() < self.flip_probability)
        return self._cropped(example, flipped, rng)

    def test(self, sample: Sample) -> Example:
        """Whole image, resized to `test_short_edge` where that is set; the label as it is."""
        return evaluated(sample, self.test_short_edge, track_position=False, dtype=np.float32)

    def _rotated(self, example: Example, rng: np.random.Generator) -> Example:
        if rng.random() >= self.rotate_probability:
            return example
        height, width = example.label.shape
        angle = float(rng.uniform(-self.rotate_degrees, self.rotate_degrees))
        # semseg rotates about half the number of rows and columns.
        rotation = Rotation((height, width), angle, (width / 2, height / 2))
        confidence = example.confidence
        return replace(
            example,
            rgb=rotation.image(example.rgb, self.padding_rgb),
            thermal=rotation.image(example.thermal, self.padding_thermal),
            label=rotation.label(example.label, IGNORE),
            confidence=None if confidence is None else rotation.label(confidence, 0.0),
            centre_yx=rotation.point(*example.centre_yx),
        )

    def _blur(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        size = (self.blur_kernel, self.blur_kernel)
        return np.asarray(cv2.GaussianBlur(image, size, 0), np.float32)

    def _cropped(self, example: Example, flipped: bool, rng: np.random.Generator) -> Example:
        """Mirrored, padded where it is smaller than the crop, and cut at a drawn place."""
        source_hw = (example.label.shape[0], example.label.shape[1])
        full = (max(source_hw[0], self.crop_hw[0]), max(source_hw[1], self.crop_hw[1]))
        if flipped:
            row, column = example.centre_yx
            example = _mirrored(replace(example, centre_yx=(row, source_hw[1] - 1 - column)))
        if full != source_hw:
            example = padded(example, full, self.padding_rgb, self.padding_thermal)
        top = int(rng.integers(full[0] - self.crop_hw[0] + 1))
        left = int(rng.integers(full[1] - self.crop_hw[1] + 1))
        window = View(full, full, (top, left), self.crop_hw)
        rows, columns = window.rows(), window.columns()
        row, column = example.centre_yx
        confidence = example.confidence
        return replace(
            example,
            rgb=example.rgb[rows][:, columns],
            thermal=example.thermal[rows][:, columns],
            label=window.nearest(example.label),
            confidence=None if confidence is None else window.nearest(confidence),
            centre_yx=(
                int(np.clip(row - top, 0, self.crop_hw[0] - 1)),
                int(np.clip(column - left, 0, self.crop_hw[1] - 1)),
            ),
        )


def _mirrored(example: Example) -> Example:
    """Images, label and confidence left to right."""
    confidence = example.confidence
    return replace(
        example,
        rgb=np.ascontiguousarray(example.rgb[:, ::-1]),
        thermal=np.ascontiguousarray(example.thermal[:, ::-1]),
        label=np.ascontiguousarray(example.label[:, ::-1]),
        confidence=None if confidence is None else np.ascontiguousarray(confidence[:, ::-1]),
    )
