"""A point whose job an executor has: what its runs report, and how it ends."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from rgbt.checks import RunError
from rgbt.runs.folder import MetricLine
from sweeps.plan.planner import PlannedPoint
from sweeps.point import Outcome
from sweeps.run.executors import Executor
from sweeps.run.job import LOST, SAYS, TOO_LONG, failure_reason
from sweeps.run.point_state import evaluated_runs
from sweeps.run.run_store import RunStore


def read_metrics(run_folder: Path) -> list[MetricLine]:
    """Read the whole lines that a run has written until now."""
    # The file may not exist yet; the run itself reports a damaged line when it resumes.
    with suppress(FileNotFoundError, ValueError):
        content = (run_folder / "metrics.jsonl").read_bytes()
        return MetricLine.read_all(content.split(b"\n")[:-1])
    return []


@dataclass(eq=False)
class RunningPoint:
    """Follows a point whose job an executor has.

    Attributes:
        job: its name at the executor.
        log: output of the job, which begins behind byte `begin`.
        timeout_s: limit of the job from its start.
        is_started: whether the job runs, and does not wait for its turn, the first one or another.
        step: optimiser steps done by all its runs, of `steps`.
        score: last mIoU on the selection split, a fraction.
    """

    plan: PlannedPoint
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
        self._end: Outcome | None = None  # of a point that is cancelled
        self._unreported: list[MetricLine] = []
        self.steps = sum(run.trainer.max_steps for run in self.plan.runs)

    @property
    def seconds(self) -> float:
        """How long its job has run; or has waited, as long as it has not run."""
        now = 0.0 if self._ran and not self.is_started else time.monotonic() - self._began
        return self._ran + now

    @property
    def seconds_left(self) -> float:
        """Estimated time until its last step; NaN as long as there is no estimate."""
        began, first = self._first
        if self.step <= first:
            return math.nan
        return (time.monotonic() - began) / (self.step - first) * (self.steps - self.step)

    def advance(
        self,
        executor: Executor,
        runs: RunStore,
        report: Callable[[PlannedPoint, MetricLine], str],
    ) -> Outcome | None:
        """Read what is new, and report it (`Source.report`); return how the point ended, or None.

        RunError: the executor cannot be reached. An error of the study's storage: what could not
        be reported is reported by the next call.
        """
        state = executor.state(self.job)
        if state == "running" and not self.is_started:
            self.is_started, self._began = True, time.monotonic()
        elif state == "queued" and self.is_started:
            self._ran, self.is_started = self.seconds, False
        self._read(runs.runs_dir)
        pruned = ""
        while self._unreported and not pruned:
            pruned = report(self.plan, self._unreported[0])
            del self._unreported[0]
        if state not in ("queued", "running"):
            outcome = self._end or self._how_ended(state, runs)
            if outcome.reason == TOO_LONG and self.log.is_file():  # a later call skips it
                with self.log.open("a") as log:
                    log.write(f"{SAYS}{TOO_LONG}\n")
            return replace(outcome, job_s=round(self.seconds, 1))
        if self._end is None and pruned:
            self._end = self.plan.outcome("pruned", pruned)
        elif self._end is None and self.is_started and self.seconds > self.timeout_s:
            self._end = self.plan.outcome("failed", TOO_LONG)
        else:
            return None
        executor.cancel(self.job)
        return None

    def _how_ended(self, state: str, runs: RunStore) -> Outcome:
        try:
            results = evaluated_runs(self.plan, runs)
        except RunError as error:
            return self.plan.outcome("failed", str(error))
        if results:
            for result in results:
                if self.plan.point.evaluations:
                    runs.sync(result)
            return self.plan.outcome("finished", results=results)
        reason = failure_reason(self.log, self.begin)
        if state != "ended":
            said = "" if reason in (LOST, "") else f"{reason}; "
            reason = f"{said}job {self.job}: {state}"
        if reason == LOST:
            reason = f"{LOST}; see {self.log}"
        if not reason:
            keys = ", ".join(run.key for run in self.plan.runs)
            reason = (
                f"the run finished with another key than {keys}: its configuration, its data set "
                "or your own code changed during the sweep; rerun the command"
            )
        return self.plan.outcome("failed", reason)

    def _read(self, runs_dir: Path) -> None:
        """Read what its runs have written; a run that resumes repeats lines."""
        folders = [runs_dir / run.key for run in self.plan.runs]
        files = [folder / "metrics.jsonl" for folder in folders]
        size = sum(file.stat().st_size for file in files if file.exists())
        if size == self._size:
            return
        is_first, self._size, self.step = not self._size, size, 0
        for folder in folders:
            lines = read_metrics(folder)
            self.step += lines[-1].step if lines else 0
            validations = [line for line in lines if line.kind == "val"]
            if validations:
                self.score = validations[-1].values.get("mIoU", math.nan)
            if folder == folders[0]:
                self._unreported += [line for line in validations if line.step > self._validated]
                self._validated = max([self._validated, *(line.step for line in validations)])
        if is_first:
            self._first = (time.monotonic(), self.step)
