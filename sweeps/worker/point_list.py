"""Points known beforehand: what is missing of a grid or a table is run, what there is is found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError
from rgbt.spec.naming import VARIED
from sweeps import attributes as names
from sweeps.point import COLOUR, Point, colour, varied_keys
from sweeps.settings import SweepSettings
from sweeps.worker.driver import Driver
from sweeps.worker.executors import Executor, LocalExecutor, check_gpus
from sweeps.worker.owner import Owner
from sweeps.worker.planner import PlannedPoint, Planner
from sweeps.worker.progress import ProgressView
from sweeps.worker.run_monitor import training_seconds
from sweeps.worker.run_store import RunResult, RunStore
from sweeps.worker.storage import find_study, open_storage, open_study
from sweeps.worker.trial_source import (
    PointListSource,
    PointStatus,
    State,
    is_evaluated,
    reason_of,
    trained,
)
from sweeps.worker.trial_store import TrialStore, by_key, counted

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial


UNFINISHED: tuple[State, ...] = ("waiting", "failed")
"""States of points that a command would take up."""


@dataclass(frozen=True)
class Outcome:
    """What became of a point.

    Attributes:
        point: the point.
        state: "finished", "failed", "running" (by another driver) or "waiting" (not begun).
        reason: why it failed, or "".
        found: its finished runs; where it waits, those that lack further evaluations alone.
        keys: of its runs; () where its configuration is wrong.
    """

    point: Point
    state: State
    reason: str = ""
    found: tuple[RunResult, ...] = ()
    keys: tuple[str, ...] = ()

    @property
    def is_trained(self) -> bool:
        """Whether it is not finished, but lacks nothing but further evaluations of its runs."""
        return self.state in UNFINISHED and bool(self.found)

    @property
    def seconds(self) -> float | None:
        """How long its runs took, as far as they know."""
        each = [training_seconds(found.folder) for found in self.found]
        return None if not each or None in each else sum(s for s in each if s is not None)


@dataclass(frozen=True)
class PointList:
    """A named list of points.

    Attributes:
        study: name of the study.
        title: what a person reads above the progress.
        kind: "grid" or "list".
        points: the points.
        runs: where finished runs are found; the points' overrides name the same folder.
        base: overrides that all have.
        distributions: of the parameters of a grid, by name.
    """

    study: str
    title: str
    kind: str
    points: tuple[Point, ...]
    runs: RunStore
    base: tuple[str, ...] = ()
    distributions: Mapping[str, Any] | None = None


def other_code_line(outcomes: Sequence[Outcome]) -> str:
    """How many runs other code made, in a sentence; "" for none."""
    found = {run.key: run for outcome in outcomes for run in outcome.found}
    others = sum(run.is_of_other_code for run in found.values())
    if not others:
        return ""
    return (
        f"{others} of {len(found)} runs were made by other code; fresh=true trains these again and "
        "keeps the old runs."
    )


def preview_points(wanted: PointList, settings: SweepSettings) -> list[Outcome]:
    """What is known of the points; nothing is run and nothing written."""
    prepared = _PlannedPoints(wanted)
    study = find_study(wanted.study, settings.storage, prepared.runs.runs_dir)
    trials = by_key(() if study is None else counted(study))
    return prepared.outcomes(lambda plan: _seen(plan, trials.get(plan.key, []), prepared.runs))


def _seen(plan: PlannedPoint, trials: Sequence[FrozenTrial], runs: RunStore) -> PointStatus:
    found = trained(plan, runs) or ()
    if found and is_evaluated(plan, found):
        return PointStatus("finished", found=found)
    states = [trial.state.name for trial in trials]
    if "RUNNING" in states:
        return PointStatus("running")
    if states and states[-1] == "FAIL":
        return PointStatus("failed", reason_of(trials[-1]), found)
    return PointStatus("waiting", found=found)


def run_points(wanted: PointList, settings: SweepSettings) -> list[Outcome]:
    """Run what is missing of the points; failures are isolated and told in the outcomes.

    Returns:
        one outcome per point, in their order.

    Raises:
        InputError: the storage or the executor cannot be used.
    """
    prepared = _PlannedPoints(wanted)
    runs = prepared.runs
    storage = open_storage(settings.storage, runs.runs_dir)
    runs.touch()
    study = open_study(wanted.study, storage, settings.objectives, {names.KIND: wanted.kind})
    store = TrialStore(study, storage, Owner.me())
    plans = list(prepared.plans.values())
    source = PointListSource(plans, store, runs, settings, dict(wanted.distributions or {}))

    def done() -> int:
        trials = store.by_key()
        states = [source.standing(plan, trials).state for plan in source.plans.values()]
        return sum(state in ("finished", "failed") for state in states)

    view = ProgressView(wanted.title, len(source.plans), settings.workers, done)
    driver = Driver(
        store=store,
        source=source,
        runs=runs,
        executor=make_executor(settings, runs.runs_dir),
        settings=settings,
        view=view,
        metrics=[objective.metric for objective in settings.objectives],
    )
    with view:
        driver.run()
    trials = store.by_key()
    return prepared.outcomes(lambda plan: source.standing(plan, trials))


class _PlannedPoints:
    """Points planned; those with a wrong configuration are known to fail."""

    def __init__(self, wanted: PointList) -> None:
        planner = Planner(wanted.base)
        self.runs = wanted.runs
        self.points = wanted.points
        self.plans: dict[int, PlannedPoint] = {}
        self.wrong: dict[int, str] = {}
        for index, point in enumerate(wanted.points):
            try:
                self.plans[index] = planner.plan(point)
            except InputError as error:
                self.wrong[index] = str(error)
        if self.wrong and not self.plans:
            # What no point can be composed with is a mistake of the call and not of a cell.
            raise InputError(next(iter(self.wrong.values())))
        self._share_tags(wanted.study)

    def _share_tags(self, study: str) -> None:
        """Points that are the same run in other words (1 and 1.0) get the tags of all of them.

        Every run gets its own colour, and the beginning of its name.
        """
        varied = " ".join(varied_keys(self.points))
        tags: dict[str, dict[str, list[str]]] = {}
        for plan in self.plans.values():
            own = tags.setdefault(plan.key, {})
            for name, value in plan.point.tags.items():
                values = own.setdefault(name, [])
                values += [] if value in values else [value]
        for index, plan in self.plans.items():
            shared = {name: " | ".join(each) for name, each in tags.get(plan.key, {}).items()}
            shared |= {VARIED: varied, COLOUR: colour(study, list(tags).index(plan.key))}
            self.plans[index] = replace(plan, point=replace(plan.point, tags=shared))

    def outcomes(self, standing: Any) -> list[Outcome]:
        """One outcome per point, in order."""
        found = []
        for index, point in enumerate(self.points):
            if index in self.wrong:
                found.append(Outcome(point, "failed", self.wrong[index]))
                continue
            plan = self.plans[index]
            seen = standing(plan)
            keys = tuple(run.key for run in plan.runs)
            found.append(Outcome(plan.point, seen.state, seen.reason, seen.found, keys))
        return found


def make_executor(settings: SweepSettings, runs_dir: Path) -> Executor:
    """What `executor` and its options name."""
    if settings.executor == "local":
        check_gpus(settings.gpus)
        return LocalExecutor(settings.workers)
    from sweeps.worker.submitit_executor import SubmititExecutor

    return SubmititExecutor(runs_dir / ".submitit", settings.submitit or {})


def estimated_seconds(outcomes: Sequence[Outcome], workers: int) -> float | None:
    """How long the trainings that are missing will take; None where no run tells."""
    known_ones = [outcome.seconds for outcome in outcomes if outcome.seconds is not None]
    missing = sum(outcome.state in UNFINISHED and not outcome.is_trained for outcome in outcomes)
    return missing * median(known_ones) / workers if known_ones else None
