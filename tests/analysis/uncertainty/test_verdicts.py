"""Verdicts about contrasts: both rules by hand, several contrasts, seeds needed, error rates."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy import integrate, stats

from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.intervals import Spread
from analysis.uncertainty.verdicts import (
    ONE_START,
    Rule,
    Verdict,
    decide,
    e_value,
    half_width,
    similar,
)
from tests.analysis.uncertainty.simulated_claims import (
    any_wrong,
    ever_missed,
    halves,
    rates,
    running,
    until_decided,
    with_seeds,
)

HIGHER, LOWER = (0.0, math.inf), (-math.inf, 0.0)
FIXED, ANY = Rule(), Rule(any_time=True)


def evidence(*values: float, error: float = 0.1, blocks: int = 40) -> Evidence:
    """Of as many seeds as values."""
    seeds = tuple(range(len(values)))
    return Evidence(values=values, seeds=seeds, error=error, blocks=blocks, said="")


def as_trained(value: float, error: float = 1.0) -> Evidence:
    """Of fixed terms alone, on a million blocks: half widths are normal quantiles."""
    return Evidence(values=(value,), seeds=(), error=error, blocks=10**6, said="")


def spread(count: int, mean: float, sd: float, error: float = 0.1) -> Evidence:
    """`count` values with this mean and standard deviation."""
    values = np.linspace(-1, 1, count)
    return evidence(*(mean + sd * values / values.std(ddof=1)), error=error)


def test_fixed_seeds_by_hand() -> None:
    """1, 2, 3: Student's half width over seeds is 4.3027 / sqrt(3) = 2.484, above the joint one.

    With four seeds and the same standard deviation it is 3.182 / 2 = 1.59, below the mean of 2.
    """
    found = decide([evidence(1.0, 2.0, 3.0)], HIGHER, FIXED, "all")
    assert found.interval is not None
    assert found.interval.low == pytest.approx(2 - 2.4841, abs=1e-3)
    assert found.interval.high == pytest.approx(2 + 2.4841, abs=1e-3)
    assert found == Verdict(
        kind="undecided",
        estimate=2.0,
        interval=found.interval,
        covers="images and seeds",
        smallest=found.interval.half,
        seeds=3,
        seeds_needed=4.0,
        decisive=0,
        reason="Below 2.48, nothing can be shown with these seeds and images.",
    )


def test_any_time_by_hand() -> None:
    """Half of the error rate for the sequence over seeds, half for Student over 40 blocks."""
    values = (1.0, 2.0, 3.0, 2.5, 1.5)
    found = decide([evidence(*values, error=0.3)], HIGHER, ANY, "all")
    of_seeds = half_width(np.std(values, ddof=1), 5, 0.025)
    of_images = stats.t.ppf(1 - 0.0125, 39) * 0.3
    assert found.smallest == pytest.approx(math.hypot(of_seeds, of_images))
    assert (found.kind, found.seeds, found.covers) == ("undecided", 5, "images and seeds")
    assert decide([spread(5, 4.0, 0.79)], HIGHER, ANY, "all").kind == "holds"
    assert decide([spread(5, -4.0, 0.79)], HIGHER, ANY, "all").kind == "contradicted"


@pytest.mark.parametrize(
    ("given", "rule", "kind", "covers", "reason", "needed"),
    [
        (spread(3, 4.0, 1.0), ANY, "undecided", "none", "3 seeds are too few for an int", 5.0),
        (evidence(5.0), FIXED, "undecided", "images", "It needs two seeds", math.nan),
        (evidence(5.0), ANY, "undecided", "images", "It needs two seeds", math.nan),
        # Fixed terms are decided over images alone.
        (as_trained(2.0), FIXED, "holds", "images", "As trained: other trainings are not", 0.0),
        (as_trained(2.0), ANY, "holds", "images", "As trained: other trainings are not", 0.0),
        (as_trained(1.9), FIXED, "undecided", "images", "These images leave it open", math.inf),
        (
            *(evidence(1.0, 2.0, error=math.nan, blocks=9), FIXED, "undecided", "none"),
            *("There are too few images", math.nan),
        ),
        (spread(5, 1.0, 1.0, 0.6), FIXED, "undecided", "images and seeds", "These im", math.inf),
        (
            *(evidence(0.0, 0.0, error=0.0), FIXED, "undecided", "images and seeds"),
            *("The estimate is the limit of the claimed range", math.inf),
        ),
    ],
)
def test_verdict_says_what_it_covers_and_needs(
    given: Evidence, rule: Rule, kind: str, covers: str, reason: str, needed: float
) -> None:
    found = decide([given], HIGHER, rule, "all")
    assert (found.kind, found.covers) == (kind, covers)
    assert found.reason.startswith(reason)
    assert found.seeds_needed == pytest.approx(needed, nan_ok=True)
    assert (found.interval is None) == math.isnan(found.smallest) == (covers == "none")


@pytest.mark.parametrize(
    ("wanted", "combine", "values", "kind", "decisive"),
    [
        # A half width of 1.96 in a range of 6, and in "does as well as".
        *(((1.0, 7.0), "all", (value,), "undecided", 0) for value in (2.9, 5.1, -0.9, 8.9)),
        *(((1.0, 7.0), "all", (value,), "contradicted", 0) for value in (-1.0, 9.0)),
        ((1.0, 7.0), "all", (4.0,), "holds", 0),
        (similar(2.5), "all", (0.5,), "holds", 0),
        (similar(2.4), "all", (0.5,), "undecided", 0),  # no difference is shown either
        *((similar(2.5), "all", (value,), "undecided", 0) for value in (-0.6, -4.4)),
        (similar(2.5), "all", (4.5,), "contradicted", 0),
        # One-sided quantiles: 1.960 alone, 2.241 for two, 2.394 for three contrasts.
        (HIGHER, "all", (3.0, 2.0, 4.0), "holds", 1),
        (HIGHER, "all", (3.0, 1.9, 4.0), "undecided", 1),
        (HIGHER, "all", (3.0, -2.3, 4.0), "undecided", 1),
        (HIGHER, "all", (3.0, -2.5, 4.0), "contradicted", 1),
        (HIGHER, "any", (0.0, 2.5, -9.0), "holds", 1),
        (HIGHER, "any", (0.0, 2.3, -9.0), "undecided", 1),
        (HIGHER, "any", (-2.0, -3.0, -4.0), "contradicted", 0),
        (HIGHER, "any", (-1.9, -3.0, -4.0), "undecided", 0),
        (HIGHER, "most", (2.3, 9.0, -9.0), "holds", 0),
        (HIGHER, "most", (2.1, 9.0, -9.0), "undecided", 0),
        (HIGHER, "most", (-2.3, 9.0, -9.0), "contradicted", 0),
        (HIGHER, "most", (-2.1, 9.0, -9.0), "undecided", 0),
        (HIGHER, "most", (9.0, 9.0, 0.0, 0.0), "undecided", 2),  # half of them are not most
    ],
)
def test_decision(
    wanted: tuple[float, float],
    combine: str,
    values: tuple[float, ...],
    kind: str,
    decisive: int,
) -> None:
    found = decide([as_trained(value) for value in values], wanted, FIXED, combine)
    assert (found.kind, found.decisive) == (kind, decisive)
    assert found.estimate == values[decisive]
    mirrored = (-wanted[1], -wanted[0])
    found = decide([as_trained(-value) for value in values], mirrored, FIXED, combine)
    assert (found.kind, found.decisive) == (kind, decisive)
    # Rows that were not run may be as claimed or not.
    stands = {"all": "contradicted", "any": "holds"}.get(combine) == kind
    found = decide(
        [as_trained(value) for value in values], wanted, FIXED, combine, missing="B was not run."
    )
    assert (found.kind, found.reason == "B was not run.") == (
        kind if stands else "undecided",
        not stands,
    )


def test_intervals_of_several_contrasts_have_the_level_that_decides() -> None:
    values = [as_trained(value) for value in (0.0, 2.5, -9.0)]
    assert decide(values, HIGHER, FIXED, "any").smallest == pytest.approx(2.394, abs=1e-3)
    assert decide(values[1:2], HIGHER, FIXED, "mean").smallest == pytest.approx(1.960, abs=1e-3)
    for wrong in ([], values):
        with pytest.raises(ValueError, match="mean: expected one evidence, of the mean contrast"):
            decide(wrong, HIGHER, FIXED, "mean")


@pytest.mark.parametrize("rule", [FIXED, ANY])
@pytest.mark.parametrize(("mean", "error"), [(0.6, 0.1), (1.5, 0.3), (0.4, 0.15)])
def test_seeds_needed_is_the_first_number_that_decides(rule, mean: float, error: float) -> None:
    needed = decide([spread(4, mean, 1.0, error)], HIGHER, rule, "all").seeds_needed
    assert 4 < needed < 500
    before = decide([spread(int(needed) - 1, mean, 1.0, error)], HIGHER, rule, "all")
    assert (before.kind, before.seeds_needed) == ("undecided", needed)
    assert decide([spread(int(needed), mean, 1.0, error)], HIGHER, rule, "all").kind == "holds"


def test_more_seeds_never_widen_an_interval() -> None:
    """What the search for `seeds_needed` relies on."""
    for rule, error, blocks in itertools.product((FIXED, ANY), (0.0, 0.05, 0.3, 3.0), (10, 400)):
        images = Spread(error, blocks - 1)
        counts = (*range(2, 40), *range(40, 1001, 40))
        widths = [rule.half(Spread(1 / math.sqrt(n), n - 1), images, 0.95) for n in counts]
        finite = np.array([width for width in widths if math.isfinite(width)])
        assert (np.diff(finite) <= 1e-9).all(), (rule, error, blocks)


# Rates, on 100 tables: bounds are 5 % and three standard errors. The page of the documentation has
# those of 1,000 tables (python -m tests.benchmarks.simulate_claims).

BOUND = 0.05 + 3 * math.sqrt(0.05 * 0.95 / 100)


def test_error_rates_of_rule_stopping_at_any_time() -> None:
    true, none = (rates(100, effect, 0.3, until_decided, ANY) for effect in (2.0, 0.0))
    assert true.holds > 0.9
    assert true.contradicted <= 0.01
    assert none.holds + none.contradicted <= BOUND
    assert true.seeds < 12 < none.seeds
    assert any_wrong(10, 10, 0.0, ANY) <= 0.25 + 3 * math.sqrt(0.25 * 0.75 / 10)


def test_rates_of_looking_at_fixed_intervals_after_every_seed() -> None:
    """Why `until_decided` is valid `any_time`: else a difference of 0 is decided far too often."""
    looked = rates(60, 0.0, 0.0, until_decided, FIXED)
    assert looked.holds + looked.contradicted > 2 * BOUND
    once = rates(100, 0.0, 0.3, with_seeds(5), FIXED)
    assert once.holds + once.contradicted <= BOUND


# What a verdict rests on.


def test_verdict_on_one_start_has_its_warning() -> None:
    values = evidence(1.0, 2.0, 3.0)
    for starts, given, warning in (
        *((None, values, ""), (1, values, ONE_START), (2, values, "")),
        (1, as_trained(3.0), ""),
    ):
        assert decide([given], HIGHER, FIXED, "all", starts=starts).warning == warning
    for margin in (0.0, -1.0, math.inf):
        with pytest.raises(ValueError, match="largest difference that is none"):
            similar(margin)


def simulated(draw: object, seeds: int, wanted: tuple[float, float] = HIGHER) -> list[float]:
    """Shares that hold and are contradicted of 1,000 claims about `seeds` drawn values."""
    rng = np.random.default_rng(seeds)
    found = [
        decide([evidence(*draw(rng, seeds), error=0.0)], wanted, FIXED, "all").kind
        for _ in range(1000)
    ]
    return [found.count(kind) / 1000 for kind in ("holds", "contradicted")]


@pytest.mark.parametrize(("seeds", "wrong"), [(3, 0.16), (10, 0.16)])
def test_rates_of_seeds_far_from_normal(seeds: int, wrong: float) -> None:
    """Lognormal scores, whose mean is sqrt(e)."""
    rates = simulated(lambda rng, n: rng.lognormal(0, 1, n) - math.exp(0.5), seeds)
    assert sum(rates) == pytest.approx(wrong, abs=0.03)
    assert "14 to 18 %" in " ".join(str(Rule.__doc__).split())


def test_rates_of_one_start() -> None:
    """A start that shifts all seeds, by two of their standard deviations on average."""
    rates = simulated(lambda rng, n: 2 * rng.normal() + rng.normal(size=n), 5)
    assert rates == pytest.approx([0.29, 0.29], abs=0.04)
    assert "29 % with 5" in ONE_START


def test_rates_of_equivalence_at_its_margin() -> None:
    """A true difference as large as the margin is called none in at most 2.5 %."""
    holds, _ = simulated(lambda rng, n: 1.0 + 0.2 * rng.normal(size=n), 5, similar(1.0))
    assert 0.01 < holds < 0.042


# The confidence sequence, by numerical integration and simulation.


@pytest.mark.parametrize("count", [2, 5, 20])
def test_e_value_is_mean_ratio_of_noncentral_t_densities(count: int) -> None:
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
def test_e_value_at_half_width_is_one_over_alpha(count: int) -> None:
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
        np.mean([(np.abs(means) > sds * factor).any() for means, sds in drawn])
        for factor in (factors, naive)
    )
    assert 0.01 < missed < 0.05
    assert fixed > 0.3


@pytest.mark.parametrize("ratio", [0.0, 0.2, 3.0])
def test_images_and_seeds_miss_in_less_than_alpha(ratio: float) -> None:
    """`Rule.any_time` joins squares at half of the error rate; the whole rate is too much."""
    missed = ever_missed(1500, 200, ratio)
    assert missed["squares, half"] < 0.05
    assert missed["sum, half"] <= missed["squares, half"] <= missed["squares, whole"]
    if ratio == 0.2:
        assert missed["squares, whole"] > 0.05
