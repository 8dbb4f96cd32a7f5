"""The augmentation of the thesis on networks with two heads (J. Sun): shrink, mirror, blur."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from annotated_types import Interval, Predicate, doc
from numpy.typing import DTypeLike, NDArray

from rgbt.ranges import Pixels, Share, Size
from rgbt.requirements import Record
from rgbt.transforms.example import evaluated, image_hw, viewed
from rgbt.transforms.joint import View
from rgbt.types import IGNORE, Example, Sample

OddPixels = Annotated[
    int,
    Interval(ge=1, le=255),
    Predicate(lambda side: side % 2 == 1),
    doc("an odd number of pixels"),
]


@dataclass(frozen=True, kw_only=True)
class ThesisTransform:
    """Resizes the whole image to a fixed size, mirrors it, blurs RGB and thermal together.

    Source: thesis (J. Sun), its code: mirrored alone (networks with one or two heads); mirrored
    and blurred (maximum squares; by its text, HeatNet too). Images are 640 x 1280, cut from the
    frames, and are shrunk to 320 x 640 by area.
    Intended: labels by nearest.   Released: labels bilinearly, so that pixels at the border of
    two classes get the number of a third: ``label_resize="bilinear"``. Where an ignored pixel
    takes part, the pixel is ignored; the thesis has none.

    Confidences of labels are resized by nearest, and mirrored with the image, the label and the
    thermal image (the thesis' code forgets them).

    Attributes:
        crop_hw: size of the result in pixels, always; the aspect is not kept, nothing is cut.
        flip_probability: in [0, 1].
        blur_probability: in [0, 1].
        blur_kernel: side of OpenCV's Gaussian kernel in pixels, odd; of 5 pixels, the weights are
            1, 4, 6, 4 and 1 sixteenths along each axis.
        label_resize: "nearest" (intended) or "bilinear" (released).
        test_short_edge: short edge of evaluated images in pixels; None keeps their size. Labels
            keep the size of the file.
        track_position: whether examples carry the map of source positions.
    """

    crop_hw: Size
    flip_probability: Share
    blur_probability: Share
    blur_kernel: OddPixels
    label_resize: Literal["nearest", "bilinear"]
    test_short_edge: Pixels | None
    track_position: bool

    @property
    def record(self) -> Record:
        """The size of its examples."""
        return Record(crop_hw=self.crop_hw)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example of `crop_hw`."""
        flipped = bool(rng.random() < self.flip_probability)
        blurred = bool(rng.random() < self.blur_probability)
        view = View(image_hw(sample), self.crop_hw, (0, 0), self.crop_hw, flipped)
        example = viewed(
            sample,
            view,
            np.uint8,
            track_position=self.track_position,
            of_image=area,
            of_label=View.nearest if self.label_resize == "nearest" else mixed,
        )
        if not blurred:
            return example
        return replace(example, rgb=self._blur(example.rgb), thermal=self._blur(example.thermal))

    def test(self, sample: Sample) -> Example:
        """Whole image, resized to `test_short_edge` where that is set; the label as it is."""
        return evaluated(
            sample, self.test_short_edge, track_position=self.track_position, of_image=area
        )

    def _blur(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        size = (self.blur_kernel, self.blur_kernel)
        return np.asarray(cv2.GaussianBlur(image, size, 0), np.uint8)


def area(view: View, image: NDArray[np.uint8], dtype: DTypeLike) -> NDArray[Any]:
    """As `View.bilinear`, but where an image shrinks, every pixel is the mean of what it covers.

    Args:
        view: of a whole image.
        image: (H, W) or (H, W, C), uint8.
        dtype: of the result.
    """
    height, width = view.resized_hw
    if height > image.shape[0] or width > image.shape[1]:
        return view.bilinear(image, dtype)
    shrunk = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    whole = View(view.resized_hw, view.resized_hw, view.corner_yx, view.window_hw, view.flipped)
    return whole.bilinear(np.asarray(shrunk, np.uint8), dtype)


def mixed(view: View, label: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The view of a label whose numbers are interpolated as if they were brightness.

    Args:
        view: of images of its size.
        label: (H, W) uint8; pixels that an ignored one takes part in are ignored.
    """
    touched = view.bilinear((label == IGNORE).astype(np.uint8), np.float32) > 0
    return np.where(touched, np.uint8(IGNORE), view.bilinear(label, np.uint8))
