"""Error rates of a confirmed search: ``python -m tests.benchmarks.simulate_confirmation``.

Three points with scores of unit standard deviation over seeds; images without error. 5 to 10
seeds, of points that are not shown to be worse than another one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.verdicts import AnyTime, decide
from sweeps.verdicts.best_point import fewest_seeds, level_of

RACES, MAX_SEEDS = 400, 10
MEANS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 2.9, 0.0))
"""The first point is one of the best."""


def is_worse(values: np.ndarray) -> bool:
    """Whether the first of two points is shown to be worse, from (n,) paired differences."""
    evidence = Evidence(
        values=tuple(values.tolist()),
        seeds=tuple(range(len(values))),
        error=0.0,
        blocks=40,
        said="",
    )
    return decide([evidence], (-math.inf, 0.0), AnyTime(level=level_of(3)), "all").kind == "holds"


def race(generator: np.random.Generator, means: Sequence[float]) -> tuple[set[int], int]:
    """The points that are left, and the number of runs."""
    points = range(len(means))
    values = generator.normal(size=(len(means), MAX_SEEDS)) + np.array(means)[:, None]
    left, seeds = set(points), dict.fromkeys(points, 0)
    for count in range(fewest_seeds(len(means)), MAX_SEEDS + 1):
        seeds |= dict.fromkeys(left, count)
        pairs = [(i, j, min(seeds[i], seeds[j])) for i in points for j in points if i != j]
        worse = {i for i, j, n in pairs if is_worse(values[i, :n] - values[j, :n])}
        left = set(points) - worse
        if len(left) < 2:
            break
    return left, sum(seeds.values())


def main() -> None:
    """Print one line per set of means."""
    for means in MEANS:
        generator = np.random.default_rng(1)
        races = [race(generator, means) for _ in range(RACES)]
        lost = np.mean([0 not in left for left, _ in races])
        confirmed = np.mean([left == {0} for left, _ in races])
        runs = np.mean([count for _, count in races])
        print(f"{means}: best lost {lost:.2%}, confirmed {confirmed:.2%}, runs {runs:.1f}")


if __name__ == "__main__":
    main()
