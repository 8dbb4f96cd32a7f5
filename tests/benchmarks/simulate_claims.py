"""Error rates of verdicts on simulated tables.

Each table has a true claim (the difference is two standard deviations over seeds), a false one (as
much in the other direction) and one that cannot be decided (no difference). Rates of wrong verdicts
are those of all tables. docs/explanation/counts-and-intervals.md explains them.

Run: python -m tests.benchmarks.simulate_claims [tables, 1000]
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from analysis.uncertainty import Resampling
from analysis.uncertainty.contrasts import Resampler, Term
from analysis.uncertainty.verdicts import Rule, decide
from rgbt.tables import TextTable
from tests.analysis.uncertainty.simulated import Population, counts_of
from tests.analysis.uncertainty.simulated_claims import (
    FIRST,
    HIGHER,
    Outcome,
    Rates,
    any_wrong,
    ever_missed,
    halves,
    rates,
    running,
    until_decided,
    with_seeds,
)

EFFECT = 2.0
RATIOS = (0.0, 0.3, 1.0, 3.0)
LONGEST = 200
RULES: dict[str, tuple[Callable[[np.ndarray, float, Rule], Outcome], Rule]] = {
    "any time, 3 to 20 seeds": (until_decided, Rule(any_time=True)),
    "repeated fixed t, 3 to 20": (until_decided, Rule()),
    **{f"fixed, {seeds} seeds": (with_seeds(seeds), Rule()) for seeds in (3, 5, 10)},
}


def verdicts(tables: int) -> Iterator[Sequence[str]]:
    """Per rule and ratio: the three claims of a table, and ten claims without a difference."""
    for name, (outcome, rule) in RULES.items():
        for ratio in RATIOS:
            given = (rates(tables, sign * EFFECT, ratio, outcome, rule) for sign in (1, -1, 0))
            several = "-"
            if outcome is until_decided:
                several = f"{100 * any_wrong(tables // 5, 10, ratio, rule):.1f}"
            yield name, f"{ratio:g}", *map(str, given), several


def coverage(sequences: int) -> Iterator[Sequence[str]]:
    """Per ratio: share of sequences that ever miss the truth."""
    for ratio in (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, 3.0, 10.0):
        missed = ever_missed(sequences, LONGEST, ratio).values()
        yield f"{ratio:g}", *(f"{100 * share:.1f}" for share in missed)


def precisions(sequences: int) -> Iterator[Sequence[str]]:
    """Per precision of the prior: seeds until differences of several sizes are shown."""
    for precision in (0.1, 0.25, 0.5, 1.0):
        needed = (
            seeds_until_shown(sequences, effect, 0.025, precision)
            for effect in (1.0, 2.0, 3.0, 5.0)
        )
        yield f"{precision:g}", *(f"{each:.1f}" for each in needed)


def seeds_until_shown(sequences: int, effect: float, alpha: float, precision: float) -> float:
    """Mean number of seeds until the interval over seeds is above 0; 200 where it never is."""
    rng, longest = np.random.default_rng([10, round(10 * effect)]), 200
    factors, needed = halves(longest, alpha, precision), []
    for _ in range(sequences):
        means, sds = running(rng, longest)
        shown = means + effect > sds * factors
        needed.append(int(shown.argmax()) + 2 if shown.any() else longest)
    return float(np.mean(needed))


def counted(tables: int) -> Iterator[Sequence[str]]:
    """Tables of real counts: 60 images, two rows, images drawn anew; up to 10 seeds."""
    rng, last = np.random.default_rng(3), 10
    for skill in (1.5, 1.7):
        outcomes = []
        for number in range(tables):
            first = Population(training_sd=0.08)
            arrays = first.pair(rng, 60, last, Population(skill=skill, training_sd=0.08))
            rows = [dict(enumerate(map(counts_of, each))) for each in arrays]
            terms = [
                Term(
                    weight=weight,
                    metric="mIoU",
                    counts=row,
                    keys={seed: f"{weight}/{seed}" for seed in row},
                )
                for weight, row in zip((-1.0, 1.0), rows, strict=True)
            ]
            resampler = Resampler(Resampling(resamples=300, blocks="none", seed=number))
            outcomes.append(first_verdict(resampler, terms, last))
        yield f"{skill - 1.5:.1f}", *str(Rates.of(outcomes)).split(" / ")


def first_verdict(resampler: Resampler, terms: Sequence[Term], last: int) -> Outcome:
    """Verdict and number of seeds where one is added at a time."""
    for seeds in range(FIRST, last + 1):
        shown = [
            Term(
                weight=term.weight,
                metric=term.metric,
                counts={seed: term.counts[seed] for seed in range(seeds)},
                keys={seed: term.keys[seed] for seed in range(seeds)},
            )
            for term in terms
        ]
        kind = decide([resampler.evidence(shown)], HIGHER, Rule(any_time=True), "all").kind
        if kind != "undecided":
            return kind, seeds
    return "undecided", last


def main(tables: int) -> None:
    """Print four tables as Markdown."""
    shares = "holds / contradicted, % / mean seeds"
    header = ("rule", "image error", "true claim", "false claim", "no difference", "10 claims, %")
    print(TextTable(f"Verdicts: {shares}", header, tuple(verdicts(tables))).to_markdown())
    ways = ("image error", "squares, whole rate", "squares, half rate", "sum, half rate")
    rows = tuple(coverage(10 * tables))
    print(TextTable(f"Sequences that ever miss, %, 2 to {LONGEST} seeds", ways, rows).to_markdown())
    effects = ("precision", *(f"{effect} sd" for effect in (1, 2, 3, 5)))
    rows = tuple(precisions(10 * tables))
    print(TextTable("Mean seeds until shown", effects, rows).to_markdown())
    header = ("difference in skill", "holds", "contradicted", "seeds")
    rows = tuple(counted(max(1, tables // 5)))
    print(TextTable("Counts of 60 images, 3 to 10 seeds", header, rows).to_markdown())


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
