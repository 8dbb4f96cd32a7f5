"""The trials of one study in Optuna's storage, shared by any number of drivers.

A driver claims a point of a list by adding a running trial with the point's key, and drops it again
if a trial with a lower number has the same key. A search asks the sampler. A trial without a
heartbeat is failed by Optuna: the point of a list is free again, that of a search is enqueued.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sweeps import attributes as names
from sweeps.worker.storage import enqueue_again

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial, Trial


def counted_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Trials of a study, by number, without those that were lost, released or duplicates."""
    trials = study.get_trials(deepcopy=False)
    return [t for t in trials if t.state.name != "FAIL" or names.REASON in t.user_attrs]


def trials_by_key(trials: Iterable[FrozenTrial]) -> dict[str, list[FrozenTrial]]:
    """Trials by the key of their point, earlier ones first."""
    groups: dict[str, list[FrozenTrial]] = {}
    for trial in trials:
        groups.setdefault(trial.user_attrs.get(names.KEY, ""), []).append(trial)
    return groups


class TrialStore:
    """One study and the driver that works on it."""

    def __init__(self, study: optuna.Study, storage: optuna.storages.RDBStorage) -> None:
        self.study = study
        self._storage = storage
        self._study_id = storage.get_study_id_from_name(study.study_name)
        self._begun: set[int] = set()

    def trials(self) -> list[FrozenTrial]:
        """All trials that count, by number."""
        return counted_trials(self.study)

    def by_key(self) -> dict[str, list[FrozenTrial]]:
        """All trials that count, by key."""
        return trials_by_key(self.trials())

    def claim(
        self,
        attributes: Mapping[str, Any],
        params: Mapping[str, Any] | None = None,
        distributions: Mapping[str, BaseDistribution] | None = None,
        replaced: Collection[int] = (),
    ) -> int | None:
        """The number of a new running trial of ours; None if an earlier trial has the point.

        `replaced` are numbers of earlier trials that do not count: of failed or deleted runs.
        """
        from optuna.trial import TrialState, create_trial

        first = dict(attributes)
        label = {names.LABEL: first.pop(names.LABEL)}  # after the heartbeat, see `fail_stale`

        def add(**grid: Any) -> int:
            trial = create_trial(state=TrialState.RUNNING, user_attrs=first, **grid)
            return self._storage.create_new_trial(self._study_id, trial)

        try:
            trial_id = add(params=dict(params or {}), distributions=dict(distributions or {}))
        except ValueError:
            # A grid that is resumed with other values: a database keeps the first choices of a
            # parameter. The point is run all the same; only figures over parameters lack it.
            trial_id = add()
        self._storage.record_heartbeat(trial_id)
        number = self._storage.get_trial(trial_id).number
        self.update_unfinished(number, lambda: self.set_attributes(number, label))
        for other in self.by_key()[attributes[names.KEY]]:
            is_earlier = other.number < number and other.number not in replaced
            if is_earlier and other.state.name in ("RUNNING", "COMPLETE", "PRUNED"):
                self._finish(number, "FAIL", {})
                return None
        return number

    def ask(self, total: int | None, space: Mapping[str, Any] | None = None) -> Trial | None:
        """A trial of a search, with parameters of `space`.

        It is an enqueued one, or a new one while there are fewer than `total`.
        """
        from optuna.storages import RetryHeartbeatStaleTrialCallback

        trials = self.trials()
        is_waiting = any(trial.state.name == "WAITING" for trial in trials)
        if total is not None and len(trials) >= total and not is_waiting:
            return None
        trial = self.study.ask(dict(space or {}))
        self._storage.record_heartbeat(trial._trial_id)
        before = [other for other in self.trials() if other.number < trial.number]
        # Two drivers may ask for the last one at the same time: the lower number wins.
        is_surplus = total is not None and len(before) >= total
        if names.KEY in trial.user_attrs:
            # Two drivers may enqueue the same lost trial, and take both up: the same.
            frozen = self._storage.get_trial(trial._trial_id)
            replaced = RetryHeartbeatStaleTrialCallback.retry_history(frozen)
            is_surplus = any(
                other.number not in replaced
                and (other.state.is_finished() or other.number < trial.number)
                for other in self.by_key()[trial.user_attrs[names.KEY]]
                if other.number != trial.number
            )
        if is_surplus:
            self._finish(trial.number, "FAIL", {})
        return None if is_surplus else trial

    def set_attributes(self, number: int, attributes: Mapping[str, Any]) -> None:
        """Write user attributes of an unfinished trial."""
        for name, value in attributes.items():
            self._storage.set_trial_user_attr(self._id(number), name, value)

    def send_heartbeats(self, numbers: Iterable[int]) -> None:
        """Record that this driver is still executing these trials."""
        for number in numbers:
            self._storage.record_heartbeat(self._id(number))

    def fail_stale(self) -> None:
        """Fail the trials of lost drivers; `enqueue_again` is called for each.

        Optuna never fails a trial without any heartbeat, whose driver was killed just after it had
        made the trial: it gets one from us, once, and is stale later unless its driver lives.
        """
        from optuna.storages import fail_stale_trials

        for trial in self.trials():
            is_begun = names.LABEL in trial.user_attrs or trial.number in self._begun
            if trial.state.name == "RUNNING" and not is_begun:
                self._begun.add(trial.number)
                self._storage.record_heartbeat(trial._trial_id)
        fail_stale_trials(self.study)

    def complete(self, number: int, values: Sequence[float], notes: Mapping[str, Any]) -> None:
        """Finish a trial with its values; without effect if another driver has finished it."""
        self._finish(number, "COMPLETE", notes, values)

    def fail(self, number: int, reason: str, notes: Mapping[str, Any], state: str = "FAIL") -> None:
        """Finish a trial as failed or pruned; see `complete`."""
        self._finish(number, state, {**notes, names.REASON: reason})

    def release(self, number: int) -> None:
        """Give up a running trial, which does not count; of a search, its point is enqueued."""
        trial = self._storage.get_trial(self._id(number))
        if trial.state.name == "RUNNING":
            enqueue_again(self.study, trial)  # first, so that a crash in between loses nothing
            self._finish(number, "FAIL", {})

    def _id(self, number: int) -> int:
        return self._storage.get_trial_id_from_study_id_trial_number(self._study_id, number)

    def _finish(
        self, number: int, state: str, notes: Mapping[str, Any], values: Any = None
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
            if not self._storage.get_trial(self._id(number)).state.is_finished():
                raise
