"""Count the pixels of one image with one histogram: label by prediction, pairs of frames, details.

The counts of images add exactly, in any order and over any number of processes: all are integers.
Maps are (H, W) of one shape, arrays or tensors; ValueError: they are not, or hold other classes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rgbt.metrics.details import UNITS, Details
from rgbt.metrics.metric import Regions

if TYPE_CHECKING:
    from torch import Tensor

Map: TypeAlias = "NDArray[Any] | Tensor"
Counted = NDArray[np.int64]


def histogram(
    *axes: tuple[NDArray[Any], int], where: NDArray[np.bool_], weights: Any = None
) -> Counted:
    """Count the pixels `where` by indices (H, W) with s1, s2, ... values: (s1, s2, ...).

    `weights` are whole numbers (H, W) that are added instead of 1.
    """
    sizes = [size for _, size in axes]
    flat = axes[0][0].astype(np.int32)
    for index, size in axes[1:]:
        flat *= size
        flat += index.astype(np.int32, copy=False)
    number = math.prod(sizes)
    flat[~where] = number  # indices may lie outside there
    # float64, in which weights are added, holds whole numbers below 2^53 exactly.
    added = None if weights is None else weights.ravel()
    counted = np.bincount(flat.ravel(), added, minlength=number + 1)
    return counted[:number].astype(np.int64, copy=False).reshape(sizes)


def region_counts(label: Map, prediction: Map, num_classes: int, regions: Regions) -> Counted:
    """Count label by prediction in every region of one image of any size.

    Source: SpatialSeg release, metric code (a confusion matrix per region).

    Args:
        label: 0..255; `num_classes` (K) and above: ignored.
        prediction: 0..K-1.
        num_classes: K, 1..255.
        regions: the partition into R regions.

    Returns:
        (R, K, K) int64.
    """
    label_HW, prediction_HW = _maps(label=label, prediction=prediction)
    _check_classes(num_classes, prediction=prediction_HW)
    return histogram(
        (regions.map(label_HW.shape), regions.regions),
        (label_HW, num_classes),
        (prediction_HW, num_classes),
        where=label_HW < num_classes,
    )


def pair_counts(
    first: Map, second: Map, label: Map, num_classes: int, valid: Map | None = None
) -> Counted:
    """Count one pair of frames, (K + 1, K, K): label (row K: no class), first, second.

    `first` is the prediction of the first frame as the protocol compares it (see
    `rgbt.metrics.pairs`), anything where not `valid`; `second` and its `label` as of
    `region_counts`. `valid` are the pixels that count; None: all.
    """
    every = np.ones(tuple(label.shape), bool) if valid is None else valid
    maps = _maps(first=first, second=second, label=label, valid=every)
    first_HW, second_HW, label_HW, valid_HW = (*maps[:3], maps[3].astype(bool))
    _check_classes(num_classes, first=first_HW * valid_HW, second=second_HW)
    rows = np.minimum(label_HW.astype(np.int32), num_classes), num_classes + 1
    return histogram(rows, (first_HW, num_classes), (second_HW, num_classes), where=valid_HW)


def detail_counts(
    details: Details,
    label: Map,
    prediction: Map,
    values: Map | None,
    num_classes: int,
    regions: Regions,
) -> Counted:
    """Count what details need of one image (see `rgbt.metrics.details`).

    Args:
        details: the kind of counts and its setting.
        label: as of `region_counts`.
        prediction: as of `region_counts`.
        values: of "calibration" the probability of the prediction; of "distance" metres > 0, inf:
            the sky; of "size" the number of the object, 0: none; of "boundary" None.
        num_classes: K, 1..255, of boundaries 1..254.
        regions: the partition into R regions.

    Returns:
        (R G, M, K) int64.
    """
    maps = {"label": label, "prediction": prediction}
    if values is not None:
        maps["values"] = values
    label_HW, prediction_HW, *others = _maps(**maps)
    rows = regions.map(label_HW.shape), regions.regions
    labels, predictions = (label_HW, num_classes), (prediction_HW, num_classes)
    valid, right, groups = label_HW < num_classes, label_HW == prediction_HW, details.groups
    if details.kind == "boundary":
        if num_classes > 254:  # a byte has two values for pixels that are not counted
            raise ValueError("boundaries of at most 254 classes can be counted.")
        width, *border = details.setting
        pixels = max(1, round(width * math.hypot(*label_HW.shape)))
        near_label = outlined(label_HW, valid, pixels, border=bool(border))
        near_prediction = outlined(prediction_HW, valid, pixels, border=bool(border))
        both = histogram(rows, labels, where=near_label & near_prediction & right)
        labelled = histogram(rows, labels, where=near_label)
        predicted = histogram(rows, predictions, where=near_prediction)
        return np.stack([both, labelled, predicted], 1)
    (value_HW,) = others
    if details.kind == "calibration":
        sure = value_HW.astype(np.float64)
        # Bin m holds (m / M, (m + 1) / M]; 0 itself is in the first.
        bins = np.ceil(sure * groups).astype(np.int32).clip(1, groups) - 1
        axes = rows, (bins, groups), predictions
        number = histogram(*axes, where=valid)
        correct = histogram(*axes, where=valid & right)
        total = histogram(*axes, where=valid, weights=np.rint(sure * UNITS))
        return np.stack([number, correct, total], 2).reshape(-1, 3, num_classes)
    # Group b holds edge b <= value < edge b + 1; the last one pixels without a value.
    value = value_HW if details.kind == "distance" else areas(value_HW)
    group = np.searchsorted(details.setting, value, side="right")
    group = np.where(np.isfinite(value), group, groups - 1)
    counted = histogram(rows, (group, groups), labels, predictions, where=valid)
    return counted.reshape(-1, num_classes, num_classes)


def outlined(
    classes: NDArray[np.integer], valid: NDArray[np.bool_], pixels: int, *, border: bool
) -> NDArray[np.bool_]:
    """Return whether a valid pixel belongs to the boundary of its class, (H, W).

    It does if the square of 2 d + 1 `pixels` around it holds a valid pixel of another class
    (0..253) or, with `border`, reaches over the border of the image. That is what d erosions of
    each mask leave.
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
    """Count pixels of the object that each pixel belongs to, (H, W); inf: of none (number 0)."""
    _, inverse, pixels = np.unique(objects, return_inverse=True, return_counts=True)
    found = pixels.astype(np.float64)[inverse.reshape(objects.shape)]
    return np.where(objects == 0, np.inf, found)


def _maps(**maps: Map) -> list[NDArray[Any]]:
    found = []
    for pixels in maps.values():
        found.append(np.asarray(pixels.cpu() if hasattr(pixels, "cpu") else pixels))
    if found[0].ndim != 2 or len({array.shape for array in found}) > 1:
        shapes = ", ".join(str(array.shape) for array in found)
        raise ValueError(f"{', '.join(maps)}: expected maps H x W of one shape, got {shapes}.")
    return found


def _check_classes(num_classes: int, **predictions: NDArray[Any]) -> None:
    """Refuse a prediction that is no class, which would be counted as another pixel."""
    if not 1 <= num_classes <= 255:
        raise ValueError(f"num_classes must be between 1 and 255, got {num_classes}.")
    for name, classes in predictions.items():
        if (top := int(classes.max())) >= num_classes:
            raise ValueError(f"{name}: expected classes 0..{num_classes - 1}, got {top}.")
