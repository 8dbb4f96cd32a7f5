"""The trials of one study in Optuna's storage, shared by any number of drivers.

Who works on what is decided by the order of trial numbers, which every storage gives out one by
one: a driver claims a point by adding a running trial with the point's key, and keeps it unless an
earlier trial stands for the same key. Nothing needs a lock, and a driver takes up no other points
than its own, whatever else is in the study. A search asks the sampler; only the trials that a dead
or interrupted driver left of it wait in Optuna's queue.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from sweeps import attributes as names
from sweeps.worker.owner import Owner

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial, Trial

CLAIMING_STATES = ("RUNNING", "COMPLETE", "PRUNED")
"""States of a trial that keep a later one from standing for the same point."""


@dataclass(frozen=True)
class TrialClaim:
    """What a driver claims.

    Attributes:
        key: of the point.
        attributes: noted with the trial.
        params: of a grid, by name.
        distributions: of the parameters.
        past: numbers of finished trials of the point that do not stand any more (failed ones, and
            those whose runs were deleted).
    """

    key: str
    attributes: Mapping[str, Any]
    params: Mapping[str, Any] = field(default_factory=dict)
    distributions: Mapping[str, BaseDistribution] = field(default_factory=dict)
    past: Collection[int] = ()


def counted(study: optuna.Study) -> list[FrozenTrial]:
    """Trials of a study that count, by number."""
    every = study.get_trials(deepcopy=False)
    return [trial for trial in every if not trial.user_attrs.get(names.DROPPED)]


def by_key(trials: Iterable[FrozenTrial]) -> dict[str, list[FrozenTrial]]:
    """Trials by the key of their point, earlier ones first."""
    found: dict[str, list[FrozenTrial]] = {}
    for trial in trials:
        found.setdefault(trial.user_attrs.get(names.KEY, ""), []).append(trial)
    return found


class TrialStore:
    """One study.

    Args:
        study: the study.
        storage: where it is kept.
        me: the driver.
    """

    def __init__(self, study: optuna.Study, storage: BaseStorage, me: Owner) -> None:
        self.study = study
        self.me = me
        self._storage = storage
        self._study_id = storage.get_study_id_from_name(study.study_name)

    def trials(self) -> list[FrozenTrial]:
        """All trials that count, by number."""
        return counted(self.study)

    def by_key(self) -> dict[str, list[FrozenTrial]]:
        """See the function `by_key`."""
        return by_key(self.trials())

    def claim(self, wanted: TrialClaim) -> int | None:
        """The number of a new running trial of ours; None if an earlier trial stands."""
        from optuna.trial import TrialState, create_trial

        token = uuid.uuid4().hex
        attributes = {
            **wanted.attributes,
            names.KEY: wanted.key,
            names.TOKEN: token,
            **self._sign(),
        }
        params, asked = dict(wanted.params), dict(wanted.distributions)
        running = partial(create_trial, state=TrialState.RUNNING, user_attrs=attributes)
        try:
            self.study.add_trial(running(params=params, distributions=asked))
        except ValueError:
            # A grid that is gone on with by other values: a database keeps to the first choices of
            # a parameter. The point is run all the same; only figures over parameters lack it.
            self.study.add_trial(running())
        same = self.by_key()[wanted.key]
        (number,) = [trial.number for trial in same if trial.user_attrs.get(names.TOKEN) == token]
        standing = [
            trial.number
            for trial in same
            if trial.number < number
            and trial.number not in wanted.past
            and trial.state.name in CLAIMING_STATES
        ]
        if not standing:
            return number
        self.drop(number, f"the same point as trial {standing[0]}")
        return None

    def ask(self, total: int | None) -> Trial | None:
        """A trial of a search: one that waits, or a new one while there are less than `total`."""
        if total is not None and len(self.trials()) >= total and not self._waiting():
            return None
        trial = self.study.ask()
        self.note(trial.number, self._sign())
        if names.KEY in trial.user_attrs:
            return trial if self._stands_alone(trial) else None
        before = [other for other in self.trials() if other.number < trial.number]
        # Two drivers may have asked for the last one at the same time: the lower number has it.
        if total is not None and len(before) >= total:
            self.drop(trial.number, f"{total} trials were asked for")
            return None
        return trial

    def _stands_alone(self, trial: Trial) -> bool:
        """Whether a trial from the queue is the only one of its point; it is dropped if not.

        Two drivers may have put what a dead one left into the queue at the same time.
        """
        same = self.by_key()[trial.user_attrs[names.KEY]]
        others = [
            other.number
            for other in same
            if other.number != trial.number
            and (
                other.state.name in CLAIMING_STATES
                or (other.state.name == "WAITING" and other.number < trial.number)
            )
        ]
        if others:
            self.drop(trial.number, f"the same point as trial {others[0]}")
        return not others

    def note(self, number: int, attributes: Mapping[str, Any]) -> None:
        """Write attributes of a trial that is not finished."""
        trial_id = self._storage.get_trial_id_from_study_id_trial_number(self._study_id, number)
        for name, value in attributes.items():
            self._storage.set_trial_user_attr(trial_id, name, value)

    def beat(self, numbers: Iterable[int]) -> None:
        """Say that this driver still works on these trials."""
        for number in numbers:
            self.update_unfinished(number, partial(self.note, number, self._sign()))

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
        """Finish a trial that shall not count; see `complete`."""
        self._finish(number, "FAIL", {names.DROPPED: True, names.REASON: reason})

    def release(self, number: int, reason: str, *, again: bool) -> None:
        """Give up a running trial, of ours or of a dead driver, so that it counts no more.

        Args:
            number: of the trial.
            reason: in a few words.
            again: put its parameters into the queue of a search; before the trial is dropped, so
                that a crash in between loses nothing.
        """
        trial = self.study.get_trials(deepcopy=False)[number]
        if trial.state.name != "RUNNING":  # another driver was first
            return
        key = trial.user_attrs.get(names.KEY)
        waiting = {other.user_attrs.get(names.KEY) for other in self._waiting()}
        if again and key is not None and key not in waiting:
            kept = (names.KEY, names.LABEL, names.OVERRIDES, names.RUNS)
            attributes = {name: trial.user_attrs[name] for name in kept if name in trial.user_attrs}
            self.study.enqueue_trial(dict(trial.params), user_attrs=attributes)
        self.drop(number, reason)

    def stale_trials(self, mine: Collection[int]) -> Iterator[FrozenTrial]:
        """Running trials whose driver is gone.

        Args:
            mine: numbers that this driver works on; any other of its own was lost, when the storage
                failed in the middle of a claim.
        """
        for trial in self.trials():
            if trial.state.name != "RUNNING" or trial.number in mine:
                continue
            owner = trial.user_attrs.get(names.OWNER)
            if owner == str(self.me):
                yield trial
                continue
            if owner is not None:
                alive = Owner.parse(owner).is_alive(trial.user_attrs[names.HEARTBEAT])
            else:  # of a search: asked for this moment, or by a driver that died between two lines
                assert trial.datetime_start is not None, "a running trial was started"
                alive = Owner.unknown().is_alive(trial.datetime_start.timestamp())
            if not alive:
                yield trial

    def _sign(self) -> dict[str, Any]:
        return {names.HEARTBEAT: round(time.time(), 1), names.OWNER: str(self.me)}

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
            self.note(number, notes)
            told = None if values is None else list(values)
            self.study.tell(number, told, state=TrialState[state])

        self.update_unfinished(number, finish)

    def update_unfinished(self, number: int, work: Callable[[], object]) -> None:
        """`work` on a trial, unless another driver has finished it while this machine slept."""
        try:
            work()
        except (RuntimeError, ValueError):  # Optuna: UpdateFinishedTrialError is a RuntimeError
            if not self.study.get_trials(deepcopy=False)[number].state.is_finished():
                raise
