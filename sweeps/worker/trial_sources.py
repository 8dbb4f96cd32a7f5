"""Selects the next trial of a driver: a point of a list, or a proposal of a search sampler."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import InitVar, dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from rgbt.checks import InputError, RunError
from rgbt.metrics.names import in_percent
from rgbt.runs.folder import MetricLine
from rgbt.runs.naming import VARIED
from rgbt.runs.provenance import without_passwords
from rgbt.runs.result import RunResult
from sweeps import attributes as names
from sweeps.point import COLOUR, Outcome, Point, State, colour
from sweeps.settings import SweepSettings
from sweeps.worker.planner import PlannedPoint, Planner
from sweeps.worker.run_store import RunStore
from sweeps.worker.running_trial import PruningCallback
from sweeps.worker.trial_store import TrialStore

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial, Trial

    from sweeps.space.space import Space

PAUSE_S = 5.0
"""How long a search waits after a point that is being run already."""

PLAN_S = 0.2
"""Seconds of planning between two searches for a point to claim."""


@dataclass(frozen=True)
class ClaimedTrial:
    """A trial that this driver executes; for `report` see `running_trial.RunningTrial`."""

    plan: PlannedPoint
    number: int
    report: PruningCallback | None = None


class TrialSource(Protocol):
    """Gives a driver its trials."""

    requeues: bool
    """Whether a trial that is given up is enqueued in the study."""

    rejected: int
    """Points whose configuration is wrong."""

    def next(self) -> ClaimedTrial | None:
        """The next trial, claimed for this driver; None when there is none at the moment."""

    def plan(self, seconds: float) -> bool:
        """Plan further points for so many seconds; False: there is nothing to plan."""

    def is_exhausted(self, *, wait: bool) -> bool:
        """Whether no trial is left; with `wait`, whether other drivers have finished too."""


def trial_attributes(plan: PlannedPoint) -> Mapping[str, Any]:
    """User attributes of a trial of a point."""
    return {
        names.KEY: plan.key,
        names.LABEL: plan.point.label,
        names.OVERRIDES: [without_passwords(word) for word in plan.point.overrides],
        names.RUNS: [run.key for run in plan.runs],
        names.PIXELS: plan.runs[0].scale.pixel_factor,
    }


def outcome_of(
    plan: PlannedPoint, state: State, reason: str = "", results: tuple[RunResult, ...] = ()
) -> Outcome:
    """The outcome of a planned point."""
    return Outcome(plan.point, state, reason, results, tuple(run.key for run in plan.runs))


def _nothing_to_plan(seconds: float) -> None:
    del seconds


@dataclass
class ListSource:
    """Claims the points of a list in their order.

    Attributes:
        points: planned; of equal keys the first one counts.
        settings: `retries` and `retry` count here.
        distributions: of the parameters of a grid, by name.
        plan_more: plans further points of the list for some seconds; None: all are planned.
        more: further points, from the outcomes until now; called when all points are planned and no
            point is waiting.
    """

    points: InitVar[Sequence[PlannedPoint]]
    store: TrialStore
    runs: RunStore
    settings: SweepSettings
    distributions: Mapping[str, Any]
    plan_more: Callable[[float], Sequence[PlannedPoint] | None] = _nothing_to_plan
    more: Callable[[], Sequence[PlannedPoint]] = tuple
    requeues: bool = field(default=False, init=False)
    rejected: int = field(default=0, init=False)

    def __post_init__(self, points: Sequence[PlannedPoint]) -> None:
        self.plans: dict[str, PlannedPoint] = {}
        self._keep(points)
        self._is_planned = False
        before = self.store.trials() if self.settings.retry == "failed" else []
        self._forgiven = {trial.number for trial in before if trial.state.name == "FAIL"}
        self._finished: dict[str, tuple[RunResult, ...]] = {}
        self._rechecked: set[tuple[str, int]] = set()

    def next(self) -> ClaimedTrial | None:
        """See `TrialSource.next`."""
        claimed = self._claim()
        # Points that were added before this command was stopped are finished: others follow them.
        while claimed is None and (self.plan(PLAN_S) or self._keep(self.more())):
            claimed = self._claim()
        return claimed

    def plan(self, seconds: float) -> bool:
        """See `TrialSource.plan`."""
        added = None if self._is_planned else self.plan_more(seconds)
        self._is_planned = added is None
        self._keep(added or ())
        return added is not None

    def _keep(self, points: Sequence[PlannedPoint]) -> bool:
        """Add points; whether one of them is a new one."""
        before = len(self.plans)
        for plan in points:
            self.plans.setdefault(plan.key, plan)
        return len(self.plans) > before

    def _claim(self) -> ClaimedTrial | None:
        by_key = self.store.by_key()
        for plan in self.plans.values():
            if self.status(plan, by_key).state != "waiting":
                continue
            params = {k: v for k, v in plan.point.params.items() if k in self.distributions}
            known = {name: self.distributions[name] for name in params}
            # Failed trials of the point, and those whose runs were deleted.
            replaced = [trial.number for trial in by_key.get(plan.key, ())]
            number = self.store.claim(trial_attributes(plan), params, known, replaced)
            if number is not None:
                return ClaimedTrial(plan, number)
        return None

    def is_exhausted(self, *, wait: bool) -> bool:
        """See `TrialSource.is_exhausted`."""
        states = {status.state for status in self.statuses()}
        return self._is_planned and not states & ({"running", "waiting"} if wait else {"waiting"})

    def statuses(self) -> list[Outcome]:
        """The states of all points."""
        by_key = self.store.by_key()
        return [self.status(plan, by_key) for plan in self.plans.values()]

    def status(self, plan: PlannedPoint, by_key: Mapping[str, Sequence[FrozenTrial]]) -> Outcome:
        """The state of a point by the study and the finished runs."""
        trials = by_key.get(plan.key, ())
        states = {trial.state.name for trial in trials}
        is_known = plan.key in self._finished
        if "RUNNING" in states and not is_known:
            return outcome_of(plan, "running")
        if (is_known or "COMPLETE" in states) and self._is_finished(plan):
            return outcome_of(plan, "finished", results=self._finished[plan.key])
        failed = [trial for trial in trials if trial.state.name == "FAIL"]
        counted = [trial for trial in failed if trial.number not in self._forgiven]
        if len(counted) <= self.settings.retries:
            return outcome_of(plan, "waiting")
        # Its runs may have been finished by hand since.
        last = (plan.key, counted[-1].number)
        if last not in self._rechecked:
            self._rechecked.add(last)
            if self._is_finished(plan):
                return outcome_of(plan, "finished", results=self._finished[plan.key])
        return outcome_of(plan, "failed", reason_of(counted[-1]))

    def _is_finished(self, plan: PlannedPoint) -> bool:
        if plan.key not in self._finished:
            results = finished_runs(plan, self.runs)
            if results is None or not is_evaluated(plan, results):
                return False
            self._finished[plan.key] = results
        return True


def finished_runs(plan: PlannedPoint, runs: RunStore) -> tuple[RunResult, ...] | None:
    """The runs of a point if all are finished, evaluated or not; None otherwise."""
    results = []
    for run in plan.runs:
        try:
            result = runs.find(run.key, plan.fingerprints[run.key])
        except RunError:  # raised again when the point is executed
            return None
        if result is None:
            return None
        results.append(result)
    return tuple(results)


def is_evaluated(plan: PlannedPoint, results: Sequence[RunResult]) -> bool:
    """Whether all further evaluations of a point's runs exist."""
    wanted = plan.point.evaluations
    return all(evaluation.is_stored(result) for result in results for evaluation in wanted)


