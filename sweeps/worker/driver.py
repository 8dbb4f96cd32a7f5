"""Executes the trials of a study: some at a time, each in a separate process.

Any number of drivers, on any number of machines, may share a study. A failure ends one trial only.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

from rgbt.checks import RunError
from rgbt.cores import usable_cores
from rgbt.runs.naming import TAGS
from sweeps import attributes as names
from sweeps.settings import SweepSettings
from sweeps.worker.processes import GPUS, LocalExecutor, LocalJob, check_gpus, gpus_of
from sweeps.worker.progress import ProgressView
from sweeps.worker.run_store import RunStore
from sweeps.worker.running_trial import (
    ClaimedTrial,
    RunningTrial,
    TrialError,
    TrialPruned,
    mean_scores,
)
from sweeps.worker.storage import HEARTBEAT_S, TrialStore

POLL_S = 0.2
# How often, and how long, a driver tries to reach its storage again.
PAUSE_S, RECONNECT_S = 5.0, 600.0
# Seconds between two searches for trials to claim, after one without result.
CLAIM_S = 2.0


class TrialSource(Protocol):
    """Gives a driver its trials."""

    store: TrialStore

    def next(self) -> ClaimedTrial | None:
        """The next trial, claimed for this driver; None when there is none at the moment."""

    def is_exhausted(self, *, wait: bool) -> bool:
        """Whether no trial is left; with `wait`, whether other drivers have finished too."""


@dataclass
class Driver:
    """One process that executes trials of one study; `running` are those in progress, by slot."""

    source: TrialSource
    runs: RunStore
    executor: LocalExecutor
    settings: SweepSettings
    view: ProgressView
    running: dict[int, RunningTrial] = field(default_factory=dict)
    _began: float = field(default_factory=time.monotonic)
    _last_claim: float = -math.inf
    _last_heartbeat: float = field(default_factory=time.monotonic)
    _has_reported_cores: bool = False

    def __post_init__(self) -> None:
        self.store = self.source.store

    def run(self) -> None:
        """Execute trials until none is left; on Ctrl-C or SIGTERM release the unfinished ones.

        Without access to the storage it waits, while the runs continue.
        """
        from optuna.exceptions import StorageInternalError

        try:
            self._loop()
        except BaseException:
            for trial in self.running.values():
                trial.stop()
            while not all(trial.is_stopped() for trial in self.running.values()):
                time.sleep(POLL_S)
            # Without access to the storage they are stale trials, which the next driver fails.
            with suppress(StorageInternalError):
                for trial in self.running.values():
                    self.store.release(trial.number)
            raise

    def _loop(self) -> None:
        from optuna.exceptions import StorageInternalError

        more, reached = True, time.monotonic()
        while more:
            try:
                more = self._step()
                reached = time.monotonic()
                time.sleep(POLL_S)
            except StorageInternalError as error:
                if time.monotonic() - reached > RECONNECT_S:
                    raise RunError(f"storage: {str(error).splitlines()[0]}") from error
                time.sleep(PAUSE_S)

    def _step(self) -> bool:
        """Advance all trials and claim new ones; whether there is more to do."""
        for slot, trial in list(self.running.items()):
            if self._advance(trial):
                del self.running[slot]
        self._send_heartbeats()
        is_due = time.monotonic() - self._last_claim > CLAIM_S
        if is_due and len(self.running) < self.settings.workers:
            self.store.fail_stale()
            while len(self.running) < self.settings.workers and not self._is_over():
                if not self._claim():
                    self._last_claim = time.monotonic()
                    break
        self.view.update(list(self.running.values()))
        if self.running or not is_due:
            return True
        return not (self._is_over() or self.source.is_exhausted(wait=self.settings.wait))

    def _send_heartbeats(self) -> None:
        now = time.monotonic()
        if now - self._last_heartbeat > HEARTBEAT_S:
            self.store.send_heartbeats(trial.number for trial in self.running.values())
            self._last_heartbeat = now

    def _claim(self) -> bool:
        """Begin a trial, if there is one."""
        claimed = self.source.next()
        if claimed is None:
            return False
        slot = min(set(range(self.settings.workers)) - set(self.running))
        start = partial(self._start, slot, claimed.plan.point.tags)
        limit_s = 60 * (self.settings.timeout_minutes or math.inf)
        trial = RunningTrial(claimed, self.runs, start, limit_s, self.settings.trust)
        self.view.say("started", trial.plan.point.label)
        self.running[slot] = trial
        # A point that was finished elsewhere needs no process: its slot is free at once.
        if self._advance(trial):
            del self.running[slot]
        self._report_cores()
        self._send_heartbeats()
        return True

    def _report_cores(self) -> None:
        """Say once that the trials compute with more threads than this machine has cores."""
        trainers = [trial.plan.runs[0].trainer for trial in self.running.values()]
        cores, threads = usable_cores(), sum(each.threads for each in trainers)
        if self._has_reported_cores or len(trainers) == 1 or threads <= cores:
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

    def _is_over(self) -> bool:
        """Whether the time of this call is spent."""
        return time.monotonic() - self._began > 3600 * (self.settings.hours or math.inf)

    def _start(
        self, slot: int, tags: Mapping[str, str], command: Sequence[str], log: Path
    ) -> LocalJob:
        environment = {TAGS: json.dumps(dict(tags))}
        if self.settings.gpus:
            gpus = gpus_of(self.settings.gpus[slot % len(self.settings.gpus)])
            environment[GPUS] = ",".join(gpus)
        return self.executor.start(command, environment, log)

    def _advance(self, trial: RunningTrial) -> bool:
        """Whether the trial has ended; its end is recorded in the study."""
        notes = {names.SECONDS: round(trial.seconds, 1)}
        try:
            results = trial.advance()
            if results is None:
                return False
            scores = mean_scores(results)
            metrics = [objective.metric for objective in self.settings.objectives]
            for name in metrics:
                if not math.isfinite(scores.get(name, math.nan)):
                    raise TrialError(f"its runs have no {name} that is a number")
        except TrialPruned as reason:
            self.store.fail(trial.number, str(reason), notes, "PRUNED")
            self.view.ended(trial, "pruned", str(reason))
        except TrialError as error:
            self.store.fail(trial.number, str(error), notes)
            self.view.ended(trial, "failed", str(error))
        else:
            values = [scores[name] for name in metrics]
            self.store.complete(trial.number, values, {**notes, names.RESULTS: dict(scores)})
            self.view.ended(trial, "finished", "")
        return True


def drive(view: ProgressView, source: TrialSource, runs: RunStore, settings: SweepSettings) -> None:
    """Execute the trials of `source` in processes of this machine, and show the progress."""
    check_gpus(settings.gpus)
    with view:
        Driver(source, runs, LocalExecutor(settings.workers), settings, view).run()
