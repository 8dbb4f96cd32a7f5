"""Works off points: some at a time, each in a process of its own, failures isolated.

Any number of drivers, on any number of machines, may work on one study. None runs a point that
another one runs, each takes over what a dead one left, and a driver that is started again finds
everything that is finished.
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
from rgbt.spec.naming import TAGS
from sweeps import attributes as names
from sweeps.settings import SweepSettings
from sweeps.worker.executors import Executor, Job
from sweeps.worker.owner import HEARTBEAT_S
from sweeps.worker.progress import ProgressView
from sweeps.worker.run_store import RunStore
from sweeps.worker.running_trial import (
    ExecutionContext,
    RunningTrial,
    TrialError,
    TrialPruned,
    mean_scores,
)
from sweeps.worker.trial_source import ClaimedTrial, TrialSource
from sweeps.worker.trial_store import TrialStore

POLL_S = 0.2
AWAY_S = 600.0
"""How long a storage that cannot be reached is waited for."""

PAUSE_S = 5.0
LOOK_S = 2.0
"""Seconds between two looks at the storage for work that others left or gave up."""


@dataclass
class Driver:
    """One process that works on one study.

    Attributes:
        ledger: the study.
        source: gives the work.
        runs: where finished runs are found.
        executor: makes processes.
        settings: workers, GPUs, budget.
        view: what a person sees.
        metrics: names of the study's objectives.
    """

    store: TrialStore
    source: TrialSource
    runs: RunStore
    executor: Executor
    settings: SweepSettings
    view: ProgressView
    metrics: Sequence[str]
    works: dict[int, RunningTrial] = field(default_factory=dict)
    failures: int = 0
    _began: float = field(default_factory=time.monotonic)
    _looked: float = -math.inf
    _beaten: float = field(default_factory=time.monotonic)
    _away_since: float = 0.0
    _tries: Counter[str] = field(default_factory=Counter)

    def run(self) -> None:
        """Work until nothing is left to do; on Ctrl-C or SIGTERM give back what is not done."""
        try:
            while self._patient_round():
                time.sleep(POLL_S)
        except BaseException:
            self._give_back()
            raise

    def _patient_round(self) -> bool:
        """A round; a storage that cannot be reached is waited for while the runs go on."""
        from optuna.exceptions import StorageInternalError

        try:
            more = self._round()
        except StorageInternalError as error:
            now = time.monotonic()
            self._away_since = self._away_since or now
            if now - self._away_since > AWAY_S:
                raise RunError(
                    f"the storage of the study cannot be reached for {AWAY_S / 60:g} minutes "
                    f"({str(error).splitlines()[0]}); the same command goes on."
                ) from error
            time.sleep(PAUSE_S)
            return True
        self._away_since = 0.0
        return more

    def _round(self) -> bool:
        """Look after everything once; whether there is more to do."""
        for slot, work in list(self.works.items()):
            if self._advance(work):
                del self.works[slot]
        self._beat()
        now = time.monotonic()
        free = self.settings.workers - len(self.works)
        due = now - self._looked > LOOK_S
        if free > 0 and due:
            self._take_up(free)
        self.view.update(list(self.works.values()))
        if self.works or not due:
            return True
        return not (self._is_over() or self.source.is_exhausted(wait=self.settings.wait))

    def _beat(self) -> None:
        """Say now and then that this driver is alive."""
        now = time.monotonic()
        if now - self._beaten > HEARTBEAT_S:
            self._beaten = now
            self.store.beat([work.number for work in self.works.values()])

    def _take_up(self, free: int) -> None:
        """Begin as many points as there are free slots."""
        mine = {work.number for work in self.works.values()}
        for trial in self.store.stale_trials(mine):
            self.store.release(trial.number, "its driver was gone", again=self.source.again)
        while free > 0 and not self._is_over():
            task = self.source.next()
            if task is None:
                self._looked = time.monotonic()
                return
            slot = min(set(range(self.settings.workers)) - set(self.works))
            self.works[slot] = self._begin(task, slot)
            # What is finished elsewhere needs no process and gives the slot back at once.
            if self._advance(self.works[slot]):
                del self.works[slot]
            else:
                free -= 1
            self._beat()

    def _is_over(self) -> bool:
        """Whether the budget of this call is spent."""
        most, hours = self.settings.max_failures, self.settings.hours
        spent = hours is not None and time.monotonic() - self._began > 3600 * hours
        failures = self.failures + self.source.refused
        return spent or (most is not None and failures >= most)

    def _begin(self, task: ClaimedTrial, slot: int) -> RunningTrial:
        start = partial(self._start, slot=slot, tags=task.plan.point.tags)
        minutes = self.settings.timeout_minutes
        context = ExecutionContext(self.runs, start, None if minutes is None else 60 * minutes)
        work = RunningTrial(task.plan, task.number, context, task.report)
        self.view.began(work)
        return work

    def _start(
        self, command: Sequence[str], log: Path, *, slot: int, tags: Mapping[str, str]
    ) -> Job:
        environment = {TAGS: json.dumps(dict(tags))}
        if self.settings.gpus:
            gpu = self.settings.gpus[slot % len(self.settings.gpus)]
            environment |= {"CUDA_VISIBLE_DEVICES": str(gpu)}
        return self.executor.start(command, environment, log)

    def _advance(self, work: RunningTrial) -> bool:
        """Whether the work is done with, well or badly; the study is told."""
        notes = {names.SECONDS: round(work.seconds, 1)}
        try:
            found = work.advance()
            if found is None:
                return False
            scores = mean_scores(found)
            values = [_finite(name, scores) for name in self.metrics]
        except TrialPruned as reason:
            self.store.prune(work.number, str(reason), notes)
            for run in work.plan.runs:
                self.runs.stopped(run.key, str(reason))
            self.view.ended(work, "pruned", str(reason))
        except TrialError as error:
            self._failed(work, str(error), notes)
        else:
            self.store.complete(work.number, values, {**notes, names.RESULTS: dict(scores)})
            self.view.ended(work, "finished", "")
        return True

    def _failed(self, work: RunningTrial, reason: str, notes: Mapping[str, Any]) -> None:
        """Book a failure; a search tries the same point again while `retries` allow."""
        key = work.plan.key
        if self.source.again and self._tries[key] < self.settings.retries:
            self.store.release(work.number, f"tried again: {reason}", again=True)
        else:
            self.store.fail(work.number, reason, notes)
            self.failures += 1
        self._tries[key] += 1
        self.view.ended(work, "failed", reason)

    def _give_back(self) -> None:
        """Stop all processes and give the trials back; their runs continue at the next call."""
        from optuna.exceptions import StorageInternalError

        for work in self.works.values():
            work.stop()
        while not all(work.is_stopped() for work in self.works.values()):
            time.sleep(POLL_S)
        # Where the storage is away they are orphans, which the next driver takes up as well.
        with suppress(StorageInternalError):
            for work in self.works.values():
                self.store.release(work.number, "its driver was stopped", again=self.source.again)


def _finite(name: str, scores: Mapping[str, float]) -> float:
    value = scores.get(name)
    if value is None or not math.isfinite(value):
        split, _, rest = name.partition("/")
        measure = (
            f"; python -m rgbt.consistency run=... split={split} measures it"
            if rest.startswith((f"{TC}/", f"{CA}/"))
            else ""
        )
        raise TrialError(f"its runs have no {name} that is a number{measure}")
    return value
