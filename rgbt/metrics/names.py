"""Every metric name, once. Scores are fractions 0..1; `VAR` alone is in squared percent points."""

from __future__ import annotations

MIOU = "mIoU"
"""Mean IoU over scored classes, pixels of the whole image pooled (not the mean of the regions)."""

VAR = "Var"
"""Population variance of the mIoU of the regions in percent, as printed (SpatialSeg, Eq. 19)."""

MACC = "mAcc"
"""Mean over classes of the recall, which the papers call accuracy."""

MPRECISION = "mPrecision"
MF1 = "mF1"
PIXEL_ACCURACY = "pixel_accuracy"
"""Share of the valid pixels that are right."""

TC = "TC"
"""Mean over classes of the temporal consistency (Temporal, Fig. 4); of counts of pairs of frames,
see `rgbt.metrics.pairs`, as are the next two."""

CA = "CA"
"""Mean over classes of the consistent accuracy, over the exact union of three sets."""

CA_RELEASED = "CA_released"
"""The same over the union that the Temporal release computes."""

DAY = "day"
NIGHT = "night"

REGION_PROFILE = "profile/iou_by_region"
"""The mIoU of each region as a line: the step is the region number."""


def region(number: int) -> str:
    """The mIoU of region `number`, 1 = innermost, left or top."""
    return f"region/{number}"


def class_iou(name: str) -> str:
    """IoU of the class called `name`."""
    return f"class/{name}"


def of_class(name: str, score: str) -> str:
    """A score of one class, e.g. ``of_class("car", TC)``: "class/car/TC"."""
    return f"class/{name}/{score}"


def consistency(score: str, protocol: str) -> str:
    """A score of pairs of frames among those of a run, e.g. ``consistency(TC, "aligned")``.

    `score` is `TC` or `CA`; under "released" CA is the one of `CA_RELEASED`.
    """
    return f"{score}/{protocol}"


def subset(part: str, name: str) -> str:
    """Metric `name` over the images of one part, e.g. ``subset(DAY, MIOU)``: "day/mIoU"."""
    return f"{part}/{name}"
