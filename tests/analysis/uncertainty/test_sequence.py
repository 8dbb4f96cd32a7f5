"""The confidence sequence: its formula against numerical integration, its rates by simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate, stats

from analysis.uncertainty.sequence import e_value, half_width
from tests.analysis.uncertainty.simulated_claims import ever_missed, halves, running


@pytest.mark.parametrize("count", [2, 5, 20])
def test_e_value_is_the_mean_ratio_of_noncentral_t_densities(count: int) -> None:
    precision = 0.25
    for t in (0.5, 2.0, -4.0):

        def ratio(effect: float, t: float = t) -> float:
            density = stats.nct.pdf(t, count - 1, effect * math.sqrt(count))
            return float(density) * stats.norm.pdf(effect, 0, precision**-0.5)

        found, _ = integrate.quad(ratio, -12, 12, limit=200)
        wanted = found / stats.t.pdf(t, count - 1)
        assert e_value(t, count, precision) == pytest.approx(wanted, rel=1e-5)
    assert e_value(3.0, 1) == 1.0  # without a variance


@pytest.mark.parametrize("count", [4, 20, 300])
def test_half_width_is_where_the_e_value_is_one_over_alpha(count: int) -> None:
    for alpha in (0.025, 0.05):
        half = half_width(1.7, count, alpha)
        assert e_value(half * math.sqrt(count) / 1.7, count) == pytest.approx(1 / alpha)


def test_half_width_is_infinite_where_no_t_decides() -> None:
    """The largest e-value of n values is r^((1 - n) / 2): 11.7 for 3, and 70 for 4."""
    assert [math.isinf(half_width(1.0, count, 0.05)) for count in (1, 2, 3, 4)] == [True] * 3 + [
        False
    ]
    assert half_width(0.0, 4, 0.05) == 0.0
    widths = halves(1000, 0.025)
    finite = widths[np.isfinite(widths)]
    assert len(finite) == 997
    assert (np.diff(finite) < 0).all()


def test_sequence_ever_misses_the_mean_in_less_than_alpha() -> None:
    """1500 sequences of 2 to 200 values; the t interval alone misses in more than half of them."""
    rng, factors = np.random.default_rng(1), halves(200, 0.05)
    naive = stats.t.ppf(0.975, np.arange(1, 200)) / np.sqrt(np.arange(2, 201))
    drawn = [running(rng, 200) for _ in range(1500)]
    missed, fixed = (
        np.mean([(np.abs(means) > sds * each).any() for means, sds in drawn])
        for each in (factors, naive)
    )
    assert 0.01 < missed < 0.05
    assert fixed > 0.3


@pytest.mark.parametrize("ratio", [0.0, 0.2, 3.0])
def test_images_and_seeds_together_ever_miss_in_less_than_alpha(ratio: float) -> None:
    """`AnyTime` joins squares at half of the error rate each; the whole rate is too much."""
    missed = ever_missed(1500, 200, ratio)
    assert missed["squares, half"] < 0.05
    assert missed["sum, half"] <= missed["squares, half"] <= missed["squares, whole"]
    if ratio == 0.2:
        assert missed["squares, whole"] > 0.05
