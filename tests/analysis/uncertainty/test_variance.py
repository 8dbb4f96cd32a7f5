"""Intervals of standard deviations, and the smallest difference of paired seeds, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.uncertainty.intervals import Spread
from analysis.uncertainty.variance import sd_interval, smallest_difference


def test_sd_interval_values_from_the_chi_square_table() -> None:
    found = sd_interval(0.5, 7)  # chi2(0.975, 7) = 16.013, chi2(0.025, 7) = 1.690
    assert found.low == pytest.approx(0.5 * math.sqrt(7 / 16.013), rel=1e-4)
    assert found.high == pytest.approx(0.5 * math.sqrt(7 / 1.690), rel=1e-3)
    assert sd_interval(0.5, 7, 0.5).high < found.high


def test_sd_interval_holds_the_truth_in_95_percent_of_cases() -> None:
    runs = np.random.default_rng(0).normal(0.0, 2.0, (4000, 4))
    intervals = [sd_interval(float(sd), 3) for sd in runs.std(1, ddof=1)]
    assert np.mean([2.0 in each for each in intervals]) == pytest.approx(0.95, abs=0.012)


def test_smallest_difference_of_fixed_images_is_students() -> None:
    # t(0.975, 3) = 3.1824, t(0.975, 7) = 2.3646
    assert smallest_difference(1.0, 4) == pytest.approx(3.1824 / 2, rel=1e-4)
    assert smallest_difference(0.3, 8) == pytest.approx(2.3646 * 0.3 / math.sqrt(8), rel=1e-4)


def test_smallest_difference_images_are_added_and_never_make_it_smaller() -> None:
    # Both errors are 0.5; Satterthwaite: 0.5**2 / (0.25**2 / 3 + 0.25**2 / 100) = 11.65
    with_images = smallest_difference(1.0, 4, Spread(0.5, 100))
    assert with_images == pytest.approx(smallest_difference(1.0, 4))  # 2.186 * 0.7071 is below it
    # 1 and 2: 5**2 / (1 / 3 + 16 / 100) = 50.68 degrees of freedom, t = 2.0079
    assert smallest_difference(2.0, 4, Spread(2.0, 100)) == pytest.approx(
        2.0079 * math.sqrt(5), rel=1e-3
    )
