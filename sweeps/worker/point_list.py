"""Points that are known in advance: a grid, a list, the cells of a table."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from sweeps import attributes as names
from sweeps.point import UNFINISHED, Outcome, Point
from sweeps.settings import SweepSettings
from sweeps.worker.driver import drive
from sweeps.worker.planned_points import PlannedPoints
from sweeps.worker.planner import PlannedPoint, Planner
from sweeps.worker.progress import ProgressView
from sweeps.worker.run_store import RunStore
from sweeps.worker.storage import find_study, open_storage, open_study
from sweeps.worker.trial_sources import (
    ListSource,
    finished_runs,
    is_evaluated,
    outcome_of,
    reason_of,
)
from sweeps.worker.trial_store import Owner, TrialStore, counted_trials, trials_by_key

PLANNED_FIRST_S = 2.0
"""Seconds of planning before the first run of a grid starts; about 100 points."""


@dataclass(frozen=True)
class PointList:
    """A named list of points.

    Attributes:
        study: its name.
        title: shown above the progress.
        kind: "grid" or "list".
        runs: finished runs; the points' overrides name the same folder.
        base: overrides that all have.
        distributions: of the parameters of a grid, by name.
        more: further points, from the outcomes until now; asked for when no point is waiting.
    """

    study: str
    title: str
    kind: str
    points: tuple[Point, ...]
    runs: RunStore
    base: tuple[str, ...] = ()
    distributions: Mapping[str, Any] | None = None
    more: Callable[[Sequence[Outcome]], Sequence[Point]] | None = None


def other_code_line(outcomes: Sequence[Outcome]) -> str:
    """How many runs other code made, in a sentence; "" for none."""
    results = {result.key: result for outcome in outcomes for result in outcome.results}
    others = sum(result.other_code is not None for result in results.values())
    if not others:
        return ""
    return (
        f"{others} of {len(results)} runs were made by other code; fresh=true retrains them "
        "and keeps the old runs."
    )


def preview_points(
    points: PointList, settings: SweepSettings, planner: Planner | None = None
) -> list[Outcome]:
    """The present state of the points; nothing is run and nothing written.

    Args:
        points: to preview.
        settings: of their execution.
        planner: with the same `base`, shared by several lists; None: one of this list alone.
    """
    planned = _planned(points, planner)
    planned.plan_and_show(points.title)
    study = find_study(points.study, settings.storage, points.runs.runs_dir)
    trials = trials_by_key(() if study is None else counted_trials(study))

    def status(plan: PlannedPoint) -> Outcome:
        results = finished_runs(plan, points.runs) or ()
        if results and is_evaluated(plan, results):
            return outcome_of(plan, "finished", results=results)
        same = trials.get(plan.key, [])
        states = [trial.state.name for trial in same]
        if "RUNNING" in states:
            return outcome_of(plan, "running")
        if states and states[-1] == "FAIL":
            return outcome_of(plan, "failed", reason_of(same[-1]), results)
        return outcome_of(plan, "waiting", results=results)

    return planned.outcomes(status)


def run_points(
    points: PointList,
    settings: SweepSettings,
    planner: Planner | None = None,
    *,
    strict: bool = False,
) -> list[Outcome]:
    """Run all unfinished points; a failed point does not stop the others. Outcomes in their order.

    Args:
        points: their overrides.
        settings: of execution.
        planner: that has planned some of them already; None: a new one.
        strict: refuse a point with a wrong configuration. All points that are planned in the first
            `PLANNED_FIRST_S` seconds are checked before a run starts. The others are planned while
            the first runs train; if one of them is wrong, these runs are stopped and resume in the
            next call.

    Raises:
        InputError: the storage or the executor cannot be used, all points are wrong, or with
            `strict` one of them.
    """
    planned = _planned(points, planner, strict=strict)
    planned.plan_and_show(points.title, PLANNED_FIRST_S if strict else math.inf)
    runs = points.runs
    storage = open_storage(settings.storage, runs.runs_dir)
    runs.create_tables()
    study = open_study(points.study, storage, settings.objectives, {names.KIND: points.kind})
    store = TrialStore(study, storage, Owner.this_process())
    plans = list(planned.plans.values())
    source = ListSource(plans, store, runs, settings, points.distributions or {})

    def outcomes() -> list[Outcome]:
        trials = store.by_key()
        return planned.outcomes(lambda plan: source.status(plan, trials))

    def num_done() -> int:
        return sum(status.state in ("finished", "failed") for status in source.statuses())

    view = ProgressView(points.title, len(source.plans), settings.workers, num_done)

    def plan_more(seconds: float) -> list[PlannedPoint] | None:
        if not planned.num_left:
            return None
        added = planned.plan(seconds)
        view.planned(planned.num_runs, planned.num_left)
        return added

    def more() -> list[PlannedPoint]:
        planned.append(points.more(outcomes()) if points.more else [])
        added = planned.plan()
        if added:
            view.added([plan.point.label for plan in added])
        return added

    source.plan_more, source.more = plan_more, more
    view.planned(planned.num_runs, planned.num_left)
    drive(view, source, store, runs, settings)
    return outcomes()


def _planned(points: PointList, planner: Planner | None, *, strict: bool = False) -> PlannedPoints:
    planner = planner or Planner(points.base)
    return PlannedPoints(points.study, points.points, planner, strict=strict)


def estimated_seconds(outcomes: Sequence[Outcome], workers: int) -> float | None:
    """Estimated duration of the missing trainings; None where no run has finished."""
    durations = [outcome.seconds for outcome in outcomes if outcome.seconds is not None]
    missing = sum(outcome.state in UNFINISHED and not outcome.is_trained for outcome in outcomes)
    return missing * median(durations) / workers if durations else None
