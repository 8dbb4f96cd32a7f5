"""A point of a table, grid or search: one or more runs of `python -m rgbt.run`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Literal

from rgbt.runs.folder import read_result
from rgbt.runs.result import RunResult
from sweeps.plan.measurement import Words

Value = str | int | float | bool | None
State = Literal["finished", "failed", "pruned", "running", "waiting", "missing"]
# States of points that a command runs.
UNFINISHED: tuple[State, ...] = ("waiting", "failed")


@dataclass(frozen=True)
class Point:
    """Describes one cell of a table, point of a grid or trial of a search.

    Attributes:
        label: as shown, e.g. "Ny/4 seed=1".
        overrides: of `python -m rgbt.run`.
        params: what a grid or a search chose, by key.
        tags: MLflow tags that the runs get.
        seeds: one run per seed, whose mean is the value of the point; (): the overrides say it.
        evaluations: words of measurements made of every run once it is finished.
    """

    label: str
    overrides: tuple[str, ...]
    params: Mapping[str, Value] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)
    seeds: tuple[int, ...] = ()
    evaluations: tuple[Words, ...] = ()

    def runs(self) -> tuple[tuple[str, ...], ...]:
        """Return the overrides of each run."""
        if not self.seeds:
            return (self.overrides,)
        return tuple((*self.overrides, f"seed={seed}") for seed in self.seeds)


def short_names(keys: Collection[str]) -> dict[str, str]:
    """Cut keys to their last part where that is unique: "masker.sigma_div" -> "sigma_div"."""
    ends = {key: key.rpartition(".")[2] for key in keys}
    counts = Counter(ends.values())
    return {key: end if counts[end] == 1 else key for key, end in ends.items()}


def varied_keys(points: Sequence[Point]) -> list[str]:
    """Return the keys of the overrides that not all points have, in order."""
    if not points:
        return []
    common = set(points[0].overrides).intersection(*(point.overrides for point in points))
    keys = dict[str, None]()
    for point in points:
        for word in point.overrides:
            if word not in common:
                keys[word.lstrip("+").partition("=")[0]] = None
    return list(keys)


@dataclass(frozen=True)
class Outcome:
    """Says how a point stands, with its finished runs.

    Attributes:
        state: "running" may be by another driver; "pruned" is only a trial of a search; "missing":
            it lacks a data set or the code of another author.
        reason: why it failed or was pruned, or what it lacks, in a sentence, or "".
        results: its finished runs; of a waiting point, runs that lack further evaluations only.
        keys: of its runs; () where its configuration is wrong.
        missing: words of a measurement that a finished run has not -> why.
        job_s: seconds that its job has run, as far as this driver saw it.
    """

    point: Point
    state: State
    reason: str = ""
    results: tuple[RunResult, ...] = ()
    keys: tuple[str, ...] = ()
    missing: Mapping[Words, str] = field(default_factory=dict)
    job_s: float = 0.0

    @property
    def is_trained(self) -> bool:
        """Whether it lacks further evaluations of its runs only."""
        return self.state in UNFINISHED and bool(self.results)

    @property
    def seconds(self) -> float | None:
        """Duration of its runs; None where one of them is unknown."""
        total = 0.0
        for result in self.results:
            known = read_result(result.folder) or {}
            total += known.get("seconds_of_last_process", math.nan)
        return total if self.results and math.isfinite(total) else None

    def scores(self) -> dict[str, float]:
        """Return the scores that all its runs have, averaged over the runs, in percent."""
        first, *others = [result.recorded_scores() for result in self.results]
        shared = [name for name in first if all(name in scores for scores in others)]
        return {name: fmean([first[name], *(run[name] for run in others)]) for name in shared}
