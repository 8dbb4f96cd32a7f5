"""Intervals and p-values against hand computation, SciPy and enumeration."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from analysis.uncertainty.intervals import (
    Interval,
    Spread,
    holm,
    of_gaps,
    over_images,
    over_seeds,
    student,
    student_p,
    swap_p,
    together,
)


@pytest.mark.parametrize("seed", range(4))
def test_bca_is_scipys(seed: int):
    """The ratio of sums of a skewed sample; the draws are SciPy's own."""
    sample = np.random.default_rng(seed).lognormal(0.0, 1.0, 25)

    def score(values: np.ndarray, axis: int = -1) -> np.ndarray:
        return (values**2).sum(axis) / values.sum(axis)

    theirs = stats.bootstrap((sample,), score, n_resamples=999, method="BCa", rng=seed)
    without = np.array([score(np.delete(sample, place)) for place in range(25)])
    resampled = theirs.bootstrap_distribution
    found = over_images(float(score(sample)), resampled, without, method="bca", level=0.95)
    expected = theirs.confidence_interval
    assert found is not None
    np.testing.assert_allclose([found.low, found.high], expected, rtol=1e-12)
    plain = over_images(float(score(sample)), resampled, without, method="percentile", level=0.95)
    assert plain != found  # the correction does something here


def test_bca_counts_half_of_the_ties():
    """All resamples equal the score: no bias, and the interval is that one value."""
    found = over_images(5.0, np.full(200, 5.0), np.full(20, 5.0), method="bca", level=0.95)
    assert found == Interval(5.0, 5.0)


@pytest.mark.parametrize("method", ["bca", "percentile"])
def test_nan_is_omitted(method):
    rng = np.random.default_rng(0)
    known, without = rng.normal(size=400), rng.normal(size=30)
    holes = np.full(100, np.nan)
    expected = over_images(0.1, known, without, method=method, level=0.9)
    mixed = rng.permutation(np.concatenate([known, holes]))
    found = over_images(0.1, mixed, np.append(without, np.nan), method=method, level=0.9)
    assert found == expected
    for value, resampled in ((math.nan, known), (1.0, holes), (1.0, np.empty(0))):
        assert over_images(value, resampled, without, method=method, level=0.9) is None


@pytest.mark.parametrize("method", ["bca", "percentile"])
@pytest.mark.parametrize("value", [-9.0, 0.3, 9.0])
def test_interval_holds_the_value(method, value: float):
    """Resampling raises a variance over regions: quantiles alone can miss the score itself."""
    resampled, without = np.linspace(-1.0, 1.0, 400), np.linspace(0.0, 1.0, 20)
    found = over_images(value, resampled, without, method=method, level=0.9)
    assert found is not None
    assert value in found
    assert found.low <= found.high


def test_bca_of_the_negative_is_mirrored():
    rng = np.random.default_rng(0)
    resampled, without = rng.gamma(2.0, size=1000), rng.gamma(2.0, size=20)
    found = over_images(2.0, resampled, without, method="bca", level=0.95)
    mirrored = over_images(-2.0, -resampled, -without, method="bca", level=0.95)
    assert found is not None
    assert mirrored is not None
    np.testing.assert_allclose([mirrored.low, mirrored.high], [-found.high, -found.low])


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


def test_swap_p_by_hand():
    swapped = np.array([0.0, 1.0, -2.0, 2.0, -3.0, np.nan])
    assert swap_p(2.0, swapped) == pytest.approx((3 + 1) / (5 + 1))
    assert swap_p(-2.0, swapped) == pytest.approx((3 + 1) / (5 + 1))
    assert swap_p(9.0, swapped) == pytest.approx(1 / 6)
    assert swap_p(0.0, swapped) == 1.0
    assert math.isnan(swap_p(math.nan, swapped))
    assert swap_p(1.0, np.full(3, np.nan)) == 1.0
    assert swap_p(0.1 + 0.2, np.full(99, -0.3)) == 1.0  # equal but for rounding


def test_swap_p_against_all_signs():
    """Of 2^8 exchanges of 8 paired differences, as many are as far out as the draws say."""
    pairs = np.array([0.3, 1.1, -0.2, 0.9, 0.4, 0.7, -0.1, 0.8])
    every = np.array([pairs @ signs for signs in itertools.product([1, -1], repeat=8)])
    exact = float((np.abs(every) >= abs(pairs.sum()) - 1e-9).mean())
    rng = np.random.default_rng(0)
    drawn = (1 - 2 * rng.integers(0, 2, (20_000, 8))) @ pairs
    assert swap_p(float(pairs.sum()), drawn) == pytest.approx(exact, abs=4 * 0.5 / 20_000**0.5)
    assert swap_p(float(pairs.sum()), every) == pytest.approx((256 * exact + 1) / 257)


def test_holm_by_hand():
    """0.01 x 4, 0.02 x 3, 0.03 x 2 = 0.06, 0.04 x 1 -> not below the one before it."""
    assert holm([0.03, 0.01, 0.04, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
    assert holm([0.02]) == [0.02]
    assert holm([]) == []
    assert holm([math.nan, 0.01, 0.03])[1:] == pytest.approx([0.02, 0.03])
    assert math.isnan(holm([math.nan, 0.01])[0])


def test_interval_of_absolute_differences_reaches_0_where_all_is_chance() -> None:
    around = Interval(1.2, 1.6)
    # Without error: 1 - (1 + sqrt 2) 0.2 = 0.517; with a bias of 0.5 below 0.
    found = of_gaps(1.0, 0.2, Spread(0.0, 9), around, 0.95)
    assert (found.low, found.high) == pytest.approx((1 - 0.2 * (1 + 2**0.5), 1.6))
    assert of_gaps(1.0, 0.5, Spread(0.0, 9), around, 0.95).low == 0.0
    # Large differences: no bias, Student's t of 9 degrees of freedom is 2.262.
    found = of_gaps(8.0, -0.1, Spread(0.5, 9), Interval(7.5, 8.5), 0.95)
    assert (found.low, found.high) == pytest.approx((8 - 2.262 * 0.5, 8.5), abs=1e-3)
    # Never above the lower quantile.
    assert of_gaps(8.0, 0.0, Spread(0.0, 9), Interval(7.5, 8.5), 0.95).low == 7.5
