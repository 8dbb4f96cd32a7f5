"""Intervals and p-values against hand computation and SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from analysis.uncertainty.intervals import (
    Interval,
    Spread,
    corrected,
    holm,
    of_gaps,
    over_images,
    over_seeds,
    student,
    student_p,
    together,
)

NONE = Spread(0.0, 9)


def test_spread_over_images_omits_nan() -> None:
    """Draws 1 and 3: standard deviation 1, times sqrt(B / (B - 1)) of 10 blocks."""
    found = over_images(np.array([1.0, np.nan, 3.0]), 10)
    assert found == Spread(pytest.approx(math.sqrt(10 / 9)), 9)
    assert over_images(np.full(3, np.nan), 10) is None
    assert over_images(np.empty(0), 10) is None
    # Of two strata the smaller one decides, and each costs a degree of freedom.
    assert over_images(np.array([1.0, 3.0]), 10, 30) == Spread(pytest.approx(found.error), 38)
    assert over_images(np.array([1.0, 3.0]), 1, 30) is None


def test_variance_interval_has_no_bias_and_holds_the_value() -> None:
    """Bias 3 of a value of 10, error 1 of 9 degrees of freedom (t = 2.262)."""
    found = corrected(10.0, 3.0, Spread(1.0, 9), 0.95)
    assert (found.low, found.high) == pytest.approx((7 - 2.262, 10), abs=1e-3)
    assert corrected(1.0, 0.9, Spread(1.0, 9), 0.95).low == 0.0


def test_interval_of_absolute_differences_reaches_0_by_chance() -> None:
    # Resamples around a mean of 1.2, 0.2 above the value, whose quantiles are near 1.1 and 1.3.
    drawn = np.linspace(1.1, 1.3, 201)
    found = of_gaps(1.0, drawn, NONE, 0.95)
    assert (found.low, found.high) == pytest.approx((1 - 0.2 * (1 + 2**0.5), 1.295))
    assert of_gaps(1.0, drawn + 0.3, NONE, 0.95).low == 0.0
    # Large differences: no bias, Student's t of 9 degrees of freedom is 2.262.
    found = of_gaps(8.0, np.linspace(6.0, 9.8, 201), Spread(0.5, 9), 0.95)
    assert found.low == pytest.approx(6.095, abs=1e-3)  # never above the lower quantile
    found = of_gaps(8.0, np.linspace(7.5, 8.4, 201), Spread(0.5, 9), 0.95)
    assert found.low == pytest.approx(8 - 2.262 * 0.5, abs=1e-3)


@pytest.mark.parametrize("sizes", [(4,), (2, 2), (5, 2), (2, 8)])
def test_student_and_welch_are_scipys(sizes: tuple[int, ...]) -> None:
    rng = np.random.default_rng(sum(sizes))
    a, *others = (rng.normal(60 + place, 0.3 + place, size) for place, size in enumerate(sizes))
    value = float(a.mean()) - sum(float(other.mean()) for other in others)
    theirs = stats.ttest_ind(a, *others, equal_var=False) if others else stats.ttest_1samp(a, 0.0)
    spread = over_seeds(a, *others)
    assert spread is not None
    assert student_p(value, spread) == pytest.approx(theirs.pvalue)
    found, expected = student(value, spread, 0.9), theirs.confidence_interval(0.9)
    np.testing.assert_allclose([found.low, found.high], [expected.low, expected.high])


def test_no_spread_of_one_seed_or_a_missing_score() -> None:
    two = np.array([1.0, 2.0])
    for one in (np.array([1.0]), np.array([1.0, np.nan])):
        assert over_seeds(one) is over_seeds(two, one) is None
    # Equal seeds: the interval is the value, and only 0 is 0.
    assert over_seeds(np.array([2.0, 2.0]), np.array([2.0, 2.0, 2.0])) == Spread(0.0, 1)
    assert student(1.5, NONE, 0.95) == Interval(1.5, 1.5)
    assert (student_p(0.0, NONE), student_p(1.5, NONE)) == (1.0, 0.0)


def test_together_by_hand() -> None:
    """3-4-5; freedom 25^2 / (9^2 / 3 + 16^2 / 4) = 625 / 91."""
    found = together(Spread(3.0, 3.0), Spread(4.0, 4.0))
    assert (found.error, found.freedom) == pytest.approx((5.0, 625 / 91))


def test_holm_by_hand() -> None:
    """0.01 x 4, 0.02 x 3, 0.03 x 2 = 0.06, 0.04 x 1 -> not below the one before it."""
    assert holm([0.03, 0.01, 0.04, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
    found = holm([math.nan, 0.01, 0.03])
    assert math.isnan(found[0])
    assert found[1:] == pytest.approx([0.02, 0.03])
