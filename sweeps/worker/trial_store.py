"""The trials of one study in Optuna's storage, shared by any number of drivers.

A driver claims a point by adding a running trial with the point's key, and drops it again if a
trial with a lower number has claimed the same key. Every storage assigns trial numbers one by one,
so no lock is needed. A search asks the sampler; only trials that a dead or interrupted driver has
left are enqueued in the study.
"""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweeps import attributes as names

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial, Trial

HEARTBEAT_S = 20.0
"""Seconds between two heartbeats of a driver."""

STALE_S = 180.0
"""A driver on another machine is dead after so many seconds without a heartbeat."""

CLAIMING_STATES = ("RUNNING", "COMPLETE", "PRUNED")
"""States of a trial that keep a later one from claiming the same point."""


@dataclass(frozen=True)
class Owner:
    """The driver of a trial: one process on one machine; written as "host:pid:started".

    Attributes:
        started: when the process began, in ticks since the machine did; distinguishes it from a
            later process with the same number.
    """

    host: str
    pid: int
    started: str

    @classmethod
    def this_process(cls) -> Owner:
        """This process."""
        return cls(os.uname().nodename, os.getpid(), _started(os.getpid()))

    @classmethod
    def parse(cls, text: str) -> Owner:
        """The inverse of `str`."""
        host, pid, started = text.rsplit(":", 2)
        return cls(host, int(pid), started)

    def __str__(self) -> str:
        return f"{self.host}:{self.pid}:{self.started}"

    def is_alive(self, heartbeat: float) -> bool:
        """Whether the driver is still running.

        Args:
            heartbeat: time of its last one, seconds since 1970; all that counts on another machine.
        """
        if self.host == os.uname().nodename:
            return _started(self.pid) == self.started
        return time.time() - heartbeat < STALE_S


def _started(pid: int) -> str:
    """Start of a process according to the kernel; "" if it does not exist or is a zombie."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if after_name[0] in "ZX" else after_name[19]


def counted_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Trials of a study, by number, without those that were dropped."""
    trials = study.get_trials(deepcopy=False)
    return [trial for trial in trials if not trial.user_attrs.get(names.DROPPED)]


def trials_by_key(trials: Iterable[FrozenTrial]) -> dict[str, list[FrozenTrial]]:
    """Trials by the key of their point, earlier ones first."""
    groups: dict[str, list[FrozenTrial]] = {}
    for trial in trials:
        groups.setdefault(trial.user_attrs.get(names.KEY, ""), []).append(trial)
    return groups


