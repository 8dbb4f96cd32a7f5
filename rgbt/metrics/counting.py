"""Count the pixels of one image with one histogram: label by prediction, pairs of frames, details.

The counts of images add exactly, in any order and over any number of processes: all are integers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rgbt.metrics.details import UNITS, Details
from rgbt.metrics.metric import Regions

if TYPE_CHECKING:
    from torch import Tensor

Map: TypeAlias = "NDArray[Any] | Tensor"
Counted = NDArray[np.int64]

MOST_CLASSES = 254
"""Of boundaries, where a byte has two values for pixels that are not counted."""


def histogram(
    *axes: tuple[NDArray[Any], int], where: NDArray[np.bool_], weights: Any = None
) -> Counted:
    """Numbers of pixels by several indices at once.

    Args:
        axes: index (H, W) and number of its values; an index may lie outside where not counted.
        where: (H, W), pixels that count.
        weights: (H, W) whole numbers that are added instead of 1.

    Returns:
        (s1, s2, ...) of the sizes of the axes.
    """
    sizes = [size for _, size in axes]
    flat = axes[0][0].astype(np.int32)
    for index, size in axes[1:]:
        flat *= size
        flat += index.astype(np.int32, copy=False)
    number = math.prod(sizes)
    flat[~where] = number
    # float64, in which weights are added, holds whole numbers below 2^53 exactly.
    counted = np.bincount(
        flat.ravel(), None if weights is None else weights.ravel(), minlength=number + 1
    )
    return counted[:number].astype(np.int64, copy=False).reshape(sizes)


@dataclass(frozen=True)
class RegionCounter:
    """Counts label by prediction in every region, of images of any size.

    Attributes:
        num_classes: K, 1..255.
        regions: the partition.
    """

    num_classes: int
    regions: Regions

    def __call__(self, label: Map, prediction: Map) -> Counted:
        """(R, K, K) counts of one image, rows = label, columns = prediction.

        Source: SpatialSeg release, metric code (a confusion matrix per region); pixels whose label
        is no class (255 = ignore) are left out.

        (H, W) integer labels 0..255, of which K and above are ignored, and predictions 0..K-1.

        Raises:
            ValueError: shapes differ, or a prediction is no class.
        """
        label_HW, prediction_HW = _maps(label=label, prediction=prediction)
        _check_classes(self.num_classes, prediction=prediction_HW)
        return histogram(
            (self.regions.map(label_HW.shape), self.regions.regions),
            (label_HW, self.num_classes),
            (prediction_HW, self.num_classes),
            where=label_HW < self.num_classes,
        )


def pair_counts(
    first: Map, second: Map, label: Map, num_classes: int, valid: Map | None = None
) -> Counted:
    """(K + 1, K, K) counts of one pair of frames: label (row K: no class), first, second.

    Several sets of second frames are put one after the other.

    Args:
        first: (H, W) prediction 0..K-1 of the first frame, as the protocol compares it (see
            `rgbt.metrics.pairs`); anything 0..255 where not `valid`.
        second: (H, W) prediction of the second frame.
        label: (H, W) of the second frame, 0..255; K and above is no class.
        num_classes: K, 1..255.
        valid: (H, W) bool, pixels that count; None: all.

    Raises:
        ValueError: shapes differ, or a prediction that counts is no class.
    """
    given = {"first": first, "second": second, "label": label}
    first_HW, second_HW, label_HW, *masks = _maps(
        **given, **({} if valid is None else {"valid": valid})
    )
    valid_HW = masks[0].astype(bool) if masks else np.ones(label_HW.shape, bool)
    _check_classes(num_classes, first=first_HW * valid_HW, second=second_HW)
    rows = np.minimum(label_HW.astype(np.int32), num_classes), num_classes + 1
    return histogram(rows, (first_HW, num_classes), (second_HW, num_classes), where=valid_HW)


@dataclass(frozen=True)
class DetailCounter:
    """Counts what details need of one image (see `rgbt.metrics.details`).

    Attributes:
        num_classes: K.
        regions: the partition.
        details: the kind and its setting.
    """

    num_classes: int
    regions: Regions
    details: Details

    def __post_init__(self) -> None:
        if self.details.kind == "boundary" and self.num_classes > MOST_CLASSES:
            raise ValueError(f"boundaries of at most {MOST_CLASSES} classes can be counted.")

    def __call__(self, label: Map, prediction: Map, values: Map | None = None) -> Counted:
        """(R G, M, K) counts of one image.

        Args:
            label: (H, W) integers 0..255, of which K and above are ignored.
            prediction: (H, W) integers 0..K-1.
            values: (H, W) by kind: of "calibration" the probability 0..1 of the prediction; of
                "distance" metres > 0, inf: the sky; of "size" the number of the object, 0: none.

        Raises:
            ValueError: shapes differ.
        """
        given = {"label": label, "prediction": prediction}
        label_HW, prediction_HW, *others = _maps(
            **given, **({} if values is None else {"values": values})
        )
        if self.details.kind == "boundary":
            return self._boundaries(label_HW, prediction_HW)
        if self.details.kind == "calibration":
            return self._confidences(label_HW, prediction_HW, others[0])
        # Group b holds edge b <= value < edge b + 1; the last one pixels without a value.
        value = others[0] if self.details.kind == "distance" else areas(others[0])
        group = np.searchsorted(self.details.setting, value, side="right")
        group = np.where(np.isfinite(value), group, self.details.groups - 1)
        counted = histogram(
            *(self._rows(label_HW), (group, self.details.groups)),
            *((label_HW, self.num_classes), (prediction_HW, self.num_classes)),
            where=label_HW < self.num_classes,
        )
        return counted.reshape(-1, self.num_classes, self.num_classes)

    def _rows(self, label: NDArray[Any]) -> tuple[NDArray[Any], int]:
        return self.regions.map((label.shape[0], label.shape[1])), self.regions.regions

    def _boundaries(self, label: NDArray[Any], prediction: NDArray[Any]) -> Counted:
        """(R, 3, K): boundary pixels of both, of the label and of the prediction."""
        width, *border = self.details.setting
        valid = label < self.num_classes
        pixels = boundary_pixels((label.shape[0], label.shape[1]), width)
        near, near_too = (
            outlined(each, valid, pixels, border=bool(border)) for each in (label, prediction)
        )
        chosen = (
            (near & near_too & (label == prediction), label),
            (near, label),
            (near_too, prediction),
        )
        rows = self._rows(label)
        return np.stack(
            [histogram(rows, (each, self.num_classes), where=where) for where, each in chosen], 1
        )

    def _confidences(
        self, label: NDArray[Any], prediction: NDArray[Any], confidence: NDArray[Any]
    ) -> Counted:
        """(R M, 3, K): pixels, right ones and sums of confidences by predicted class."""
        sure, groups = confidence.astype(np.float64), self.details.groups
        # Bin m holds (m / M, (m + 1) / M]; 0 itself is in the first.
        bins = np.ceil(sure * groups).astype(np.int32).clip(1, groups) - 1
        axes = self._rows(label), (bins, groups), (prediction, self.num_classes)
        valid = label < self.num_classes
        number = histogram(*axes, where=valid)
        correct = histogram(*axes, where=valid & (label == prediction))
        total = histogram(*axes, where=valid, weights=np.rint(sure * UNITS))
        return np.stack([number, correct, total], 2).reshape(-1, 3, self.num_classes)


def boundary_pixels(image_hw: tuple[int, int], width: float) -> int:
    """The d of images of this size: ``round(width * diagonal)``, at least 1."""
    return max(1, round(width * math.hypot(*image_hw)))


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


def areas(objects: NDArray[np.integer]) -> NDArray[np.float64]:
    """(H, W): pixels of the object that each pixel belongs to; inf: of none (number 0)."""
    _, inverse, pixels = np.unique(objects, return_inverse=True, return_counts=True)
    found = pixels.astype(np.float64)[inverse.reshape(objects.shape)]
    return np.where(objects == 0, np.inf, found)


def _maps(**maps: Map) -> list[NDArray[Any]]:
    """The maps as arrays; ValueError unless all are H x W of one shape."""
    found = [np.asarray(each.cpu() if hasattr(each, "cpu") else each) for each in maps.values()]
    if found[0].ndim != 2 or len({each.shape for each in found}) > 1:
        shapes = ", ".join(str(each.shape) for each in found)
        raise ValueError(f"{', '.join(maps)}: expected maps H x W of one shape, got {shapes}.")
    return found


def _check_classes(num_classes: int, **predictions: NDArray[Any]) -> None:
    """Raise ValueError where a prediction is no class, which would be counted as another pixel."""
    if not 1 <= num_classes <= 255:
        raise ValueError(f"num_classes must be between 1 and 255, got {num_classes}.")
    for name, each in predictions.items():
        if int(each.max()) >= num_classes:
            raise ValueError(
                f"{name}: expected classes 0..{num_classes - 1}, got {int(each.max())}."
            )
