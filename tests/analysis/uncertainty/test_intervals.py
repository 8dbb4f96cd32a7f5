"""Intervals and p-values against hand computation, SciPy and enumeration."""

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


# Seeds.


def test_student_is_scipys():
    scores = np.array([61.0, 62.5, 60.2, 61.9])
    spread = over_seeds(scores)
    assert spread is not None
    found = student(float(scores.mean()), spread, 0.95)
    theirs = stats.ttest_1samp(scores, 0.0)
    expected = theirs.confidence_interval(0.95)
    np.testing.assert_allclose([found.low, found.high], [expected.low, expected.high], rtol=1e-12)
    assert student_p(float(scores.mean()), spread) == pytest.approx(theirs.pvalue, rel=1e-10)


@pytest.mark.parametrize("sizes", [(2, 2), (3, 3), (5, 2), (2, 8)])
def test_welch_is_scipys(sizes: tuple[int, int]):
    rng = np.random.default_rng(sum(sizes))
    a, b = rng.normal(60.0, 0.3, sizes[0]), rng.normal(61.0, 2.0, sizes[1])
    spread = over_seeds(a, b)
    theirs = stats.ttest_ind(b, a, equal_var=False)
    assert spread is not None
    assert spread.freedom == pytest.approx(theirs.df)
    value = float(b.mean() - a.mean())
    assert student_p(value, spread) == pytest.approx(theirs.pvalue)
    found, expected = student(value, spread, 0.9), theirs.confidence_interval(0.9)
    np.testing.assert_allclose([found.low, found.high], [expected.low, expected.high])


def test_no_spread_of_one_seed_or_a_missing_score():
    two = np.array([1.0, 2.0])
    assert over_seeds(np.array([1.0])) is None
    assert over_seeds(two, np.array([1.0])) is None
    assert over_seeds(np.array([1.0, np.nan])) is None
    assert over_seeds(two, np.array([np.nan, 1.0, 2.0])) is None


def test_seeds_that_are_equal():
    """No spread at all: the interval is the value, and only 0 is 0."""
    spread = over_seeds(np.array([2.0, 2.0]), np.array([2.0, 2.0, 2.0]))
    assert spread == Spread(0.0, 1)
    assert student(1.5, Spread(0.0, 1), 0.95) == Interval(1.5, 1.5)
    assert student_p(0.0, Spread(0.0, 1)) == 1.0
    assert student_p(1.5, Spread(0.0, 1)) == 0.0


def test_together_by_hand():
    """3-4-5; freedom 25^2 / (9^2 / 3 + 16^2 / 4) = 625 / 91."""
    found = together(Spread(3.0, 3.0), Spread(4.0, 4.0))
    assert found.error == pytest.approx(5.0)
    assert found.freedom == pytest.approx(625 / 91)


# p-values.


def test_holm_by_hand():
    """0.01 x 4, 0.02 x 3, 0.03 x 2 = 0.06, 0.04 x 1 -> not below the one before it."""
    assert holm([0.03, 0.01, 0.04, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
    assert holm([0.02]) == [0.02]
    assert holm([]) == []
    assert holm([math.nan, 0.01, 0.03])[1:] == pytest.approx([0.02, 0.03])
    assert math.isnan(holm([math.nan, 0.01])[0])


def test_interval_of_absolute_differences_reaches_0_where_all_is_chance() -> None:
    # Resamples around a mean of 1.2, 0.2 above the value, whose quantiles are near 1.1 and 1.3.
    drawn, none = np.linspace(1.1, 1.3, 201), Spread(0.0, 9)
    found = of_gaps(1.0, drawn, none, 0.95)
    assert (found.low, found.high) == pytest.approx((1 - 0.2 * (1 + 2**0.5), 1.295))
    assert of_gaps(1.0, drawn + 0.3, none, 0.95).low == 0.0
    # Large differences: no bias, Student's t of 9 degrees of freedom is 2.262.
    found = of_gaps(8.0, np.linspace(6.0, 9.8, 201), Spread(0.5, 9), 0.95)
    assert found.low == pytest.approx(6.095, abs=1e-3)  # never above the lower quantile
    found = of_gaps(8.0, np.linspace(7.5, 8.4, 201), Spread(0.5, 9), 0.95)
    assert found.low == pytest.approx(8 - 2.262 * 0.5, abs=1e-3)
