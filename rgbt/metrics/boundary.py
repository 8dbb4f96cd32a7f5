"""Boundary IoU: how well the outlines of a class are predicted, whatever its size.

Source: Cheng, Girshick, Dollár, Berg, Kirillov: "Boundary IoU: Improving Object-Centric Image
Segmentation Evaluation", CVPR 2021, Sec. 4, and its released code.

The boundary of a class are the pixels of its mask within d pixels of the outline of the mask, as
left by d erosions with 3x3 pixels. d is a share of the image diagonal, at least 1 pixel. Ignored
pixels are not counted, and their edges are no outlines; the prediction is compared as if it were
ignored there too. So a prediction that is right in every counted pixel scores 100 %.

In the released code the border of the image is an outline too. All pixels near it are then
boundary, which raises the scores of the outer regions. So here it is an outline only where `border`
says so.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rgbt.metrics.metric import Absent, Regions
from rgbt.metrics.scores import Matrices, Scores, ratio

BOTH, LABEL, PREDICTION = range(3)
"""Rows of the counts: |G_d and P_d|, |G_d|, |P_d| of each class."""

MOST_CLASSES = 254


def boundary_iou(counts: Matrices, absent: Absent) -> Scores:
    """``|G_d and P_d| / |G_d or P_d|`` of each class.

    Shapes: (..., 3, K), summed over images -> (..., K) fractions 0..1.
    """
    both, label, predicted = (
        counts[..., row, :].astype(np.float64) for row in (BOTH, LABEL, PREDICTION)
    )
    return ratio(both, label + predicted - both, absent)


def boundary_pixels(image_hw: tuple[int, int], width: float) -> int:
    """The d of images of this size: ``round(width * diagonal)``, at least 1."""
    return max(1, round(width * math.hypot(*image_hw)))


class BoundaryCounter:
    """Counts the boundary pixels of one image.

    Args:
        num_classes: K, 1..`MOST_CLASSES`.
        regions: the partition.
        width: d as a share of the image diagonal.
        border: whether the border of the image is an outline, as released.
    """

    def __init__(
        self, num_classes: int, regions: Regions, width: float, *, border: bool = False
    ) -> None:
        if not 1 <= num_classes <= MOST_CLASSES:
            raise ValueError(
                f"num_classes must be between 1 and {MOST_CLASSES}, got {num_classes}."
            )
        self._classes = num_classes
        self._regions = regions
        self._width = width
        self._border = border

    def __call__(self, label: ArrayLike, prediction: ArrayLike) -> NDArray[np.int64]:
        """(R, 3, K) pixels of `BOTH`, `LABEL` and `PREDICTION`; those of images add.

        (H, W) integer labels 0..255, of which K and above are ignored, and predictions 0..K-1.
        """
        label_HW, prediction_HW = np.asarray(label), np.asarray(prediction)
        image_hw = (label_HW.shape[0], label_HW.shape[1])
        pixels = boundary_pixels(image_hw, self._width)
        valid = label_HW < self._classes
        near = [
            outlined(each, valid, pixels, border=self._border) for each in (label_HW, prediction_HW)
        ]
        chosen = near[0] & near[1] & (label_HW == prediction_HW), near[0], near[1]
        region = self._regions.map(image_hw).astype(np.int64) * self._classes
        size = self._regions.regions * self._classes
        found = [
            np.bincount(region[where] + classes[where], minlength=size)
            for where, classes in zip(chosen, (label_HW, label_HW, prediction_HW), strict=True)
        ]
        return np.stack(found, 1).reshape(-1, self._classes, 3).transpose(0, 2, 1)


def outlined(
    classes: NDArray[np.integer], valid: NDArray[np.bool_], pixels: int, *, border: bool
) -> NDArray[np.bool_]:
    """(H, W): whether a valid pixel belongs to the boundary of its class.

    It does if the square of 2 d + 1 pixels around it holds a valid pixel of another class or, with
    `border`, reaches over the border of the image. That is what d erosions of each mask leave.

    Args:
        classes: (H, W) 0..253 where valid.
        valid: (H, W), pixels that are counted.
        pixels: d >= 1.
        border: whether the border of the image is an outline.
    """
    import cv2  # code that only derives scores does not need it

    square = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    shifted = classes.astype(np.uint8) + 1
    highest = cv2.dilate(np.where(valid, shifted, 0).astype(np.uint8), square)
    lowest = cv2.erode(np.where(valid, shifted, 255).astype(np.uint8), square)
    inside: NDArray[np.bool_] = np.asarray(highest == lowest)
    for edge in (slice(None, pixels), slice(-pixels, None)) if border else ():
        inside[edge] = False
        inside[:, edge] = False
    return valid & ~inside
