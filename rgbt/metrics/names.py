"""Define every metric name once, and how a score is shown.

Scores are fractions 0..1; `VAR` alone is in squared percent points. Of warping error, flicker and
ECE 0 is best.
"""

from __future__ import annotations

from collections.abc import Mapping

MIOU = "mIoU"  # mean over scored classes, pixels of the whole image pooled (no mean of regions)
VAR = "Var"  # population variance of the mIoU of the regions in percent (SpatialSeg, Eq. 19)
MACC = "mAcc"  # mean over classes of the recall, which the papers call accuracy
MPRECISION = "mPrecision"
MF1 = "mF1"
PIXEL_ACCURACY = "pixel_accuracy"  # share of the valid pixels that are right

# Of pairs of frames, see `rgbt.metrics.pairs`.
TC = "TC"  # mean over classes of the temporal consistency (Temporal, Fig. 4)
CA = "CA"  # mean over classes of the consistent accuracy, over the exact union of three sets
CA_RELEASED = "CA_released"  # the same over the union that the Temporal release computes
WARPING_ERROR = "warping_error"  # share of the pixels seen in both frames whose class changes
FLICKER = "flicker"  # share of the pixels seen in three frames whose class changes and changes back

# Of details, see `rgbt.metrics.details`.
BOUNDARY_MIOU = "boundary_mIoU"
BOUNDARY_IOU = "boundary_IoU"  # of one class
ECE = "ECE"  # expected calibration error
DISTANCE = "distance"
SIZE = "size"

DAY = "day"
NIGHT = "night"
REGION_PROFILE = "profile/iou_by_region"  # as a line: the step is the region number

FRACTIONS = {
    *(MIOU, MACC, MPRECISION, MF1, PIXEL_ACCURACY, BOUNDARY_MIOU, BOUNDARY_IOU, ECE),
    *(WARPING_ERROR, FLICKER),
}


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
    """A score of details inside one region."""
    return f"region/{number}/{name}"


def consistency(score: str, protocol: str) -> str:
    """`TC` or `CA` among the scores of a run; under "released" CA is that of `CA_RELEASED`."""
    return f"{score}/{protocol}"


def subset(part: str, name: str) -> str:
    """Metric `name` over the images of one part, e.g. ``subset(DAY, MIOU)``: "day/mIoU"."""
    return f"{part}/{name}"


def by_head(head: str, name: str) -> str:
    """Metric `name` as one of two heads predicts: ``by_head("source", "night/mIoU")``."""
    return f"{head}_head/{name}"


def in_percent(name: str, value: float) -> float:
    """A score in percent with all its digits; Var and what is no score keep their unit."""
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
