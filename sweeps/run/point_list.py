"""Points that are known in advance: a grid, a list, the cells of a table."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from rgbt.checks import InputError, RunError
from rgbt.config.stored_config import check_targets, parse_trust
from rgbt.files.atomic import check_writable, is_held, write_atomic
from rgbt.runs.naming import VARIED
from rgbt.runs.result import RunResult
from rgbt.terminal import info
from sweeps.plan.planner import PlannedPoint, Planner
from sweeps.point import UNFINISHED, Outcome, Point, varied_keys
from sweeps.run.driver import drive, log_of, work_of
from sweeps.run.job import failed_before
from sweeps.run.optuna_study import driving
from sweeps.run.progress import ProgressView, bars
from sweeps.run.run_store import RunStore
from sweeps.run.running_point import End, Task
from sweeps.settings import SweepSettings


@dataclass(frozen=True)
class PointList:
    """A list of points, run as the study of that name.

    Attributes:
        title: shown above the progress.
        runs: finished runs; the points' overrides name the same folder.
        planner: plans them, with the overrides that all have.
        more: further points, from the outcomes until now; requested when no point is waiting.
        rank: which waiting point is the next: the one of the highest rank, and `more` is requested
            after each end; None: they are run in their order.
    """

    study: str
    title: str
    points: tuple[Point, ...]
    runs: RunStore
    planner: Planner
    more: Callable[[Sequence[Outcome]], Sequence[Point]] | None = None
    rank: Callable[[Point], float] | None = None


class ListSource:
    """Plans the points of a list and gives them in their order; equal points are one.

    With `strict`, one wrong point is refused, and not only a list of wrong points. In a preview
    (`is_dry`), nothing is written.
    """

    def __init__(
        self,
        points: PointList,
        settings: SweepSettings,
        *,
        strict: bool = False,
        is_dry: bool = False,
    ) -> None:
        self._list, self._settings = points, settings
        self._strict, self._is_dry = strict, is_dry
        self._points: list[Point] = []
        self._plans: dict[int, PlannedPoint] = {}
        self.errors: dict[int, str] = {}
        # Indices of equal points, by key; the first one is run.
        self._same: dict[str, list[int]] = {}
        self._order: list[PlannedPoint] = []  # the different ones, in the order of execution
        self._running: set[str] = set()  # keys
        self._finished: dict[str, tuple[RunResult, ...]] = {}
        self._failed: dict[str, str] = {}  # key -> reason, or "": not in this command or before
        self._is_changed = True  # a point has ended since `more` was requested
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
        self._order = [self._plans[indices[0]] for indices in self._same.values()]
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

    def next(self) -> Task | None:
        """See `Source.next`."""
        more, rank = self._list.more, self._list.rank
        if more and rank and self._is_changed:
            self._is_changed = False
            self._add(more(self.outcomes()))
            self._order.sort(key=lambda plan: rank(plan.point), reverse=True)
        task = self._next_waiting()
        # Points that were added before this command was stopped are finished: others follow them.
        while task is None and more and self._add(more(self.outcomes())):
            task = self._next_waiting()
        return task

    def _next_waiting(self) -> Task | None:
        for plan in self._order:
            if self._outcome(plan).state == "waiting":
                self._running.add(plan.key)
                return Task(plan)
        return None

    def record(self, task: Task, end: End) -> End:
        """See `Source.record`."""
        key, self._is_changed = task.plan.key, True
        self._running.discard(key)
        self._failed[key] = end.reason
        if end.state == "finished":
            self._finished[key] = end.results
        return end

    def counts(self) -> Counter[str]:
        """See `Source.counts`; a state is as it was when it was looked at."""
        keys = set(self._same)
        found = Counter(finished=len(keys & set(self._finished)), running=len(self._running))
        failed = {key for key, reason in self._failed.items() if reason}
        found["failed"] = len((keys & failed) - set(self._finished) - self._running)
        found["waiting"] = len(keys) - found.total()
        return found

    def outcomes(self, *, preview: bool = False) -> list[Outcome]:
        """One outcome per point, in order; of a preview with runs that others train now."""
        found = []
        for index, point in enumerate(self._points):
            if index in self.errors:
                found.append(Outcome(point, "failed", self.errors[index]))
                continue
            plan = self._plans[index]
            outcome = self._outcome(plan)
            if preview and outcome.state == "waiting":
                folders = [self._list.runs.runs_dir / run.key for run in plan.runs]
                is_running = any(is_held(folder / "lock") for folder in folders)
                results = finished_runs(plan, self._list.runs)
                state = "running" if is_running else outcome.state
                outcome = replace(outcome, state=state, results=results)
            found.append(outcome)
        return found

    def _outcome(self, plan: PlannedPoint) -> Outcome:
        """The state of a point by its run folders, and by the log of a job that failed."""
        key, runs = plan.key, self._list.runs
        outcome = Outcome(plan.point, "waiting", keys=tuple(run.key for run in plan.runs))
        if key in self._running:
            return replace(outcome, state="running")
        if key not in self._finished:
            results = finished_runs(plan, runs)
            if plan.is_evaluated(results):
                self._finished[key] = results
                for result in () if self._is_dry else results:
                    runs.tag(result, plan.point.tags)
        if key in self._finished:
            return replace(outcome, state="finished", results=self._finished[key])
        if key not in self._failed:
            is_retried = self._settings.retry == "failed"
            self._failed[key] = "" if is_retried else failed_before(log_of(plan, runs))
        if self._failed[key]:
            return replace(outcome, state="failed", reason=self._failed[key])
        return outcome


def finished_runs(plan: PlannedPoint, runs: RunStore) -> tuple[RunResult, ...]:
    """The runs of a point if all are finished, evaluated or not; () otherwise."""
    try:
        return runs.of_point(plan)
    except RunError:  # raised again when the point is executed
        return ()


def preview_points(points: PointList, settings: SweepSettings) -> list[Outcome]:
    """The present state of the points; nothing is run and nothing written."""
    return ListSource(points, settings, is_dry=True).outcomes(preview=True)


def run_points(
    points: PointList, settings: SweepSettings, *, strict: bool = False
) -> list[Outcome] | None:
    """Run all unfinished points; a failed point does not stop the others. Outcomes in their order.

    None: another process drives the study, which is said.

    Raises:
        InputError: the executor cannot be used, all points have a wrong
            configuration, or with `strict` one of them.
    """
    with driving(points.runs.runs_dir, points.study) as is_ours:
        if not is_ours:
            return None
        source = ListSource(points, settings, strict=strict)
        for index, reason in source.errors.items():  # before hours of training
            label = points.points[index].label
            info(f"{label}: {reason.removeprefix(f'{label}: ')}")
        drive(ProgressView(points.title), source, points.runs, settings)
        return source.outcomes()


def commands_line(points: PointList, settings: SweepSettings) -> str:
    """Write a line of shell for every point that is not finished; what was done, in a sentence."""
    file = Path(settings.commands or "")
    check_writable(f"commands={file}", file.parent)
    if file.is_symlink() or (file.exists() and not file.is_file()):
        raise InputError(f"commands={file}: it is not a regular file.")
    if settings.dry_run or settings.gpus is not None or settings.timeout_minutes is not None:
        raise InputError("commands: dry_run, gpus and timeout_minutes have no effect on the lines.")
    source, lines = ListSource(points, settings, is_dry=True), list[str]()
    while (task := source.next()) is not None:
        try:
            work = work_of(task.plan, points.runs, settings.trust)
        except RunError as error:  # its finished run is of other images
            info(f"{task.plan.point.label}: {error}")
            continue
        variables = [f"{name}={value}" for name, value in work.environment.items() if value]
        steps = (["env", *variables, sys.executable, "-m", *step.words] for step in work.steps)
        lines.append(" && ".join(map(shlex.join, steps)))
    write_atomic(file, "".join(f"{line}\n" for line in lines).encode())
    return f"{len(lines)} commands in {file}, one a line; run them in this folder."


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