class TrialStore:
    """One study and the driver that works on it."""

    def __init__(self, study: optuna.Study, storage: BaseStorage, owner: Owner) -> None:
        self.study = study
        self.owner = owner
        self._storage = storage
        self._study_id = storage.get_study_id_from_name(study.study_name)

    def trials(self) -> list[FrozenTrial]:
        """All trials that count, by number."""
        return counted_trials(self.study)

    def by_key(self) -> dict[str, list[FrozenTrial]]:
        """All trials that count by the key of their point, earlier ones first."""
        return trials_by_key(self.trials())

    def claim(
        self,
        attributes: Mapping[str, Any],
        params: Mapping[str, Any] | None = None,
        distributions: Mapping[str, BaseDistribution] | None = None,
        replaced: Collection[int] = (),
    ) -> int | None:
        """The number of a new running trial of ours; None if an earlier trial has the point.

        Args:
            attributes: user attributes of the trial, among them `attributes.KEY`.
            params: of a grid, by name.
            distributions: of the parameters.
            replaced: numbers of earlier trials of the point that the new one replaces (failed ones,
                and those whose runs were deleted).
        """
        from optuna.trial import TrialState, create_trial

        token = uuid.uuid4().hex
        own = {**attributes, names.TOKEN: token, **self._heartbeat()}
        running = partial(create_trial, state=TrialState.RUNNING, user_attrs=own)
        try:
            self.study.add_trial(
                running(params=dict(params or {}), distributions=dict(distributions or {}))
            )
        except ValueError:
            # A grid that is resumed with other values: a database keeps the first choices of a
            # parameter. The point is run all the same; only figures over parameters lack it.
            self.study.add_trial(running())
        same = self.by_key()[attributes[names.KEY]]
        (number,) = [trial.number for trial in same if trial.user_attrs.get(names.TOKEN) == token]
        earlier = [
            trial.number
            for trial in same
            if trial.number < number
            and trial.number not in replaced
            and trial.state.name in CLAIMING_STATES
        ]
        if not earlier:
            return number
        self.drop(number, f"the same point as trial {earlier[0]}")
        return None

    def ask(self, total: int | None) -> Trial | None:
        """A trial of a search: an enqueued one, or a new one while there are fewer than `total`."""
        if total is not None and len(self.trials()) >= total and not self._waiting():
            return None
        trial = self.study.ask()
        self.set_attributes(trial.number, self._heartbeat())
        if names.KEY in trial.user_attrs:
            # Two drivers may enqueue the trial of a dead one at the same time, and take both up at
            # the same time: the lower number wins. The old trial may not be dropped yet.
            old = trial.user_attrs.get(names.REPLACES)
            others = [
                other.number
                for other in self.by_key()[trial.user_attrs[names.KEY]]
                if other.number not in (trial.number, old)
                and (
                    other.state.name in ("COMPLETE", "PRUNED")
                    or (other.state.name in ("RUNNING", "WAITING") and other.number < trial.number)
                )
            ]
            if others:
                self.drop(trial.number, f"the same point as trial {others[0]}")
            return None if others else trial
        before = [other for other in self.trials() if other.number < trial.number]
        # Two drivers may ask for the last one at the same time: the lower number wins.
        if total is not None and len(before) >= total:
            self.drop(trial.number, f"{total} trials were requested")
            return None
        return trial

    def set_attributes(self, number: int, attributes: Mapping[str, Any]) -> None:
        """Write user attributes of an unfinished trial."""
        trial_id = self._storage.get_trial_id_from_study_id_trial_number(self._study_id, number)
        for name, value in attributes.items():
            self._storage.set_trial_user_attr(trial_id, name, value)

    def send_heartbeat(self, numbers: Iterable[int]) -> None:
        """Record that this driver is still executing these trials."""
        for number in numbers:
            update = partial(self.set_attributes, number, self._heartbeat())
            self.update_unfinished(number, update)

    def complete(self, number: int, values: Sequence[float], notes: Mapping[str, Any]) -> None:
        """Finish a trial with its values; without effect if another driver has finished it."""
        self._finish(number, "COMPLETE", notes, values)

    def fail(self, number: int, reason: str, notes: Mapping[str, Any]) -> None:
        """Finish a trial as failed; see `complete`."""
        self._finish(number, "FAIL", {**notes, names.REASON: reason})

    def prune(self, number: int, reason: str, notes: Mapping[str, Any]) -> None:
        """Finish a trial as pruned; see `complete`."""
        self._finish(number, "PRUNED", {**notes, names.REASON: reason})

    def drop(self, number: int, reason: str) -> None:
        """Finish a trial that does not count; see `complete`."""
        self._finish(number, "FAIL", {names.DROPPED: True, names.REASON: reason})

    def release(self, number: int, reason: str, *, requeue: bool) -> None:
        """Drop a running trial, of this driver or of a dead one.

        Args:
            number: of the trial.
            reason: in a few words.
            requeue: enqueue its parameters in the study; before the trial is dropped, so that a
                crash in between loses nothing.
        """
        trial = self.study.get_trials(deepcopy=False)[number]
        if trial.state.name != "RUNNING":  # another driver was first
            return
        key = trial.user_attrs.get(names.KEY)
        waiting = {other.user_attrs.get(names.KEY) for other in self._waiting()}
        if requeue and key is not None and key not in waiting:
            kept = (names.KEY, names.LABEL, names.OVERRIDES, names.RUNS)
            attributes = {name: trial.user_attrs[name] for name in kept if name in trial.user_attrs}
            attributes[names.REPLACES] = number
            self.study.enqueue_trial(dict(trial.params), user_attrs=attributes)
        self.drop(number, reason)

    def stale_trials(self, executing: Collection[int]) -> Iterator[FrozenTrial]:
        """Running trials whose driver is dead.

        Args:
            executing: numbers of this driver's trials; any other of its trials was lost when the
                storage failed during a claim.
        """
        for trial in self.trials():
            if trial.state.name != "RUNNING" or trial.number in executing:
                continue
            owner = trial.user_attrs.get(names.OWNER)
            if owner is not None:
                alive = Owner.parse(owner).is_alive(trial.user_attrs[names.HEARTBEAT])
            else:  # of a search: just created, or by a driver that died before its first heartbeat
                assert trial.datetime_start is not None, "a running trial was started"
                alive = Owner("?", 0, "").is_alive(trial.datetime_start.timestamp())
            if owner == str(self.owner) or not alive:
                yield trial

    def _heartbeat(self) -> dict[str, Any]:
        return {names.HEARTBEAT: round(time.time(), 1), names.OWNER: str(self.owner)}

    def _waiting(self) -> list[FrozenTrial]:
        return [trial for trial in self.trials() if trial.state.name == "WAITING"]

    def _finish(
        self,
        number: int,
        state: str,
        notes: Mapping[str, Any],
        values: Sequence[float] | None = None,
    ) -> None:
        from optuna.trial import TrialState

        def finish() -> None:
            self.set_attributes(number, notes)
            self.study.tell(number, values, state=TrialState[state])

        self.update_unfinished(number, finish)

    def update_unfinished(self, number: int, update: Callable[[], object]) -> None:
        """Call `update` for a trial; no error if another driver has finished it meanwhile."""
        try:
            update()
        except (RuntimeError, ValueError):  # Optuna: UpdateFinishedTrialError is a RuntimeError
            if not self.study.get_trials(deepcopy=False)[number].state.is_finished():
                raise
