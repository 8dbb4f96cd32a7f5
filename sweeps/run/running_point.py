"""A point whose job an executor has: what its runs report, and how it ends."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

from rgbt.checks import RunError
from rgbt.runs.folder import MetricLine
from rgbt.runs.result import RunResult
from sweeps import attributes as names
from sweeps.plan.planner import PlannedPoint
from sweeps.run.executors import Executor
from sweeps.run.job import LOST, SAYS, TOO_LONG, failure_reason
from sweeps.run.run_store import RunStore
from sweeps.settings import Objective

# Gets a line of the selection split; returns why the trial is pruned, or "".
PruningCallback = Callable[[MetricLine], str]


@dataclass(frozen=True)
class Task:
    """A point to execute; `report` gets every validation of its first run, once.

    `number` is that of its trial in a search; `is_left`: a driver before has begun the trial.
    """

    plan: PlannedPoint
    number: int = -1
    report: PruningCallback | None = None
    is_left: bool = False


@dataclass(frozen=True)
class End:
    """How a point ended; `reason` is why it failed or was pruned, in a sentence."""

    state: Literal["finished", "failed", "pruned"]
    reason: str = ""
    results: tuple[RunResult, ...] = ()
    seconds: float = 0.0

    def scores(self) -> dict[str, float]:
        """Scores that all runs have, averaged over the runs, in percent."""
        each = [result.recorded_scores() for result in self.results]
        shared = set(each[0]).intersection(*each[1:])
        return {name: fmean(scores[name] for scores in each) for name in each[0] if name in shared}

    def checked(self, objectives: Sequence[Objective]) -> End:
        """The same, or failed where a finished run lacks the score of an objective."""
        scores = self.scores() if self.results else {}
        for name in (each.metric for each in objectives if self.results):
            if not math.isfinite(scores.get(name, math.nan)):
                return replace(
                    self, state="failed", reason=f"its runs have no {name} that is a number"
                )
        return self

    def notes(self) -> dict[str, Any]:
        """What a trial of Optuna stores of it."""
        found: dict[str, Any] = {names.SECONDS: self.seconds}
        if self.state == "finished":
            return found | {names.RESULTS: self.scores()}
        return found | {names.REASON: self.reason}


@dataclass(eq=False)
class RunningPoint:
    """A point and its job.

    Attributes:
        job: its name at the executor.
        log: output of the job, which begins behind byte `begin`.
        timeout_s: limit of the job from its start.
        is_started: whether the job runs, and does not wait for its turn, the first one or another.
        step: optimiser steps done by all its runs, of `steps`.
        score: last mIoU on the selection split, a fraction.
    """

    task: Task
    job: str
    log: Path
    begin: int
    timeout_s: float = math.inf
    is_started: bool = field(default=False, init=False)
    step: int = field(default=0, init=False)
    score: float = field(default=math.nan, init=False)

    def __post_init__(self) -> None:
        self._began, self._ran = time.monotonic(), 0.0  # seconds before it was queued again
        self._first = (math.inf, sys.maxsize)  # time and step at the first look at the metrics
        self._size, self._validated = 0, 0  # of the metrics, and step of the last one reported
        self._end: End | None = None  # of a point that is cancelled
        self._unreported: list[MetricLine] = []
        self.steps = sum(run.trainer.max_steps for run in self.task.plan.runs)

    @property
    def seconds(self) -> float:
        """That its job has run; or has waited, as long as it has not run."""
        now = 0.0 if self._ran and not self.is_started else time.monotonic() - self._began
        return self._ran + now

    @property
    def seconds_left(self) -> float:
        """Estimated time until its last step; NaN as long as there is no estimate."""
        began, first = self._first
        if self.step <= first:
            return math.nan
        return (time.monotonic() - began) / (self.step - first) * (self.steps - self.step)

    def advance(self, executor: Executor, runs: RunStore) -> End | None:
        """Read what is new; how the point ended, or None.

        RunError: the executor cannot be reached. An error of the study's storage: what could not
        be reported is reported by the next call.
        """
        state = executor.state(self.job)
        if state == "running" and not self.is_started:
            self.is_started, self._began = True, time.monotonic()
        elif state == "queued" and self.is_started:
            self._ran, self.is_started = self.seconds, False
        reason = self.read(runs.runs_dir)
        if state not in ("queued", "running"):
            found = self._end or self._how_ended(state, runs)
            if found.reason == TOO_LONG and self.log.is_file():  # a later call skips it
                with self.log.open("a") as log:
                    log.write(f"{SAYS}{TOO_LONG}\n")
            return replace(found, seconds=round(self.seconds, 1))
        if self._end is None and reason:
            self._end = End("pruned", reason)
        elif self._end is None and self.is_started and self.seconds > self.timeout_s:
            self._end = End("failed", TOO_LONG)
        else:
            return None
        executor.cancel(self.job)
        return None

    def _how_ended(self, state: str, runs: RunStore) -> End:
        plan = self.task.plan
        try:
            results = runs.of_point(plan)
        except RunError as error:
            return End("failed", str(error))
        if plan.is_evaluated(results):
            for result in results:
                runs.tag(result, plan.point.tags)
                if plan.point.evaluations:
                    runs.sync(result)
            return End("finished", results=results)
        reason = failure_reason(self.log, self.begin)
        if state != "ended":
            said = "" if reason in (LOST, "") else f"{reason}; "
            reason = f"{said}job {self.job}: {state}"
        if reason == LOST:
            reason = f"{LOST}; see {self.log}"
        keys = ", ".join(run.key for run in plan.runs)
        changed = (
            f"the run finished with another key than {keys}: its configuration, its data set or "
            "your own code changed during the sweep; rerun the command"
        )
        return End("failed", reason or changed)

    def read(self, runs_dir: Path) -> str:
        """Read what its runs have written, and report it; why the point is pruned, or ""."""
        files = [runs_dir / run.key / "metrics.jsonl" for run in self.task.plan.runs]
        size = sum(file.stat().st_size for file in files if file.exists())
        if size != self._size:
            is_first, self._size, self.step = not self._size, size, 0
            for file in files:
                self._read_metrics(file, is_reported=file is files[0])
            if is_first:
                self._first = (time.monotonic(), self.step)
        while self._unreported and self.task.report is not None:
            if reason := self.task.report(self._unreported[0]):
                return reason
            del self._unreported[0]
        return ""

    def _read_metrics(self, file: Path, *, is_reported: bool) -> None:
        """Read whole lines of new steps; a run that resumes repeats those before its checkpoint."""
        lines = list[MetricLine]()
        # It may not exist yet; the run itself reports a damaged line when it resumes.
        with suppress(FileNotFoundError, ValueError):
            lines = MetricLine.read_all(file.read_bytes().split(b"\n")[:-1])
        self.step += lines[-1].step if lines else 0
        validations = [line for line in lines if line.kind == "val"]
        if validations:
            self.score = validations[-1].values.get("mIoU", math.nan)
        if is_reported:
            self._unreported += [line for line in validations if line.step > self._validated]
            self._validated = max([self._validated, *(line.step for line in validations)])
