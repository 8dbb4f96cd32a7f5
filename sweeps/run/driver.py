"""The driver of a study: it hands points to an executor, and records how they end.

There is one driver a study (`driving`). A driver that was killed is started again by the same
command: jobs that still run are waited for, and everything else resumes from its run folder.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Protocol

from rgbt.checks import RunError
from rgbt.cores import usable_cores
from rgbt.runs.folder import MetricLine
from rgbt.runtime.signals import deferred
from sweeps.plan.planner import PlannedPoint
from sweeps.point import Outcome
from sweeps.run.executors import Executor, open_executor, place_of
from sweeps.run.job import Work
from sweeps.run.point_state import work_of
from sweeps.run.progress import ProgressView
from sweeps.run.run_store import RunStore
from sweeps.run.running_point import RunningPoint
from sweeps.settings import SweepSettings

POLL_S = 0.2


class Source(Protocol):
    """Gives a driver its points, and records their ends in the study."""

    def next(self) -> PlannedPoint | None:
        """Return the next point that is not finished; None: there is none at the moment."""

    def report(self, plan: PlannedPoint, line: MetricLine) -> str:
        """Take a validation of the first run of a point; return why it is pruned, or ""."""

    def record(self, plan: PlannedPoint, outcome: Outcome) -> Outcome:
        """Record how a point ended; return the outcome as it counts."""

    def counts(self) -> Counter[str]:
        """Count points by their state; a search without an end has none that are waiting."""


@dataclass
class Driver:
    """Executes the points of a source; `running` are those whose jobs are queued or run."""

    source: Source
    runs: RunStore
    executor: Executor
    settings: SweepSettings
    view: ProgressView
    running: list[RunningPoint] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._began, self._has_reported_cores = time.monotonic(), False
        self._is_drained = False  # the source has nothing more until a point ends

    def run(self) -> None:
        """Execute points until none is left; with ``wait=false`` until all free ones are queued.

        On Ctrl-C or SIGTERM, jobs that would end with this command save and stop, and others with
        ``stop_jobs=true``.
        """
        try:
            while self._step():
                time.sleep(POLL_S)
        except BaseException:
            if self.settings.stop_jobs or not self.executor.is_lasting:
                self._stop()
            elif self.running:
                number = len(self.running)
                self.view.say("note", f"jobs that continue without this command: {number}.")
            raise

    def _step(self) -> bool:
        """Look at all jobs, and submit new ones; whether there is more to do."""
        ended = [point for point in self.running if self._has_ended(point)]
        self._is_drained = self._is_drained and not ended
        self.running = [point for point in self.running if point not in ended]
        new = self._submit()
        self.view.update(self.running, self.source.counts())
        if self.settings.wait or new or ended:
            return bool(self.running or new)
        return False

    def _has_ended(self, point: RunningPoint) -> bool:
        was_started = point.is_started
        outcome = point.advance(self.executor, self.runs, self.source.report)
        if point.is_started != was_started:
            label = point.plan.point.label
            if point.is_started:
                self.view.say("started", f"{label}; see {point.log}")
            else:
                self.view.say("queued", label)
        if outcome is not None:
            self.view.ended(point, self.source.record(point.plan, outcome))
        return outcome is not None

    def _submit(self) -> bool:
        """Hand free points to the executor, all at once; whether there were any."""
        plans, works = list[PlannedPoint](), list[Work]()
        is_over = time.monotonic() - self._began > 3600 * (self.settings.hours or math.inf)
        while len(self.running) + len(works) < self.executor.slots and not is_over:
            plan = None if self._is_drained else self.source.next()
            self._is_drained = plan is None
            if plan is None:
                break
            try:
                works.append(work_of(plan, self.runs, self.settings.trust))
                plans.append(plan)
            except RunError as error:  # its finished run is of other images
                outcome = self.source.record(plan, plan.outcome("failed", str(error)))
                self.view.say(outcome.state, f"{plan.point.label}  {outcome.reason}")
        sizes = [work.log.stat().st_size if work.log.exists() else 0 for work in works]
        limit_s = 60 * (self.settings.timeout_minutes or math.inf)
        with deferred():  # a job that was begun and is not known would never be stopped
            jobs = self.executor.submit(works) if works else []
            for plan, work, size, job in zip(plans, works, sizes, jobs, strict=True):
                self.running.append(RunningPoint(plan, job, work.log, size, limit_s))
                if self.executor.is_lasting:
                    self.view.say("queued", f"{plan.point.label}, job {job}")
        self._report_cores()
        return bool(works)

    def _stop(self) -> None:
        for point in self.running:
            self.executor.cancel(point.job)
        while any(self.executor.state(point.job) == "running" for point in self.running):
            time.sleep(POLL_S)

    def _report_cores(self) -> None:
        """Say once that the jobs compute with more threads than this machine has cores."""
        trainers = [point.plan.runs[0].trainer for point in self.running]
        cores, threads = usable_cores(), sum(trainer.threads for trainer in trainers)
        is_here = self.settings.launcher == "basic"
        if self._has_reported_cores or not is_here or len(trainers) < 2 or threads <= cores:
            return
        self._has_reported_cores = True
        import torch

        if not torch.accelerator.is_available() or trainers[0].accelerator == "cpu":
            fitting = max(1, cores * len(trainers) // threads)
            self.view.say(
                "note",
                f"{len(trainers)} runs with trainer.threads={trainers[0].threads} share {cores} "
                f"cores: more than workers={fitting} gain little.",
            )


def drive(view: ProgressView, source: Source, runs: RunStore, settings: SweepSettings) -> None:
    """Execute the points of `source` where the launcher of `settings` says."""
    with view:
        view.begin(place_of(settings))
        executor = open_executor(settings)
        runs.create_tables()
        Driver(source, runs, executor, settings, view).run()
