"""Define every metric name once, and how a score is shown.

Scores are fractions 0..1; `VAR` alone is in squared percent points.
"""

from __future__ import annotations

from collections.abc import Mapping

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

WARPING_ERROR = "warping_error"
"""Share of the pixels seen in both frames whose predicted class changes; 0 is best."""

FLICKER = "flicker"
"""Share of the pixels seen in three frames whose class changes and changes back; 0 is best."""

BOUNDARY_MIOU = "boundary_mIoU"
"""Mean over classes of the boundary IoU (`rgbt.metrics.details`)."""

BOUNDARY_IOU = "boundary_IoU"
"""The same of one class: ``of_class("car", BOUNDARY_IOU)``."""

ECE = "ECE"
"""Expected calibration error (`rgbt.metrics.details`); 0 is best."""

DISTANCE = "distance"
SIZE = "size"

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


def in_region(number: int, name: str) -> str:
    """A score of boundaries, calibration, distance or size inside one region."""
    return f"region/{number}/{name}"


def consistency(score: str, protocol: str) -> str:
    """A score of pairs of frames among those of a run, e.g. ``consistency(TC, "aligned")``.

    `score` is `TC` or `CA`; under "released" CA is the one of `CA_RELEASED`.
    """
    return f"{score}/{protocol}"


def subset(part: str, name: str) -> str:
    """Metric `name` over the images of one part, e.g. ``subset(DAY, MIOU)``: "day/mIoU"."""
    return f"{part}/{name}"


def by_head(head: str, name: str) -> str:
    """Metric `name` as one of two heads predicts: ``by_head("source", "night/mIoU")``."""
    return f"{head}_head/{name}"


FRACTIONS = {
    *(MIOU, MACC, MPRECISION, MF1, PIXEL_ACCURACY, BOUNDARY_MIOU, BOUNDARY_IOU, ECE),
    *(WARPING_ERROR, FLICKER),
}


def in_percent(name: str, value: float) -> float:
    """A score in percent with all its digits; Var and what is no score keep their unit.

    Examples:
        >>> in_percent("day/mIoU", 0.5), in_percent("Var", 12.5), in_percent("loss", 0.5)
        (50.0, 12.5, 0.5)
    """
    return 100 * value if _is_fraction(name) else value


def shown(values: Mapping[str, float]) -> dict[str, float]:
    """Values as MLflow shows them: scores in percent with two decimals, as the papers print them.

    Its charts write 0.62 for a fraction, and its tables all sixteen digits. The folder keeps the
    exact values.
    """
    scores = {n for n in values if _is_fraction(n) or n.split("/")[-1] == VAR}
    return {n: round(in_percent(n, v), 2) if n in scores else v for n, v in values.items()}


def _is_fraction(name: str) -> bool:
    first, last = name.split("/")[0], name.split("/")[-1]
    return last in FRACTIONS or first in ("region", "class", TC, CA, DISTANCE, SIZE)
