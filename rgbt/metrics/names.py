"""Every metric name, once. Scores are fractions 0..1; `VAR` alone is in squared percent points."""

from __future__ import annotations

MIOU = "mIoU"
"""Mean IoU over classes, pixels of the whole image pooled (not the mean of the regions)."""

VAR = "Var"
"""Population variance of the mIoU of the regions in percent, as printed (SpatialSeg, Eq. 19)."""

MACC = "mAcc"
"""Mean over classes of the recall, which the papers call accuracy."""

MPRECISION = "mPrecision"
MF1 = "mF1"
PIXEL_ACCURACY = "pixel_accuracy"
"""Share of the valid pixels that are right."""

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


def subset(part: str, name: str) -> str:
    """Metric `name` over the images of one part, e.g. ``subset(DAY, MIOU)``: "day/mIoU"."""
    return f"{part}/{name}"
