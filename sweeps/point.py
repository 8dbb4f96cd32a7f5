"""A point of a table, grid or search: one or more runs of `python -m rgbt.run`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from rgbt.runs.folder import read_result
from rgbt.runs.result import RunResult
from sweeps.plan.measurement import Words

Value = str | int | float | bool | None
State = Literal["finished", "failed", "running", "waiting", "missing"]
# States of points that a command runs.
UNFINISHED: tuple[State, ...] = ("waiting", "failed")


@dataclass(frozen=True)
class Point:
    """One cell of a table, point of a grid or trial of a search.

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
        """Overrides of each run."""
        return tuple((*self.overrides, f"seed={seed}") for seed in self.seeds) or (self.overrides,)


def short_names(names: Collection[str]) -> dict[str, str]:
    """Keys cut to their last part where that is unique: "masker.sigma_div" -> "sigma_div"."""
    ends = Counter(name.rpartition(".")[2] for name in names)
    return {name: end if ends[end := name.rpartition(".")[2]] == 1 else name for name in names}


def varied_keys(points: Sequence[Point]) -> list[str]:
    """Keys of the overrides that not all points have, in order."""
    common = set.intersection(*(set(point.overrides) for point in points)) if points else set()
    words = (word for point in points for word in point.overrides if word not in common)
    return list(dict.fromkeys(word.lstrip("+").partition("=")[0] for word in words))


@dataclass(frozen=True)
class Outcome:
    """A point with its state and its finished runs.

    Attributes:
        state: "running" is by another driver, "missing" not in the store that is read.
        reason: why it failed, or "".
        results: its finished runs; of a waiting point, runs that lack further evaluations only.
        keys: of its runs; () where its configuration is wrong.
        missing: words of a measurement that a finished run has not -> why.
    """

    point: Point
    state: State
    reason: str = ""
    results: tuple[RunResult, ...] = ()
    keys: tuple[str, ...] = ()
    missing: Mapping[Words, str] = field(default_factory=dict)

    @property
    def is_trained(self) -> bool:
        """Whether it lacks further evaluations of its runs only."""
        return self.state in UNFINISHED and bool(self.results)

    @property
    def seconds(self) -> float | None:
        """Duration of its runs; None where one of them is unknown."""
        found = [read_result(result.folder) or {} for result in self.results]
        total = sum(each.get("seconds_of_last_process", math.nan) for each in found)
        return total if found and math.isfinite(total) else None
