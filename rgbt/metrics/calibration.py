"""Expected calibration error: whether a network is right as often as it is confident.

Source: Guo, Pleiss, Sun, Weinberger: "On Calibration of Modern Neural Networks", ICML 2017, Eq. 3,
with M = 15 equal bins (0, 1/M], (1/M, 2/M], ... of the highest probability of each pixel.

The confidence of a pixel is rounded to whole units of 1/10,000 before it is added. So all counts
are integers and add exactly, in any order and over any number of processes. The rounding changes an
error by at most 0.005 percent points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rgbt.metrics.metric import Regions
from rgbt.metrics.scores import Matrices, Scores

NUMBER, CORRECT, CONFIDENCE = range(3)
"""Rows of the counts of each predicted class: pixels, right pixels, sum of confidences."""

UNITS = 10_000
"""Units of a confidence of 1."""


def ece(counts: Matrices) -> Scores:
    """``sum_b |correct_b - confidence_b| / sum_b number_b``, a fraction 0..1.

    That is the mean over pixels of ``|acc(B_m) - conf(B_m)|``. All pixels of all images are pooled,
    those of unscored classes included.

    Shapes: (..., M, 3, K), summed over images -> (...); NaN without pixels.
    """
    by_bin = counts.sum(-1, dtype=np.float64)
    gaps = np.abs(by_bin[..., CORRECT] - by_bin[..., CONFIDENCE] / UNITS).sum(-1)
    number = by_bin[..., NUMBER].sum(-1)
    found: Scores = np.full(np.shape(number), np.nan)
    np.divide(gaps, number, out=found, where=number > 0)
    return found


class CalibrationCounter:
    """Counts pixels, right ones and their confidences by region and bin of one image.

    Args:
        num_classes: K, at least 1.
        regions: the partition.
        bins: M.
    """

    def __init__(self, num_classes: int, regions: Regions, bins: int) -> None:
        self._classes = num_classes
        self._regions = regions
        self._bins = bins

    def __call__(
        self, label: ArrayLike, prediction: ArrayLike, confidence: ArrayLike
    ) -> NDArray[np.int64]:
        """(R M, 3, K) `NUMBER`, `CORRECT` and `CONFIDENCE` by predicted class; images add.

        (H, W) integer labels 0..255, of which K and above are ignored, predictions 0..K-1, and
        their probabilities 0..1.
        """
        label_HW, prediction_HW = np.asarray(label), np.asarray(prediction)
        image_hw = (label_HW.shape[0], label_HW.shape[1])
        sure = np.asarray(confidence, np.float64)
        units = np.rint(sure * UNITS).astype(np.int64)
        # Bin m holds (m / M, (m + 1) / M]; 0 itself is in the first.
        bins = np.ceil(sure * self._bins).astype(np.int64).clip(1, self._bins) - 1
        valid = label_HW < self._classes
        region = self._regions.map(image_hw).astype(np.int64)
        place = ((region * self._bins + bins) * self._classes + prediction_HW)[valid]
        size = self._regions.regions * self._bins * self._classes
        right = (label_HW == prediction_HW)[valid]
        number = np.bincount(place, minlength=size)
        correct = np.bincount(place[right], minlength=size)
        # float64 adds whole numbers below 2^53 exactly.
        total = np.bincount(place, units[valid], minlength=size).astype(np.int64)
        by_place = np.stack([number, correct, total], 1)
        return by_place.reshape(-1, self._classes, 3).transpose(0, 2, 1)
