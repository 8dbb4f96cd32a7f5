"""The driver of a study: it hands points to an executor, and records how they end.

There is one driver a study (`driving`). A driver that was killed is started again by the same
command: jobs that still run are waited for, and everything else resumes from its run folder.
"""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from rgbt.checks import InputError, RunError
from rgbt.config.compose import OWN_FOLDERS, own_folders
from rgbt.cores import usable_cores
from rgbt.files.atomic import is_held
from rgbt.files.plain_files import inside
from rgbt.runs.naming import TAGS
from rgbt.runtime.signals import deferred
from sweeps.plan.measurement import command_of, stored_at
from sweeps.plan.planner import PlannedPoint
from sweeps.run.executors import Executor, open_executor
from sweeps.run.job import TRAINING, Step, Work, failed_before
from sweeps.run.local import LocalExecutor
from sweeps.run.progress import ProgressView
from sweeps.run.run_store import RunStore
from sweeps.run.running_point import End, RunningPoint, Task
from sweeps.settings import SweepSettings

POLL_S = 0.2
LOGS = ".logs"  # folder in the folder of runs: output of jobs, one file a point
# Settings of a run that its evaluations get, too.
FOLDERS = ("dataset.root=", "dataset.cache_dir=")


class Source(Protocol):
    """Gives a driver its points, and records their ends in the study."""

    def next(self) -> Task | None:
        """The next point that is not finished; None: there is none at the moment."""

    def record(self, task: Task, end: End) -> End:
        """Record how a point ended; the end as it counts."""

    def counts(self) -> Counter[str]:
        """Points by their state: finished, failed, pruned, running, waiting; without end: none."""


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
                self.view.say("note", f"{len(self.running)} jobs continue without this command.")
            raise

    def _step(self) -> bool:
        """Look at all jobs, and submit new ones; whether there is more to do."""
        ended = [point for point in self.running if self._advance(point)]
        self._is_drained = self._is_drained and not ended
        self.running = [point for point in self.running if point not in ended]
        new = self._submit()
        self.view.update(self.running, self.source.counts())
        if self.settings.wait or new or ended:
            return bool(self.running or new)
        return False

    def _advance(self, point: RunningPoint) -> bool:
        was_started, label = point.is_started, point.task.plan.point.label
        end = point.advance(self.executor, self.runs)
        if point.is_started != was_started:
            self.view.say("started" if point.is_started else "queued", label)
        if end is not None:
            end = self.source.record(point.task, end)
            self.view.ended(point, end.state, end.reason)
        return end is not None

    def _submit(self) -> bool:
        """Hand free points to the executor, all at once; whether there were any."""
        tasks, works = list[Task](), list[Work]()
        while len(self.running) + len(works) < self.executor.slots and not self._is_over():
            task = None if self._is_drained else self.source.next()
            self._is_drained = task is None
            if task is None:
                break
            found = self._look(task)
            if isinstance(found, Work):
                works.append(found)
                tasks.append(task)
            else:
                end = self.source.record(task, found)
                self.view.say(end.state, f"{task.plan.point.label}  {end.reason}".rstrip())
        sizes = [work.log.stat().st_size if work.log.exists() else 0 for work in works]
        limit_s = 60 * (self.settings.timeout_minutes or math.inf)
        with deferred():  # a job that was begun and is not known would never be stopped
            jobs = self.executor.submit(works) if works else []
            for task, work, size, job in zip(tasks, works, sizes, jobs, strict=True):
                self.running.append(RunningPoint(task, job, work.log, size, limit_s))
                if self.executor.is_lasting:
                    self.view.say("queued", f"{task.plan.point.label}, job {job}")
        self._report_cores()
        return bool(tasks)

    def _look(self, task: Task) -> Work | End:
        """What a point lacks, or how it ended before."""
        try:
            work = work_of(task.plan, self.runs, self.settings.trust)
            if not work.steps:
                return self._finished_before(task, work.log)
        except RunError as error:  # its finished run is of other images
            return End("failed", str(error))
        is_skipped = task.is_left and self.settings.retry == "none"
        reason = failed_before(work.log) if is_skipped else ""
        return End("failed", reason) if reason else work

    def _finished_before(self, task: Task, log: Path) -> End:
        """The end of a point whose job ended while no driver looked."""
        RunningPoint(task, "", log, 0).read(self.runs.runs_dir)
        results = self.runs.of_point(task.plan)
        for result in results:
            self.runs.tag(result, task.plan.point.tags)
        seconds = sum(result.result.get("seconds_of_last_process", 0.0) for result in results)
        return End("finished", results=results, seconds=round(seconds, 1))

    def _stop(self) -> None:
        for point in self.running:
            self.executor.cancel(point.job)
        while any(self.executor.state(each.job) == "running" for each in self.running):
            time.sleep(POLL_S)

    def _is_over(self) -> bool:
        """Whether the time of this call is spent."""
        return time.monotonic() - self._began > 3600 * (self.settings.hours or math.inf)

    def _report_cores(self) -> None:
        """Say once that the jobs compute with more threads than this machine has cores."""
        trainers = [point.task.plan.runs[0].trainer for point in self.running]
        cores, threads = usable_cores(), sum(trainer.threads for trainer in trainers)
        is_here = isinstance(self.executor, LocalExecutor)
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


def work_of(plan: PlannedPoint, runs: RunStore, trust: str) -> Work:
    """What a point lacks: trainings, and further evaluations of its runs.

    Finished runs of other code that ``fresh=true`` trains again are moved out of the way. RunError:
    a finished run is of other images.
    """
    steps = []
    for run in plan.runs:
        folder = runs.runs_dir / run.key
        if not is_held(folder / "lock"):
            runs.replace_outdated(run.key)
        result = runs.find(run.key, plan.fingerprints[run.key], plan.point.evaluations)
        if result is None:
            steps.append(Step((TRAINING, *run.overrides), folder))
        for words in plan.point.evaluations:
            if result is None or stored_at(result, words) is None:
                module, *arguments = command_of(words)
                arguments += [f"trust={trust}"] if trust else []
                # The run may come from a machine with other folders.
                arguments += [word for word in run.overrides if word.startswith(FOLDERS)]
                steps.append(Step((module, f"run={folder}", *arguments), folder))
    environment = {TAGS: json.dumps(dict(plan.point.tags)), OWN_FOLDERS: own_folders()}
    # One command may make several measurements.
    return Work(plan.key, tuple(dict.fromkeys(steps)), environment, log_of(plan, runs), Path.cwd())


def log_of(plan: PlannedPoint, runs: RunStore) -> Path:
    """The file with the output of the jobs of a point; InputError for a link out of the runs."""
    return inside(runs.runs_dir / LOGS / f"{plan.key}.log", runs.runs_dir)


def drive(view: ProgressView, source: Source, runs: RunStore, settings: SweepSettings) -> None:
    """Execute the points of `source` where the launcher of `settings` says."""
    from optuna.exceptions import StorageInternalError

    executor = open_executor(settings.launcher, settings.workers, settings.gpus)
    if not settings.wait and not executor.is_lasting:
        raise InputError("wait=false: these runs end with the command; SLURM's and Ray's do not.")
    runs.create_tables()
    try:
        with view:
            Driver(source, runs, executor, settings, view).run()
    except StorageInternalError as error:
        raise RunError(f"storage: {str(error).splitlines()[0]}; rerun the command.") from error
