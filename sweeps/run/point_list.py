"""Points that are known in advance: a grid, a list, the cells of a table."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from rgbt.checks import InputError, RunError
from rgbt.config.stored_config import check_targets, parse_trust
from rgbt.files.atomic import check_writable, is_held, write_atomic
from rgbt.runs.folder import MetricLine
from rgbt.runs.naming import VARIED
from rgbt.runs.needs import STOPPING
from rgbt.runs.result import RunResult
from rgbt.terminal import info
from sweeps.plan.planner import PlannedPoint, Planner
from sweeps.point import UNFINISHED, Outcome, Point, State, varied_keys
from sweeps.run.driver import drive
from sweeps.run.optuna_study import driving
from sweeps.run.point_state import stored_outcome, work_of
from sweeps.run.progress import ProgressView, bars
from sweeps.run.run_store import RunStore
from sweeps.settings import SweepSettings


@dataclass(frozen=True)
class PointList:
    """Describes a list of points, which is run as the study of that name.

    Attributes:
        title: shown above the progress.
        runs: finished runs; the points' overrides name the same folder.
        planner: plans them, with the overrides that all have.
        more: further points, from the outcomes until now; requested when no point is waiting.
        rank: which waiting point is the next: the one of the highest rank, and `more` is requested
            after each end; None: they are run in their order.
        announce: says what the runs need, from all outcomes, before the first one starts.
    """

    study: str
    title: str
    points: tuple[Point, ...]
    runs: RunStore
    planner: Planner
    more: Callable[[Sequence[Outcome]], Sequence[Point]] | None = None
    rank: Callable[[Point], float] | None = None
    announce: Callable[[Sequence[Outcome]], None] | None = None


class ListSource:
    """Plans the points of a list and gives them in their order; equal points are one.

    With `strict`, one wrong point is refused, and not only a list of wrong points. With `is_dry`,
    nothing is written.
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
        self._plans: dict[int, PlannedPoint] = {}  # by the index of the point
        self.errors: dict[int, str] = {}  # why points have no plan, by the same
        self._missing: set[int] = set()  # of them, those that lack data or a checkout
        self._same: dict[str, list[int]] = {}  # indices of equal points by their key
        self._order: list[PlannedPoint] = []  # the different ones, in the order of execution
        self._running: set[str] = set()  # keys
        self._ended: dict[str, Outcome] = {}  # by key
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
        wrong = {}
        for index, reason in self.errors.items():
            if not self._is_dry or index not in self._missing:
                wrong[index] = reason
        if wrong and (self._strict or not self._plans):
            # An error of every point is one of the command and not of a point.
            index, reason = next(iter(wrong.items()))
            raise InputError(f"{self._points[index].label}: {reason}" if self._plans else reason)
        varied = " ".join(varied_keys(self._points))
        for indices in self._same.values():
            tags = {VARIED: varied, **_shared_tags([self._points[index] for index in indices])}
            for index in indices:
                plan = self._plans[index]
                self._plans[index] = replace(plan, point=replace(plan.point, tags=tags))
        self._order = [self._plans[indices[0]] for indices in self._same.values()]
        return len(self._same) > before

    def _plan(self, index: int, point: Point) -> None:
        try:
            plan = self._list.planner.plan(point)
            if point.evaluations:
                trust = parse_trust(self._settings.trust)
                for run in plan.runs:
                    check_targets(run.plain, trust, point.label)
        except InputError as error:
            lacks = self._list.planner.lacking(point)
            needed = [lacks[kind] for kind in STOPPING if kind in lacks]
            self.errors[index] = "; ".join(needed) or str(error)
            if needed:
                self._missing.add(index)
        else:
            self._plans[index] = plan
            self._same.setdefault(plan.key, []).append(index)

    def next(self) -> PlannedPoint | None:
        """See `Source.next`."""
        more, rank = self._list.more, self._list.rank
        if more and rank and self._is_changed:
            self._is_changed = False
            self._add(more(self.outcomes()))
            self._order.sort(key=lambda plan: rank(plan.point), reverse=True)
        plan = self._next_waiting()
        # Points that were added before this command was stopped are finished: others follow them.
        while plan is None and more and self._add(more(self.outcomes())):
            plan = self._next_waiting()
        return plan

    def _next_waiting(self) -> PlannedPoint | None:
        for plan in self._order:
            if self._outcome(plan).state == "waiting":
                self._running.add(plan.key)
                return plan
        return None

    def report(self, plan: PlannedPoint, line: MetricLine) -> str:
        """See `Source.report`; a point of a list is never pruned."""
        del plan, line
        return ""

    def record(self, plan: PlannedPoint, outcome: Outcome) -> Outcome:
        """See `Source.record`."""
        self._running.discard(plan.key)
        self._ended[plan.key] = outcome
        self._is_changed = True
        return outcome

    def counts(self) -> Counter[str]:
        """See `Source.counts`; a state is as it was when it was looked at."""
        found = Counter(outcome.state for outcome in self._ended.values())
        counts = Counter(finished=found["finished"], running=len(self._running))
        counts["failed"] = found["failed"]
        counts["waiting"] = len(self._same) - counts.total()
        return counts

    def outcomes(self, *, preview: bool = False) -> list[Outcome]:
        """Return one outcome per point, in their order; of a preview also what others train now."""
        found = []
        for index, point in enumerate(self._points):
            if index in self.errors:
                state: State = "missing" if index in self._missing else "failed"
                found.append(Outcome(point, state, self.errors[index]))
                continue
            plan = self._plans[index]
            outcome = self._outcome(plan)
            if preview and outcome.state == "waiting":
                outcome = _previewed(plan, self._list.runs)
            found.append(replace(outcome, point=plan.point))
        return found

    def _outcome(self, plan: PlannedPoint) -> Outcome:
        if plan.key in self._running:
            return plan.outcome("running")
        ended = self._ended.get(plan.key)
        if ended is not None and ended.state != "failed":
            return ended
        is_retried = self._settings.retry == "failed"
        outcome = stored_outcome(plan, self._list.runs, is_retried=is_retried, is_dry=self._is_dry)
        # What failed here counts as finished once another point or driver has trained its run.
        if ended is not None and outcome.state != "finished":
            return ended
        if outcome.state != "waiting":
            self._ended[plan.key] = outcome
        return outcome


