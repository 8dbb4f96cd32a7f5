"""Define every metric name once, and how a score is shown.

Scores are fractions 0..1; `VAR` alone is in squared percent points. Of warping error, flicker and
ECE 0 is best.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

MIOU = "mIoU"  # mean over scored classes, pixels of the whole image pooled (no mean of regions)
VAR = "Var"  # population variance of the mIoU of the regions in percent (SpatialSeg, Eq. 19)
MACC = "mAcc"  # mean over classes of the recall, which the papers call accuracy
MPRECISION = "mPrecision"
MF1 = "mF1"
PIXEL_ACCURACY = "pixel_accuracy"  # share of the valid pixels that are right

# Scores of pairs of frames, see `rgbt.metrics.pairs`.
TC = "TC"  # mean over classes of the temporal consistency (Temporal, Fig. 4)
CA = "CA"  # mean over classes of the consistent accuracy, over the exact union of three sets
CA_RELEASED = "CA_released"  # the same over the union that the Temporal release computes
WARPING_ERROR = "warping_error"  # share of the pixels seen in both frames whose class changes
FLICKER = "flicker"  # share of the pixels seen in three frames whose class changes and changes back

# Scores of details, see `rgbt.metrics.details`.
BOUNDARY_MIOU = "boundary_mIoU"
BOUNDARY_IOU = "boundary_IoU"  # boundary score of one class
ECE = "ECE"  # expected calibration error
DISTANCE = "distance"
SIZE = "size"

DAY = "day"
NIGHT = "night"
REGION_PROFILE = "profile/iou_by_region"  # as a line: the step is the region number

# Names made of parts.
region = "region/{}".format  # mIoU of a region, 1 = innermost, left or top
class_iou = "class/{}".format  # IoU of a class
of_class = "class/{}/{}".format  # a score of a class: "class/car/TC"
in_region = "region/{}/{}".format  # a score of details inside a region
subset = "{}/{}".format  # a score over the images of a part: "day/mIoU"
consistency = "{}/{}".format  # TC or CA by protocol; under "released" CA is that of `CA_RELEASED`
by_head = "{}_head/{}".format  # as one of two heads predicts: "source_head/night/mIoU"

FRACTIONS = {
    MIOU,
    MACC,
    MPRECISION,
    MF1,
    PIXEL_ACCURACY,
    BOUNDARY_MIOU,
    BOUNDARY_IOU,
    ECE,
    WARPING_ERROR,
    FLICKER,
}


def in_percent(name: str, value: float) -> float:
    """Turn a score into percent with all its digits; Var and what is no score keep their unit."""
    return 100 * value if _is_fraction(name) else value


def shown(values: Mapping[str, float]) -> dict[str, float]:
    """Turn scores into percent with two decimals, as papers print them and MLflow shows them.

    Its charts write 0.62 for a fraction, and its tables all sixteen digits. A region is named as
    the papers do, "IoU1": it heads a column, and sorts first, as its scatter plot takes its axis.
    """
    scores = {n for n in values if _is_fraction(n) or n.split("/")[-1] == VAR}
    found = {n: round(in_percent(n, v), 2) if n in scores else v for n, v in values.items()}
    return {re.sub(r"^region/(\d+)$", r"IoU\1", name): v for name, v in found.items()}


def _is_fraction(name: str) -> bool:
    first, last = name.split("/")[0], name.split("/")[-1]
    return last in FRACTIONS or first in ("region", "class", TC, CA, DISTANCE, SIZE)
