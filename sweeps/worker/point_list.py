"""Points that are known in advance: a grid, a list, the cells of a table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import TYPE_CHECKING

from rgbt.checks import InputError, RunError
from rgbt.config.stored_config import check_targets, parse_trust
from rgbt.runs.naming import VARIED
from rgbt.runs.result import RunResult
from rgbt.terminal import info
from sweeps import attributes as names
from sweeps.evaluation import stored_at
from sweeps.point import UNFINISHED, Outcome, Point, State, varied_keys
from sweeps.settings import SweepSettings
from sweeps.worker import storage as stores
from sweeps.worker.driver import drive
from sweeps.worker.planner import PlannedPoint, Planner
from sweeps.worker.progress import ProgressView, bars
from sweeps.worker.run_store import RunStore
from sweeps.worker.running_trial import ClaimedTrial
from sweeps.worker.storage import TrialStore, known_studies, trials_by_key

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial


@dataclass(frozen=True)
class PointList:
    """A list of points, run as the study of that name.

    Attributes:
        title: shown above the progress.
        kind: "grid" or "list".
        runs: finished runs; the points' overrides name the same folder.
        planner: plans them, with the overrides that all have.
        more: further points, from the outcomes until now; requested when no point is waiting.
        rank: which waiting point is the next: the one of the highest rank, and `more` is requested
            before each; None: they are run in their order.
    """

    study: str
    title: str
    kind: str
    points: tuple[Point, ...]
    runs: RunStore
    planner: Planner
    more: Callable[[Sequence[Outcome]], Sequence[Point]] | None = None
    rank: Callable[[Point], float] | None = None


class ListSource:
    """Plans the points of a list, and claims them in their order; `store` is set in between.

    With `strict`, one wrong point is refused, and not only a list of wrong points.
    """

    store: TrialStore

    def __init__(self, points: PointList, settings: SweepSettings, *, strict: bool = False) -> None:
        self._list, self._settings, self._strict = points, settings, strict
        self._points: list[Point] = []
        self._plans: dict[int, PlannedPoint] = {}
        self.errors: dict[int, str] = {}
        # Indices of equal points, by key; the first one is run.
        self._same: dict[str, list[int]] = {}
        self._forgiven: set[int] | None = None
        self._finished: dict[str, tuple[RunResult, ...]] = {}
        self._seen: set[int | str] = set()  # failed trials whose runs were looked for, and keys
        self._add(points.points)

    def _add(self, points: Sequence[Point]) -> bool:
        """Add and plan points; whether there are more different ones than before."""
        before, first = len(self._same), len(self._points)
        self._points += points
        with bars() as shown:
            title = f"{self._list.title}: planning"
            for index, point in enumerate(shown.track(points, description=title), first):
                self._plan(index, point)
        if self.errors and (self._strict or not self._plans):
            # An error of every point is one of the command and not of a point.
            index, reason = next(iter(self.errors.items()))
            raise InputError(f"{self._points[index].label}: {reason}" if self._plans else reason)
        varied = " ".join(varied_keys(self._points))
        for indices in self._same.values():
            # Points of the same run in other words (1 and 1.0) get the tags of all of them.
            tags: dict[str, dict[str, None]] = {}
            for name, value in (pair for i in indices for pair in self._points[i].tags.items()):
                tags.setdefault(name, {})[value] = None
            merged = {VARIED: varied} | {name: " | ".join(values) for name, values in tags.items()}
            for index in indices:
                plan = self._plans[index]
                self._plans[index] = replace(plan, point=replace(plan.point, tags=merged))
        return len(self._same) > before

    def _plan(self, index: int, point: Point) -> None:
        try:
            plan = self._list.planner.plan(point)
            for run in plan.runs if point.evaluations else ():
                check_targets(run.plain, parse_trust(self._settings.trust), point.label)
        except InputError as error:
            self.errors[index] = str(error)
        else:
            self._plans[index] = plan
            self._same.setdefault(plan.key, []).append(index)

    def next(self) -> ClaimedTrial | None:
        """See `TrialSource.next`."""
        more, rank = self._list.more, self._list.rank
        if more and rank:
            self._add(more(self.outcomes()))
        claimed = self._claim()
        # Points that were added before this command was stopped are finished: others follow them.
        while claimed is None and more and self._add(more(self.outcomes())):
            claimed = self._claim()
        return claimed

    def _claim(self) -> ClaimedTrial | None:
        by_key = trials_by_key(self.store.study)
        for plan in self._different():
            if self._status(plan, by_key).state != "waiting":
                continue
            # Failed trials of the point, and those whose runs were deleted.
            replaced = [trial.number for trial in by_key.get(plan.key, ())]
            number = self.store.claim(plan.attributes, replaced)
            if number is not None:
                return ClaimedTrial(plan, number)
        return None

    def is_exhausted(self, *, wait: bool) -> bool:
        """See `TrialSource.is_exhausted`."""
        by_key = trials_by_key(self.store.study)
        if any(self._status(plan, by_key).state == "waiting" for plan in self._different()):
            return False
        # A killed driver may leave a second trial of a finished point, which is failed when stale.
        trials = [trial for key in self._same for trial in by_key.get(key, ())]
        return not (wait and any(trial.state.name == "RUNNING" for trial in trials))

    def states(self) -> list[State]:
        """The states of the different points."""
        by_key = trials_by_key(self.store.study)
        return [self._status(plan, by_key).state for plan in self._different()]

    def outcomes(
        self, study: optuna.Study | None = None, *, preview: bool = False
    ) -> list[Outcome]:
        """One outcome per point, in order, by the study; of a preview by all finished runs too."""
        by_key = trials_by_key(study if preview else self.store.study)
        found = []
        for index, point in enumerate(self._points):
            if index in self.errors:
                found.append(Outcome(point, "failed", self.errors[index]))
                continue
            outcome = self._status(plan := self._plans[index], by_key)
            if preview:
                results = finished_runs(plan, self._list.runs)
                state = "finished" if is_evaluated(plan, results) else outcome.state
                outcome = replace(outcome, state=state, results=results)
            found.append(outcome)
        return found

    def _different(self) -> Iterator[PlannedPoint]:
        plans = (self._plans[indices[0]] for indices in self._same.values())
        if (rank := self._list.rank) is None:
            return plans
        return iter(sorted(plans, key=lambda plan: rank(plan.point), reverse=True))

    def _status(self, plan: PlannedPoint, by_key: Mapping[str, list[FrozenTrial]]) -> Outcome:
        """The state of a point by the study and the finished runs."""
        if self._forgiven is None:
            before = sum(by_key.values(), []) if self._settings.retry == "failed" else []
            self._forgiven = {trial.number for trial in before if trial.state.name == "FAIL"}
        trials = by_key.get(plan.key, ())
        states = {trial.state.name for trial in trials}
        failed = [trial for trial in trials if trial.state.name == "FAIL"]
        # The runs of a failed point may have been finished by hand since; what is ranked depends
        # on all that has ever been run.
        looked: set[int | str] = {trial.number for trial in failed}
        unseen = (looked | ({plan.key} if self._list.rank else set())) - self._seen
        self._seen |= unseen
        if ("COMPLETE" in states or unseen) and plan.key not in self._finished:
            results = finished_runs(plan, self._list.runs)
            if is_evaluated(plan, results):
                self._finished[plan.key] = results
        counted = [trial for trial in failed if trial.number not in self._forgiven]
        outcome = Outcome(plan.point, "waiting", keys=tuple(run.key for run in plan.runs))
        if plan.key in self._finished:
            return replace(outcome, state="finished", results=self._finished[plan.key])
        if "RUNNING" in states:
            return replace(outcome, state="running")
        if counted:
            reason = str(counted[-1].user_attrs[names.REASON])
            return replace(outcome, state="failed", reason=reason)
        return outcome


def finished_runs(plan: PlannedPoint, runs: RunStore) -> tuple[RunResult, ...]:
    """The runs of a point if all are finished, evaluated or not; () otherwise."""
    wanted = plan.point.evaluations
    try:
        found = [runs.find(run.key, plan.fingerprints[run.key], wanted) for run in plan.runs]
    except RunError:  # raised again when the point is executed
        return ()
    results = tuple(result for result in found if result is not None)
    return results if len(results) == len(found) else ()


def is_evaluated(plan: PlannedPoint, results: Sequence[RunResult]) -> bool:
    """Whether there are runs, and all further evaluations of them."""
    wanted = plan.point.evaluations
    return bool(results) and all(stored_at(result, each) for result in results for each in wanted)


def preview_points(points: PointList, settings: SweepSettings) -> list[Outcome]:
    """The present state of the points; nothing is run and nothing written."""
    source = ListSource(points, settings)
    study = known_studies(settings.storage, points.runs.runs_dir).get(points.study)
    return source.outcomes(study, preview=True)


def run_points(
    points: PointList, settings: SweepSettings, *, strict: bool = False
) -> list[Outcome]:
    """Run all unfinished points; a failed point does not stop the others. Outcomes in their order.

    Raises:
        InputError: the storage or the executor cannot be used, all points have a wrong
            configuration, or with `strict` one of them.
    """
    source = ListSource(points, settings, strict=strict)
    storage = stores.open_storage(settings.storage, points.runs.runs_dir)
    study = stores.open_study(points.study, storage, settings.objectives, {names.KIND: points.kind})
    source.store = TrialStore(study, storage)

    def progress() -> tuple[int, int]:
        states = source.states()
        return sum(state in ("finished", "failed") for state in states), len(states)

    for index, reason in source.errors.items():  # before hours of training
        label = points.points[index].label
        info(f"{label}: {reason.removeprefix(f'{label}: ')}")
    view = ProgressView(points.title, settings.workers, progress)
    drive(view, source, points.runs, settings)
    return source.outcomes()


def estimated_seconds(outcomes: Sequence[Outcome], workers: int) -> float | None:
    """Estimated duration of the missing trainings; None where no run has finished."""
    durations = [outcome.seconds for outcome in outcomes if outcome.seconds is not None]
    missing = sum(outcome.state in UNFINISHED and not outcome.is_trained for outcome in outcomes)
    return missing * median(durations) / workers if durations else None


def other_code_line(outcomes: Sequence[Outcome]) -> str:
    """How many runs other code made, in a sentence; "" for none."""
    results = {result.key: result for outcome in outcomes for result in outcome.results}
    others = sum(result.other_code is not None for result in results.values())
    made = f"{others} of {len(results)} runs were made by other code; fresh=true retrains them"
    return f"{made} and keeps the old runs." if others else ""
