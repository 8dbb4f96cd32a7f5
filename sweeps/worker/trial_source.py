"""Where a driver's work comes from: a list of points, or the sampler of a search."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

from rgbt.checks import InputError, RunError
from rgbt.spec.naming import VARIED
from rgbt.tracking.folder import MetricLine
from rgbt.tracking.percent import in_percent
from rgbt.tracking.provenance import without_passwords
from sweeps import attributes as names
from sweeps.point import COLOUR, Point, colour
from sweeps.settings import SweepSettings
from sweeps.worker.planner import PlannedPoint, Planner
from sweeps.worker.run_store import RunResult, RunStore
from sweeps.worker.running_trial import PruningCallback
from sweeps.worker.trial_store import TrialClaim, TrialStore

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial, Trial

    from sweeps.space.space import Parameter

State = Literal["finished", "failed", "running", "waiting", "pruned"]

PAUSE_S = 5.0
"""How long a search waits whose next point is being run already."""


@dataclass(frozen=True)
class ClaimedTrial:
    """Something to work on, claimed.

    Attributes:
        plan: the point.
        number: of its trial.
        report: see `sweeps.worker.running_trial.RunningTrial`.
    """

    plan: PlannedPoint
    number: int
    report: PruningCallback | None = None


class TrialSource(Protocol):
    """Gives a driver its work."""

    again: bool
    """Whether a trial that is given up goes into the queue of the study."""

    refused: int
    """Points that could not be begun."""

    def next(self) -> ClaimedTrial | None:
        """The next task, claimed for this driver; None when there is none at the moment."""
        ...

    def is_exhausted(self, *, wait: bool) -> bool:
        """Whether nothing is left to take up; with `wait`, whether other drivers are done too."""
        ...


@dataclass(frozen=True)
class PointStatus:
    """What is known of a point.

    Attributes:
        state: see `State`.
        reason: why it failed, or "".
        found: its finished runs.
        past: numbers of its trials that do not stand any more.
    """

    state: State
    reason: str = ""
    found: tuple[RunResult, ...] = ()
    past: tuple[int, ...] = ()


class PointListSource:
    """Points that are known beforehand: a grid, a list, the cells of a table.

    Args:
        plans: the points; one key once.
        ledger: the study.
        runs: where finished runs are found.
        settings: `retries` and `retry` count here.
        distributions: of the parameters of a grid, by name.
    """

    again = False
    refused = 0

    def __init__(
        self,
        plans: Sequence[PlannedPoint],
        store: TrialStore,
        runs: RunStore,
        settings: SweepSettings,
        distributions: Mapping[str, Any],
    ) -> None:
        self.plans = {plan.key: plan for plan in plans}
        self._store = store
        self._runs = runs
        self._retries = settings.retries
        self._distributions = distributions
        before = store.by_key() if settings.retry == "failed" else {}
        self._forgiven = {
            key: [trial.number for trial in trials if trial.state.name == "FAIL"]
            for key, trials in before.items()
        }
        self._finished: dict[str, PointStatus] = {}
        self._looked: set[tuple[str, int]] = set()

    def next(self) -> ClaimedTrial | None:
        """See `TrialSource.next`."""
        by_key = self._store.by_key()
        for plan in self.plans.values():
            standing = self.standing(plan, by_key)
            if standing.state != "waiting":
                continue
            attributes = {
                names.LABEL: plan.point.label,
                names.OVERRIDES: [without_passwords(word) for word in plan.point.overrides],
                names.RUNS: [run.key for run in plan.runs],
                names.PIXELS: plan.pixel_factor,
            }
            params = {k: v for k, v in plan.point.params.items() if k in self._distributions}
            asked = {name: self._distributions[name] for name in params}
            number = self._store.claim(
                TrialClaim(plan.key, attributes, params, asked, standing.past)
            )
            if number is not None:
                return ClaimedTrial(plan, number)
        return None

    def is_exhausted(self, *, wait: bool) -> bool:
        """See `TrialSource.is_exhausted`."""
        by_key = self._store.by_key()
        states = {self.standing(plan, by_key).state for plan in self.plans.values()}
        return not states & ({"running", "waiting"} if wait else {"waiting"})

    def standing(
        self, plan: PlannedPoint, by_key: Mapping[str, Sequence[FrozenTrial]]
    ) -> PointStatus:
        """What the study and the runs know of a point."""
        if plan.key in self._finished:
            return self._finished[plan.key]
        trials = by_key.get(plan.key, ())
        states = {trial.state.name for trial in trials}
        if "RUNNING" in states:
            return PointStatus("running")
        if "COMPLETE" in states:
            found = known(plan, self._runs)
            if found is not None:
                self._finished[plan.key] = PointStatus("finished", found=found)
                return self._finished[plan.key]
        failed = [trial for trial in trials if trial.state.name == "FAIL"]
        counted = [t for t in failed if t.number not in self._forgiven.get(plan.key, ())]
        if len(counted) > self._retries:
            return self._failed(plan, counted[-1])
        return PointStatus("waiting", past=tuple(trial.number for trial in trials))

    def _failed(self, plan: PlannedPoint, trial: FrozenTrial) -> PointStatus:
        """A point that failed, unless somebody has finished its runs by hand since."""
        if (plan.key, trial.number) not in self._looked:
            self._looked.add((plan.key, trial.number))
            found = known(plan, self._runs)
            if found is not None:
                self._finished[plan.key] = PointStatus("finished", found=found)
                return self._finished[plan.key]
        return PointStatus("failed", reason_of(trial))


def known(plan: PlannedPoint, runs: RunStore) -> tuple[RunResult, ...] | None:
    """The runs of a point if all are finished, with their further evaluations; None otherwise."""
    found = trained(plan, runs)
    return found if found is not None and is_evaluated(plan, found) else None


def trained(plan: PlannedPoint, runs: RunStore) -> tuple[RunResult, ...] | None:
    """The runs of a point if all are finished, whatever is evaluated of them; None otherwise."""
    found = []
    for run in plan.runs:
        try:
            one = runs.find(run.key, run.dataset)
        except RunError:  # told when the point is worked on
            return None
        if one is None:
            return None
        found.append(one)
    return tuple(found)


def is_evaluated(plan: PlannedPoint, found: Sequence[RunResult]) -> bool:
    """Whether the further evaluations of a point's runs are all there."""
    return all(one.has(evaluation) for one in found for evaluation in plan.point.evaluations)


