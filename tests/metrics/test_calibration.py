"""Expected calibration error of a few pixels, by hand and by a loop over pixels."""

from __future__ import annotations

import numpy as np
import pytest

from rgbt.metrics.calibration import UNITS, CalibrationCounter, ece
from rgbt.metrics.metric import Regions

ONE = Regions(partition="ring", regions=1, aspect="image", absent="released")
HALVES = Regions(partition="vertical", regions=2, aspect=None, absent="released")


def test_counts_and_error_of_six_pixels_by_hand() -> None:
    label = np.array([[0, 0, 1], [1, 1, 255]], np.uint8)
    prediction = np.array([[0, 1, 1], [1, 0, 0]], np.uint8)
    confidence = np.array([[0.9, 0.8, 0.75], [0.5, 0.4, 0.99]])
    found = CalibrationCounter(2, ONE, 2)(label, prediction, confidence)
    # Bin 1 (0, 0.5]: 0.5 right, predicted 1; 0.4 wrong, predicted 0.
    # Bin 2 (0.5, 1]: 0.9 right, predicted 0; 0.8 wrong and 0.75 right, predicted 1. One is ignored.
    assert found[0].tolist() == [[1, 1], [0, 1], [4000, 5000]]
    assert found[1].tolist() == [[1, 2], [1, 1], [9000, 15500]]
    # |1 - 0.9| + |2 - 2.45| over 5 pixels.
    assert ece(found) == pytest.approx((0.1 + 0.45) / 5)
    # Predicted 1: |1 - 0.5| + |1 - 1.55| over 3 pixels.
    assert ece(found[..., 1:]) == pytest.approx((0.5 + 0.55) / 3)


@pytest.mark.parametrize(
    ("confidence", "expected"),
    # 1/15 and 3/15 are upper ends of their bins; 0 is in the first bin.
    [(0.0, 0), (0.0001, 0), (1 / 15, 0), (0.0668, 1), (0.2, 2), (0.2001, 3), (1.0, 14)],
)
def test_bins_are_open_below_and_closed_above(confidence: float, expected: int) -> None:
    pixel = np.zeros((1, 1), np.uint8)
    found = CalibrationCounter(1, ONE, 15)(pixel, pixel, np.full((1, 1), confidence))
    assert np.flatnonzero(found[:, 0, 0]).tolist() == [expected]


def test_counts_of_images_and_regions_add_exactly() -> None:
    rng = np.random.default_rng(0)
    label, prediction = (rng.integers(0, 3, (12, 16)) for _ in range(2))
    confidence = rng.random((12, 16)).astype(np.float32)
    whole = CalibrationCounter(3, ONE, 15)(label, prediction, confidence)
    halves = CalibrationCounter(3, HALVES, 15)(label, prediction, confidence)
    assert np.array_equal(halves.reshape(2, 15, 3, 3).sum(0), whole)


def test_error_equals_a_loop_over_pixels_up_to_the_rounding() -> None:
    rng = np.random.default_rng(1)
    label, prediction = (rng.integers(0, 3, (40, 50)) for _ in range(2))
    confidence = rng.random((40, 50))
    bins: dict[int, list[float]] = {}
    for right, sure in zip((label == prediction).ravel(), confidence.ravel(), strict=True):
        bins.setdefault(int(np.ceil(sure * 15)), []).append(float(right) - sure)
    expected = sum(abs(sum(gaps)) for gaps in bins.values()) / 2000
    found = CalibrationCounter(3, ONE, 15)(label, prediction, confidence)
    assert ece(found) == pytest.approx(expected, abs=0.5 / UNITS)


def test_error_without_pixels_is_undefined() -> None:
    assert np.isnan(ece(np.zeros((15, 3, 2), np.int64)))
