"""Claims whose truth is known, to see how often verdicts are wrong.

The difference between two rows is normal over seeds with a standard deviation of 1, and normal over
images with the standard error `ratio`, which is estimated from 40 blocks of images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_t

from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.verdicts import PRECISION, Kind, Rule, decide, half_width

HIGHER = (0.0, math.inf)
BLOCKS = 40
FIRST, LAST = 3, 20
"""Seeds at the first look and at the last one."""

Outcome = tuple[Kind, int]


@dataclass(frozen=True)
class Rates:
    """Shares of verdicts, and the mean number of seeds at the verdict or at the end."""

    holds: float
    contradicted: float
    seeds: float

    @classmethod
    def of(cls, outcomes: Sequence[Outcome]) -> Rates:
        kinds = [kind for kind, _ in outcomes]
        holds, contradicted = (kinds.count(kind) / len(kinds) for kind in ("holds", "contradicted"))
        return cls(holds, contradicted, float(np.mean([seeds for _, seeds in outcomes])))

    def __str__(self) -> str:
        return f"{100 * self.holds:.1f} / {100 * self.contradicted:.1f} / {self.seeds:.1f}"


def draw(rng: np.random.Generator, effect: float, ratio: float) -> tuple[np.ndarray, float]:
    """Differences of `LAST` seeds on the same images, and their estimated error over images."""
    estimated = ratio * math.sqrt(rng.chisquare(BLOCKS - 1) / (BLOCKS - 1))
    return effect + ratio * rng.normal() + rng.normal(size=LAST), estimated


def verdict_of(values: np.ndarray, error: float, rule: Rule) -> Kind:
    """The verdict about "higher"."""
    evidence = Evidence(
        values=tuple(values), seeds=tuple(range(len(values))), error=error, blocks=BLOCKS, said=""
    )
    return decide([evidence], HIGHER, rule, "all").kind


def until_decided(values: np.ndarray, error: float, rule: Rule) -> Outcome:
    """Verdict and number of seeds where one is added at a time."""
    for seeds in range(FIRST, LAST + 1):
        kind = verdict_of(values[:seeds], error, rule)
        if kind != "undecided":
            return kind, seeds
    return "undecided", LAST


def with_seeds(seeds: int) -> Callable[[np.ndarray, float, Rule], Outcome]:
    """The verdict with a number of seeds that is chosen beforehand."""
    return lambda values, error, rule: (verdict_of(values[:seeds], error, rule), seeds)


def rates(
    tables: int,
    effect: float,
    ratio: float,
    outcome: Callable[[np.ndarray, float, Rule], Outcome],
    rule: Rule,
) -> Rates:
    """Verdicts about one claim of each table; the tables are the same for every rule."""
    rng = np.random.default_rng([7, round(10 * effect) + 100, round(10 * ratio)])
    return Rates.of([outcome(*draw(rng, effect, ratio), rule) for _ in range(tables)])


def any_wrong(tables: int, claims: int, ratio: float, rule: Rule) -> float:
    """Share of tables in which one of `claims` claims without a difference ever holds."""
    rng = np.random.default_rng([8, round(10 * ratio)])

    def wrong() -> bool:
        drawn = [draw(rng, 0.0, ratio) for _ in range(claims)]
        return any(until_decided(*claim, rule)[0] == "holds" for claim in drawn)

    return float(np.mean([wrong() for _ in range(tables)]))


def halves(longest: int, alpha: float, precision: float = PRECISION) -> np.ndarray:
    """(longest - 1,) half widths of the sequence for 2, 3, ... values of standard deviation 1."""
    return np.array([half_width(1.0, n, alpha, precision) for n in range(2, longest + 1)])


def running(rng: np.random.Generator, longest: int) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations of the first 2, 3, ... of standard normal values."""
    values, counts = rng.normal(size=longest), np.arange(1, longest + 1)
    means = values.cumsum() / counts
    squares = np.maximum((values**2).cumsum() - counts * means**2, 0.0)
    return means[1:], np.sqrt(squares[1:] / (counts[1:] - 1))


def ever_missed(sequences: int, longest: int, ratio: float) -> dict[str, float]:
    """Share of sequences in which one interval after 2 to `longest` seeds misses the truth.

    Ways to join the halves over seeds and images at a level of 95 %: squares with the whole error
    rate for each, squares with half of it for each (as `Rule` does), sums with half of it for each.
    """
    rng = np.random.default_rng([9, round(100 * ratio)])
    whole, split = halves(longest, 0.05), halves(longest, 0.025)
    quantiles = [float(student_t.ppf(1 - alpha / 2, BLOCKS - 1)) for alpha in (0.05, 0.025)]
    missed = dict.fromkeys(("squares, whole", "squares, half", "sum, half"), 0)
    for _ in range(sequences):
        means, sds = running(rng, longest)
        error = ratio * math.sqrt(rng.chisquare(BLOCKS - 1) / (BLOCKS - 1))
        off = np.abs(means + ratio * rng.normal())
        missed["squares, whole"] += bool((off > np.hypot(sds * whole, quantiles[0] * error)).any())
        missed["squares, half"] += bool((off > np.hypot(sds * split, quantiles[1] * error)).any())
        missed["sum, half"] += bool((off > sds * split + quantiles[1] * error).any())
    return {way: count / sequences for way, count in missed.items()}