def reason_of(trial: FrozenTrial) -> str:
    """Why a trial failed."""
    return str(trial.user_attrs.get(names.REASON, "no reason was recorded"))


@dataclass
class SamplerSource:
    """Gets trials from the sampler of a study.

    Attributes:
        fixed: overrides that all trials share.
        settings: `trials`, `replicates`, `pruner` and `objectives` count here.
        on_reject: called with (label, reason) for a point whose configuration is wrong.
    """

    fixed: Sequence[str]
    space: Space
    store: TrialStore
    planner: Planner
    settings: SweepSettings
    on_reject: Callable[[str, str], None]
    requeues: bool = field(default=True, init=False)
    rejected: int = field(default=0, init=False)
    _not_before: float = field(default=0.0, init=False)

    def next(self) -> ClaimedTrial | None:
        """See `TrialSource.next`."""
        if time.monotonic() < self._not_before:
            return None
        trial = self.store.ask(self.settings.trials)
        if trial is None:
            return None
        point = self._point(trial)
        try:
            plan = self.planner.plan(point)
        except InputError as error:
            self.store.fail(trial.number, str(error), {names.LABEL: point.label})
            self.rejected += 1
            self.on_reject(point.label, str(error))
            return None
        # A trial that was enqueued again has won its point in `ask`.
        is_new = names.KEY not in trial.user_attrs
        if is_new and self._resolve_duplicate(trial, self.store.by_key().get(plan.key, [])):
            return None
        self.store.set_attributes(trial.number, trial_attributes(plan))
        return ClaimedTrial(plan, trial.number, self._pruning_callback(trial))

    def plan(self, seconds: float) -> bool:
        """See `TrialSource.plan`; a sampler proposes a point when a worker is free."""
        del seconds
        return False

    def is_exhausted(self, *, wait: bool) -> bool:
        """See `TrialSource.is_exhausted`."""
        states = [trial.state.name for trial in self.store.trials()]
        total = self.settings.trials
        unfinished = {"RUNNING", "WAITING"} if wait else {"WAITING"}
        return total is not None and len(states) >= total and not unfinished & set(states)

    def _point(self, trial: Trial) -> Point:
        from sweeps.space.space import as_overrides, suggest

        params = suggest(trial, self.space)
        chosen = as_overrides(params)
        study = self.store.study.study_name
        replicates = self.settings.replicates
        return Point(
            label=f"#{trial.number} " + " ".join(map(short_override, chosen)),
            overrides=(*self.fixed, *chosen),
            params=dict(trial.params),
            tags={
                f"rgbt.study/{study}": str(trial.number),
                VARIED: " ".join(params),
                COLOUR: colour(study, trial.number),
            },
            seeds=tuple(range(replicates)) if replicates > 1 else (),
        )

    def _resolve_duplicate(self, trial: Trial, same: Sequence[FrozenTrial]) -> bool:
        """Copy a complete trial of the same point, or drop this one for a running trial of it."""
        for other in same:
            reason = f"the same point as trial {other.number}"
            if other.number == trial.number:
                continue
            if other.state.name == "COMPLETE":
                notes = {
                    **{key: other.user_attrs[key] for key in (names.KEY, names.RUNS)},
                    names.RESULTS: other.user_attrs[names.RESULTS],
                    names.REASON: reason,
                    names.LABEL: f"#{trial.number} = #{other.number}",
                }
                self.store.complete(trial.number, other.values, notes)
                return True
            if other.state.name == "RUNNING":
                self.store.drop(trial.number, reason)
                self._not_before = time.monotonic() + PAUSE_S
                return True
        return False

    def _pruning_callback(self, trial: Trial) -> PruningCallback | None:
        if self.settings.pruner is None and len(self.settings.objectives) > 1:
            return None
        metric = self.settings.objectives[0].metric.removeprefix("val/")
        reported: set[int] = set()

        def report(line: MetricLine) -> str:
            value = line.values.get(metric)
            if value is None or line.step in reported:
                return ""
            percent = in_percent(metric, value)
            self.store.update_unfinished(trial.number, lambda: trial.report(percent, line.step))
            reported.add(line.step)
            if self.settings.pruner is not None and trial.should_prune():
                return f"pruned at step {line.step}"
            return ""

        return report


def short_override(override: str) -> str:
    """An override as shown: "masker.sigma_div=4.123456" as "sigma_div=4.123"."""
    key, _, value = override.lstrip("+").partition("=")
    with suppress(ValueError):
        value = f"{float(value):.4g}"
    return f"{key.rpartition('.')[2]}={value}"
