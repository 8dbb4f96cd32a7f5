"""Growth of the cost with the number of points, finished runs and trials; CPU seconds.

* points: planning a grid of different points (`sweeps.worker.point_list`);
* runs: listing the groups of runs and opening one by its name, as `rgbt compare` does;
* trials: a study of random points in SQLite, each proposed, recorded and finished, with
  nothing trained in between.

A cost per item that grows with their number is worse than linear growth.

Run: python -m tests.benchmarks.bench_growth [points] [runs] [trials]
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from tests.benchmarks.timing import seconds  # isort: skip - before torch

import numpy as np

from analysis.results import groups_in, open_counts
from rgbt.runs.naming import GROUP
from rgbt.tracking.mlflow_store import NoTracking
from sweeps import attributes as names
from sweeps.point import Point
from sweeps.settings import Objective
from sweeps.worker.point_list import ListSource, PointList
from sweeps.worker.run_store import RunStore
from sweeps.worker.storage import open_storage, open_study
from sweeps.worker.trial_store import TrialStore
from tests.sweeps.fakes import finish, settings

POINTS = (10, 100, 500)
MANY_POINTS = 2000
"""Estimated from a line through the measured numbers."""

RUNS = (10, 100, 1000)
TRIALS = (10, 100, 1000)


def points(count: int) -> float:
    """CPU seconds to plan a grid over two plain values."""
    grid = [
        Point(str(n), ("+experiment=grbm", f"optimizer.lr={1e-4 * (n + 1)}", f"seed={n % 5}"))
        for n in range(count)
    ]
    runs = RunStore(Path("runs"), NoTracking())
    wanted = PointList("growth", "growth", "grid", tuple(grid), runs, ("runs_dir=runs",))
    return seconds(lambda: ListSource(wanted, settings()))[0]


def runs(count: int) -> float:
    """CPU seconds to list the groups, and to find and open the run of one of them."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for number in range(count):
            tags = {GROUP: f"method {number}"}
            finish(place / f"{number:012x}", tags=tags)
        group = groups_in(place)[0]
        return seconds(lambda: (groups_in(place), open_counts(group, place)))[0]


def trials(count: int) -> float:
    """CPU seconds of a study without the trainings."""
    objective = Objective("val/mIoU", "maximize")
    with tempfile.TemporaryDirectory() as folder:
        storage = open_storage(None, Path(folder))
        study = open_study("growth", storage, (objective,), {names.KIND: "search"})
        store = TrialStore(study, storage)

        def search() -> None:
            for number in range(count):
                trial = store.ask(count)
                assert trial is not None, "fewer trials than requested"
                value = trial.suggest_float("optimizer.lr", 1e-4, 1e-2, log=True)
                store.by_key()
                store.set_attributes(trial.number, {names.KEY: f"{number:012x}", names.LABEL: "x"})
                store.complete(trial.number, [value], {names.SECONDS: 1.0})

        return seconds(search)[0]


def rows(name: str, cost: Callable[[int], float], counts: Sequence[int]) -> list[str]:
    """Markdown rows: what, number, CPU seconds, ms an item."""
    cost(2)  # imports and first files
    found = [cost(count) for count in counts]
    lines = [
        f"| {name} | {count} | {each:.2f} | {1000 * each / count:.1f} |"
        for count, each in zip(counts, found, strict=True)
    ]
    if name == "points":
        slope, start = np.polyfit(counts, found, 1)
        whole = start + slope * MANY_POINTS
        lines.append(f"| {name}, by a line | {MANY_POINTS} | {whole:.2f} | {1000 * slope:.1f} |")
    return lines


PARTS = {"points": (points, POINTS), "runs": (runs, RUNS), "trials": (trials, TRIALS)}


def main() -> None:
    print("| what | number | CPU s | ms an item |\n|---|---|---|---|")
    for name in sys.argv[1:] or PARTS:
        cost, counts = PARTS[name]
        print("\n".join(rows(name, cost, counts)), flush=True)


if __name__ == "__main__":
    main()
