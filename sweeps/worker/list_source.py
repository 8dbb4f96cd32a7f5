"""Trials of points known beforehand: a grid, a list, the cells of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from rgbt.checks import RunError
from rgbt.tracking.run_result import RunResult
from sweeps import attributes as names
from sweeps.settings import SweepSettings
from sweeps.worker.planner import PlannedPoint
from sweeps.worker.run_store import RunStore
from sweeps.worker.trial_source import ClaimedTrial, trial_attributes
from sweeps.worker.trial_store import TrialClaim, TrialStore

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

State = Literal["finished", "failed", "running", "waiting", "pruned"]


@dataclass(frozen=True)
class PointStatus:
    """The state of a point.

    Attributes:
        state: see `State`.
        reason: why it failed, or "".
        results: its finished runs.
        replaced: numbers of its earlier trials that a new trial replaces.
    """

    state: State
    reason: str = ""
    results: tuple[RunResult, ...] = ()
    replaced: tuple[int, ...] = ()


class ListSource:
    """Claims the points of a list in their order.

    Args:
        plans: the points; of equal keys the last one counts.
        store: the study.
        runs: finished runs.
        settings: `retries` and `retry` count here.
        distributions: of the parameters of a grid, by name.
    """

    requeues = False
    rejected = 0

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
        self._rechecked: set[tuple[str, int]] = set()

    def next(self) -> ClaimedTrial | None:
        """See `TrialSource.next`."""
        by_key = self._store.by_key()
        for plan in self.plans.values():
            status = self.status(plan, by_key)
            if status.state != "waiting":
                continue
            params = {k: v for k, v in plan.point.params.items() if k in self._distributions}
            claim = TrialClaim(
                key=plan.key,
                attributes=trial_attributes(plan),
                params=params,
                distributions={name: self._distributions[name] for name in params},
                replaced=status.replaced,
            )
            number = self._store.claim(claim)
            if number is not None:
                return ClaimedTrial(plan, number)
        return None

    def is_exhausted(self, *, wait: bool) -> bool:
        """See `TrialSource.is_exhausted`."""
        states = {status.state for status in self.statuses()}
        return not states & ({"running", "waiting"} if wait else {"waiting"})

    def statuses(self) -> list[PointStatus]:
        """The states of all points."""
        by_key = self._store.by_key()
        return [self.status(plan, by_key) for plan in self.plans.values()]

    def status(
        self, plan: PlannedPoint, by_key: Mapping[str, Sequence[FrozenTrial]]
    ) -> PointStatus:
        """The state of a point by the study and the finished runs."""
        if plan.key in self._finished:
            return self._finished[plan.key]
        trials = by_key.get(plan.key, ())
        states = {trial.state.name for trial in trials}
        if "RUNNING" in states:
            return PointStatus("running")
        if "COMPLETE" in states and self._is_finished(plan):
            return self._finished[plan.key]
        failed = [trial for trial in trials if trial.state.name == "FAIL"]
        counted = [t for t in failed if t.number not in self._forgiven.get(plan.key, ())]
        if len(counted) <= self._retries:
            return PointStatus("waiting", replaced=tuple(trial.number for trial in trials))
        # Its runs may have been finished by hand since.
        last = (plan.key, counted[-1].number)
        if last not in self._rechecked:
            self._rechecked.add(last)
            if self._is_finished(plan):
                return self._finished[plan.key]
        return PointStatus("failed", reason_of(counted[-1]))

    def _is_finished(self, plan: PlannedPoint) -> bool:
        results = finished_runs(plan, self._runs)
        if results is None or not is_evaluated(plan, results):
            return False
        self._finished[plan.key] = PointStatus("finished", results=results)
        return True


def finished_runs(plan: PlannedPoint, runs: RunStore) -> tuple[RunResult, ...] | None:
    """The runs of a point if all are finished, evaluated or not; None otherwise."""
    results = []
    for run in plan.runs:
        try:
            result = runs.find(run.key, run.dataset)
        except RunError:  # raised again when the point is executed
            return None
        if result is None:
            return None
        results.append(result)
    return tuple(results)


def is_evaluated(plan: PlannedPoint, results: Sequence[RunResult]) -> bool:
    """Whether all further evaluations of a point's runs exist."""
    paths = [evaluation.path for evaluation in plan.point.evaluations]
    return all(result.has_counts(path) for result in results for path in paths)


def reason_of(trial: FrozenTrial) -> str:
    """Why a trial failed."""
    return str(trial.user_attrs.get(names.REASON, "no reason was noted"))