def _shared_tags(points: Sequence[Point]) -> dict[str, str]:
    """Return all tags of points of one run in other words (1 and 1.0)."""
    tags: dict[str, list[str]] = {}
    for point in points:
        for name, value in point.tags.items():
            values = tags.setdefault(name, [])
            if value not in values:
                values.append(value)
    return {name: " | ".join(values) for name, values in tags.items()}


def _previewed(plan: PlannedPoint, runs: RunStore) -> Outcome:
    """Return the outcome of a waiting point, which others may train now."""
    results: tuple[RunResult, ...] = ()
    with suppress(RunError):  # raised when the point is executed
        results = runs.of_point(plan)
    is_running = any(is_held(runs.runs_dir / run.key / "lock") for run in plan.runs)
    return plan.outcome("running" if is_running else "waiting", results=results)


def preview_points(points: PointList, settings: SweepSettings) -> list[Outcome]:
    """Return the present state of the points; nothing is run and nothing written."""
    return ListSource(points, settings, is_dry=True).outcomes(preview=True)


def run_points(
    points: PointList, settings: SweepSettings, *, strict: bool = False
) -> list[Outcome] | None:
    """Run all unfinished points, and return their outcomes in their order.

    A failed point does not stop the others. None: another process drives the study, which is said.

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
        if points.announce is not None:
            points.announce(source.outcomes())
        drive(ProgressView(points.title), source, points.runs, settings)
        return source.outcomes()


def commands_line(points: PointList, settings: SweepSettings) -> str:
    """Write a line of shell for every unfinished point; return what was done, in a sentence."""
    file = Path(settings.commands or "")
    check_writable(f"commands={file}", file.parent)
    if file.is_symlink() or (file.exists() and not file.is_file()):
        raise InputError(f"commands={file}: it is not a regular file.")
    if settings.dry_run or settings.gpus is not None or settings.timeout_minutes is not None:
        raise InputError("commands: dry_run, gpus and timeout_minutes have no effect on the lines.")
    source, lines = ListSource(points, settings, is_dry=True), list[str]()
    while (plan := source.next()) is not None:
        try:
            work = work_of(plan, points.runs, settings.trust)
        except RunError as error:  # its finished run is of other images
            info(f"{plan.point.label}: {error}")
            continue
        variables = [f"{name}={value}" for name, value in work.environment.items() if value]
        command = ("env", *variables, sys.executable, "-m")
        lines.append(" && ".join(shlex.join((*command, *words)) for words in work.steps))
    write_atomic(file, "".join(f"{line}\n" for line in lines).encode())
    return f"{len(lines)} commands in {file}, one a line; run them in this folder."


def estimated_seconds(outcomes: Sequence[Outcome], workers: int) -> float | None:
    """Estimate the duration of the missing trainings; None where no run has finished."""
    durations = [outcome.seconds for outcome in outcomes if outcome.seconds is not None]
    missing = sum(outcome.state in UNFINISHED and not outcome.is_trained for outcome in outcomes)
    return missing * median(durations) / workers if durations else None


def other_code_line(outcomes: Sequence[Outcome]) -> str:
    """Return how many runs other code made, in a sentence; "" for none."""
    results = {result.key: result for outcome in outcomes for result in outcome.results}
    others = sum(result.other_code is not None for result in results.values())
    made = f"{others} of {len(results)} runs were made by other code; fresh=true retrains them"
    return f"{made} and keeps the old runs." if others else ""
