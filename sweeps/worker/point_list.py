"""Points that are known in advance: a grid, a list, the cells of a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

from rgbt.checks import InputError
from rgbt.spec.naming import VARIED
from sweeps import attributes as names
from sweeps.point import COLOUR, Point, colour, varied_keys
from sweeps.settings import SweepSettings
from sweeps.worker.driver import drive
from sweeps.worker.planner import PlannedPoint, Planner
from sweeps.worker.progress import ProgressView
from sweeps.worker.run_store import RunStore
from sweeps.worker.storage import find_study, open_storage, open_study
from sweeps.worker.trial_sources import (
    UNFINISHED,
    ListSource,
    Outcome,
    finished_runs,
    is_evaluated,
    reason_of,
)
from sweeps.worker.trial_store import Owner, TrialStore, counted_trials, trials_by_key


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
    planned = _PlannedPoints(points, planner)
    study = find_study(points.study, settings.storage, points.runs.runs_dir)
    trials = trials_by_key(() if study is None else counted_trials(study))

    def status(plan: PlannedPoint) -> Outcome:
        results = finished_runs(plan, points.runs) or ()
        if results and is_evaluated(plan, results):
            return Outcome.of(plan, "finished", results=results)
        same = trials.get(plan.key, [])
        states = [trial.state.name for trial in same]
        if "RUNNING" in states:
            return Outcome.of(plan, "running")
        if states and states[-1] == "FAIL":
            return Outcome.of(plan, "failed", reason_of(same[-1]), results)
        return Outcome.of(plan, "waiting", results=results)

    return planned.outcomes(status)


def run_points(
    points: PointList, settings: SweepSettings, planner: Planner | None = None
) -> list[Outcome]:
    """Run all unfinished points; a failed point does not stop the others. Outcomes in their order.

    Args:
        points: their overrides.
        settings: of execution.
        planner: that has planned some of them already; None: a new one.

    Raises:
        InputError: the storage or the executor cannot be used.
    """
    planned = _PlannedPoints(points, planner)
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

    def more() -> list[PlannedPoint]:
        added = planned.add(points.more(outcomes())) if points.more else []
        if added:
            view.added([plan.point.label for plan in added])
        return added

    source.more = more
    drive(view, source, store, runs, settings)
    return outcomes()


class _PlannedPoints:
    """The points of a list, planned; those with a wrong configuration have failed."""

    def __init__(self, points: PointList, planner: Planner | None = None) -> None:
        self._planner = planner or Planner(points.base)
        self._study = points.study
        self.points: list[Point] = []
        self.plans: dict[int, PlannedPoint] = {}
        self.errors: dict[int, str] = {}
        self.add(points.points)
        if self.errors and not self.plans:
            # An error of every point is one of the command and not of a point.
            raise InputError(next(iter(self.errors.values())))

    def add(self, points: Sequence[Point]) -> list[PlannedPoint]:
        """Plan further points; returns those without an error."""
        first = len(self.points)
        self.points += points
        for index, point in enumerate(points, start=first):
            try:
                self.plans[index] = self._planner.plan(point)
            except InputError as error:
                self.errors[index] = str(error)
        self._describe()
        return [plan for index, plan in self.plans.items() if index >= first]

    def _describe(self) -> None:
        """Give every plan its tags, its colour and the keys that vary."""
        # Points of the same run in other words (1 and 1.0) get the tags of all of them. Every run
        # gets its own colour, and the keys that vary, which begin its name.
        varied = " ".join(varied_keys(self.points))
        tags: dict[str, dict[str, list[str]]] = {}
        for index, plan in self.plans.items():
            own = tags.setdefault(plan.key, {})
            for name, value in self.points[index].tags.items():
                values = own.setdefault(name, [])
                values += [] if value in values else [value]
        for index, plan in self.plans.items():
            merged = {name: " | ".join(each) for name, each in tags[plan.key].items()}
            merged |= {VARIED: varied, COLOUR: colour(self._study, list(tags).index(plan.key))}
            self.plans[index] = replace(plan, point=replace(plan.point, tags=merged))

    def outcomes(self, status_of: Callable[[PlannedPoint], Outcome]) -> list[Outcome]:
        """One outcome per point, in order."""
        return [
            Outcome(point, "failed", self.errors[index])
            if index in self.errors
            else status_of(self.plans[index])
            for index, point in enumerate(self.points)
        ]


def estimated_seconds(outcomes: Sequence[Outcome], workers: int) -> float | None:
    """Estimated duration of the missing trainings; None where no run has finished."""
    durations = [outcome.seconds for outcome in outcomes if outcome.seconds is not None]
    missing = sum(outcome.state in UNFINISHED and not outcome.is_trained for outcome in outcomes)
    return missing * median(durations) / workers if durations else None