def reason_of(trial: FrozenTrial) -> str:
    """Why a trial failed."""
    return str(trial.user_attrs.get(names.REASON, "no reason was noted"))


class SamplerSource:
    """Points that a sampler chooses, until the budget is spent.

    Args:
        fixed: overrides that all trials share.
        parameters: the space.
        ledger: the study, with its sampler.
        planner: composes the points.
        settings: `trials`, `replicates` and `objectives` count here.
        on_fail: called with (label, reason) for a point that cannot be composed.
    """

    again = True

    def __init__(
        self,
        fixed: Sequence[str],
        parameters: tuple[Parameter, ...],
        store: TrialStore,
        planner: Planner,
        settings: SweepSettings,
        on_fail: Callable[[str, str], None],
    ) -> None:
        self._fixed = tuple(fixed)
        self._parameters = parameters
        self._store = store
        self._planner = planner
        self._settings = settings
        self._on_fail = on_fail
        self._not_before = 0.0
        self.refused = 0

    def next(self) -> ClaimedTrial | None:
        """See `TrialSource.next`."""
        if time.monotonic() < self._not_before:
            return None
        trial = self._store.ask(self._settings.trials)
        if trial is None:
            return None
        point = self._point(trial)
        try:
            plan = self._planner.plan(point)
        except InputError as error:
            self._store.fail(trial.number, str(error), {names.LABEL: point.label})
            self.refused += 1
            self._on_fail(point.label, str(error))
            return None
        same = self._store.by_key().get(plan.key, [])
        if self._is_settled(trial, same):
            return None
        notes = {
            names.KEY: plan.key,
            names.LABEL: point.label,
            names.OVERRIDES: [without_passwords(word) for word in point.overrides],
            names.RUNS: [run.key for run in plan.runs],
            names.PIXELS: plan.pixel_factor,
        }
        self._store.note(trial.number, notes)
        return ClaimedTrial(plan, trial.number, self._report(trial))

    def is_exhausted(self, *, wait: bool) -> bool:
        """See `TrialSource.is_exhausted`."""
        states = [trial.state.name for trial in self._store.trials()]
        total = self._settings.trials
        unfinished = {"RUNNING", "WAITING"} if wait else {"WAITING"}
        return total is not None and len(states) >= total and not unfinished & set(states)

    def _point(self, trial: Trial) -> Point:
        from sweeps.space.space import as_overrides, suggest

        params = suggest(trial, self._parameters)
        chosen = as_overrides(params)
        study = self._store.study.study_name
        replicates = self._settings.replicates
        return Point(
            label=f"#{trial.number} " + " ".join(short(override) for override in chosen),
            overrides=(*self._fixed, *chosen),
            params={key: value for key, value in trial.params.items()},
            tags={
                f"rgbt.study/{study}": str(trial.number),
                VARIED: " ".join(params),
                COLOUR: colour(study, trial.number),
            },
            seeds=tuple(range(replicates)) if replicates > 1 else (),
        )

    def _is_settled(self, trial: Trial, same: Sequence[FrozenTrial]) -> bool:
        """Whether an earlier trial of the same point answers for this one."""
        for other in same:
            if other.number == trial.number:
                continue
            if other.state.name == "COMPLETE":
                notes = {name: other.user_attrs[name] for name in other.user_attrs}
                reason = f"the same point as trial {other.number}"
                kept = {name: notes[name] for name in (names.KEY, names.RUNS, names.RESULTS)}
                label = f"#{trial.number} = #{other.number}"
                self._store.complete(
                    trial.number, other.values, {**kept, names.REASON: reason, names.LABEL: label}
                )
                return True
            if other.state.name == "RUNNING":
                self._store.drop(trial.number, f"the same point as trial {other.number}")
                self._not_before = time.monotonic() + PAUSE_S
                return True
        return False

    def _report(self, trial: Trial) -> PruningCallback | None:
        if self._settings.pruner is None and len(self._settings.objectives) > 1:
            return None
        metric = self._settings.objectives[0].metric.removeprefix("val/")
        reported: set[int] = set()

        def report(line: MetricLine) -> str:
            value = line.values.get(metric)
            if value is None or line.step in reported:
                return ""
            percent = in_percent(metric, value)
            self._store.update_unfinished(trial.number, lambda: trial.report(percent, line.step))
            reported.add(line.step)
            if self._settings.pruner is not None and trial.should_prune():
                return f"pruned at step {line.step}"
            return ""

        return report


def short(override: str) -> str:
    """An override for people: "masker.sigma_div=4.123456" as "sigma_div=4.123"."""
    key, _, value = override.lstrip("+").partition("=")
    with suppress(ValueError):
        value = f"{float(value):.4g}"
    return f"{key.rpartition('.')[2]}={value}"
