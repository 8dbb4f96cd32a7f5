"""Executes the trials of a study: some at a time, each in a separate process.

Any number of drivers, on any number of machines, may share a study. Each point is run by one
driver; trials of a dead driver are executed by another one; a driver that is started again resumes
the study. A failure ends one trial only.
"""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rgbt.checks import RunError
from rgbt.metrics.names import CA, TC
from rgbt.runs.naming import TAGS
from sweeps import attributes as names
from sweeps.settings import SweepSettings
from sweeps.worker.executors import (
    GPUS,
    Executor,
    Job,
    LocalExecutor,
    check_gpus,
    gpus_of,
)
from sweeps.worker.progress import ProgressView
from sweeps.worker.run_store import RunStore
from sweeps.worker.running_trial import RunningTrial, TrialError, TrialPruned, mean_scores
from sweeps.worker.trial_sources import TrialSource
from sweeps.worker.trial_store import HEARTBEAT_S, TrialStore

POLL_S = 0.2
RECONNECT_S = 600.0
"""How long a driver waits for a storage that cannot be reached."""

PAUSE_S = 5.0
CLAIM_S = 2.0
"""Seconds between two searches for trials to claim, after one without result."""


@dataclass
class Driver:
    """One process that executes trials of one study.

    Attributes:
        source: claims trials.
        runs: finished runs.
        running: trials in progress, by slot.
        failures: number of failed trials.
    """

    store: TrialStore
    source: TrialSource
    runs: RunStore
    executor: Executor
    settings: SweepSettings
    view: ProgressView
    running: dict[int, RunningTrial] = field(default_factory=dict)
    failures: int = 0
    _began: float = field(default_factory=time.monotonic)
    _last_claim: float = -math.inf
    _last_heartbeat: float = field(default_factory=time.monotonic)
    _unreachable_since: float = 0.0
    _attempts: Counter[str] = field(default_factory=Counter)

    def run(self) -> None:
        """Execute trials until none is left; on Ctrl-C or SIGTERM release the unfinished ones."""
        try:
            while self._step_or_wait():
                # The rest of a long list is planned while the first runs train.
                if not self.source.plan(POLL_S):
                    time.sleep(POLL_S)
        except BaseException:
            self._release_all()
            raise

    def _step_or_wait(self) -> bool:
        """A step; without access to the storage wait for it, while the runs continue."""
        from optuna.exceptions import StorageInternalError

        try:
            more = self._step()
        except StorageInternalError as error:
            now = time.monotonic()
            self._unreachable_since = self._unreachable_since or now
            if now - self._unreachable_since > RECONNECT_S:
                raise RunError(
                    f"the storage of the study cannot be reached for {RECONNECT_S / 60:g} minutes "
                    f"({str(error).splitlines()[0]}); rerun the command to resume."
                ) from error
            time.sleep(PAUSE_S)
            return True
        self._unreachable_since = 0.0
        return more

    def _step(self) -> bool:
        """Advance all trials and claim new ones; whether there is more to do."""
        for slot, trial in list(self.running.items()):
            if self._advance(trial):
                del self.running[slot]
        self._send_heartbeat()
        free = self.settings.workers - len(self.running)
        due = time.monotonic() - self._last_claim > CLAIM_S
        if free > 0 and due:
            self._claim(free)
        self.view.update(list(self.running.values()))
        if self.running or not due:
            return True
        return not (self._is_over() or self.source.is_exhausted(wait=self.settings.wait))

    def _send_heartbeat(self) -> None:
        now = time.monotonic()
        if now - self._last_heartbeat > HEARTBEAT_S:
            self._last_heartbeat = now
            self.store.send_heartbeat([trial.number for trial in self.running.values()])

    def _claim(self, free: int) -> None:
        """Begin as many trials as there are free slots."""
        executing = {trial.number for trial in self.running.values()}
        for stale in self.store.stale_trials(executing):
            self.store.release(stale.number, "its driver had ended", requeue=self.source.requeues)
        minutes = self.settings.timeout_minutes
        limit = None if minutes is None else 60 * minutes
        while free > 0 and not self._is_over():
            claimed = self.source.next()
            if claimed is None:
                self._last_claim = time.monotonic()
                return
            slot = min(set(range(self.settings.workers)) - set(self.running))
            start = partial(self._start, slot=slot, tags=claimed.plan.point.tags)
            plan, number, report = claimed.plan, claimed.number, claimed.report
            trial = RunningTrial(plan, number, self.runs, start, limit, report)
            self.view.began(trial)
            self.running[slot] = trial
            # A point that was finished elsewhere needs no process: its slot is free at once.
            if self._advance(trial):
                del self.running[slot]
            else:
                free -= 1
            self._send_heartbeat()

    def _is_over(self) -> bool:
        """Whether the budget of this call is spent."""
        most, hours = self.settings.max_failures, self.settings.hours
        spent = hours is not None and time.monotonic() - self._began > 3600 * hours
        failures = self.failures + self.source.rejected
        return spent or (most is not None and failures >= most)

    def _start(
        self, command: Sequence[str], log: Path, *, slot: int, tags: Mapping[str, str]
    ) -> Job:
        environment = {TAGS: json.dumps(dict(tags))}
        if self.settings.gpus:
            gpus = gpus_of(self.settings.gpus[slot % len(self.settings.gpus)])
            environment[GPUS] = ",".join(map(str, gpus))
        return self.executor.start(command, environment, log)

    def _advance(self, trial: RunningTrial) -> bool:
        """Whether the trial has ended; its end is recorded in the study."""
        notes = {names.SECONDS: round(trial.seconds, 1)}
        try:
            results = trial.advance()
            if results is None:
                return False
            scores = mean_scores(results)
            values = [_finite(each.metric, scores) for each in self.settings.objectives]
        except TrialPruned as reason:
            self.store.prune(trial.number, str(reason), notes)
            for run in trial.plan.runs:
                self.runs.mark_stopped(run.key, str(reason))
            self.view.ended(trial, "pruned", str(reason))
        except TrialError as error:
            self._fail(trial, str(error), notes)
        else:
            self.store.complete(trial.number, values, {**notes, names.RESULTS: dict(scores)})
            self.view.ended(trial, "finished", "")
        return True

    def _fail(self, trial: RunningTrial, reason: str, notes: Mapping[str, Any]) -> None:
        """Record a failure; a search retries the same point as often as `retries` allow."""
        key = trial.plan.key
        if self.source.requeues and self._attempts[key] < self.settings.retries:
            self.store.release(trial.number, f"retried: {reason}", requeue=True)
        else:
            self.store.fail(trial.number, reason, notes)
            self.failures += 1
        self._attempts[key] += 1
        self.view.ended(trial, "failed", reason)

    def _release_all(self) -> None:
        """Stop all processes and release their trials; the next call resumes their runs."""
        from optuna.exceptions import StorageInternalError

        trials = self.running.values()
        for trial in trials:
            trial.stop()
        while not all(trial.is_stopped() for trial in trials):
            time.sleep(POLL_S)
        # Without access to the storage they are stale trials, which the next driver releases.
        with suppress(StorageInternalError):
            for trial in trials:
                requeue = self.source.requeues
                self.store.release(trial.number, "its driver was stopped", requeue=requeue)


def drive(
    view: ProgressView,
    source: TrialSource,
    store: TrialStore,
    runs: RunStore,
    settings: SweepSettings,
) -> None:
    """Execute the trials of `source` with the executor of the settings, and show the progress."""
    executor: Executor
    if settings.executor == "local":
        check_gpus(settings.gpus)
        executor = LocalExecutor(settings.workers)
    else:
        from sweeps.worker.submitit_executor import SubmititExecutor

        executor = SubmititExecutor(runs.runs_dir / ".submitit", settings.submitit or {})
    with view:
        Driver(store, source, runs, executor, settings, view).run()


def _finite(name: str, scores: Mapping[str, float]) -> float:
    value = scores.get(name)
    if value is not None and math.isfinite(value):
        return value
    split, _, rest = name.partition("/")
    is_of_pairs = rest.startswith((f"{TC}/", f"{CA}/"))
    measure = f"; rgbt consistency run=... split={split} measures it" if is_of_pairs else ""
    raise TrialError(f"its runs have no {name} that is a number{measure}")
