"""Studies in Optuna's storage, shared by any number of drivers: SQLite, or PostgreSQL for several
machines.

A driver claims a point of a list by adding a running trial with the point's key, and drops it again
if a trial with a lower number has the same key. A search asks the sampler. A trial without a
heartbeat is failed by Optuna: the point of a list is free again, that of a search is enqueued.
"""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rgbt.checks import InputError
from rgbt.runs.provenance import without_passwords
from sweeps import attributes as names
from sweeps.settings import Objective

if TYPE_CHECKING:
    import optuna
    from optuna.storages import BaseStorage, RDBStorage
    from optuna.trial import FrozenTrial, Trial

Opened = TypeVar("Opened")

# Pattern of the name of a study or a table: it is part of MLflow tags.
NAME = r"[\w\-. :/]+"

# Seconds between two heartbeats of a trial, and without one until it is lost.
HEARTBEAT_S, STALE_S = 20, 120

ATTEMPTS, PAUSE_S = 5, 0.7


def storage_url(storage: str | None, runs_dir: Path) -> str:
    """The address of a storage for SQLAlchemy; "" and None: the file in the folder of runs."""
    url = storage or f"sqlite:///{runs_dir / 'studies.db'}"
    # SQLAlchemy before 2.1 takes a bare postgresql:// for psycopg2, which we do not install.
    return re.sub(r"^postgres(ql)?://", "postgresql+psycopg://", url)


def open_storage(storage: str | None, runs_dir: Path) -> RDBStorage:
    """Open a storage, and create it if it does not exist.

    `storage` is None for the file ``<runs_dir>/studies.db``, or sqlite:///FILE, or
    postgresql://USER@HOST/NAME (psycopg 3; the password belongs in ~/.pgpass).
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    warnings.filterwarnings("ignore", message="Heartbeat of storage")  # it is about optimize()
    url = storage_url(storage, runs_dir)
    if not storage:
        runs_dir.mkdir(parents=True, exist_ok=True)
    # A firewall may cut a connection that is idle while a run trains for hours.
    options: dict[str, Any] = {"pool_pre_ping": True}
    if url.startswith("sqlite"):
        options["connect_args"] = {"timeout": 60.0}
    return _retry(
        lambda: optuna.storages.RDBStorage(
            url,
            options,
            heartbeat_interval=HEARTBEAT_S,
            grace_period=STALE_S,
            heartbeat_stale_trial_callback=enqueue_again,
        ),
        f"storage={url}",
    )


def enqueue_again(study: optuna.Study, trial: FrozenTrial) -> None:
    """Enqueue a lost trial of a search whose point was noted; a list claims the point itself."""
    from optuna.storages import RetryHeartbeatStaleTrialCallback

    is_search = study.user_attrs.get(names.KIND) == "search"
    if is_search and names.LABEL in trial.user_attrs and names.REASON not in trial.user_attrs:
        RetryHeartbeatStaleTrialCallback()(study, trial)


def _retry(opening: Callable[[], Opened], what: str) -> Opened:
    """Retry: of two processes that create the tables of a new database at once, one may fail."""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            return opening()
        except Exception as error:  # Any error of the driver: a later try finds the tables.
            if attempt == ATTEMPTS:
                reason = without_passwords(f"{what}: {str(error).splitlines()[0]}")
                raise InputError(reason) from error
            time.sleep(PAUSE_S * attempt)
    raise AssertionError("the last attempt returns or raises")


def open_study(
    name: str,
    storage: BaseStorage,
    objectives: Sequence[Objective],
    attributes: Mapping[str, Any],
    **samplers: Any,
) -> optuna.Study:
    """The study called `name`, created if it does not exist; with `sampler` and `pruner`.

    InputError: there is one with other objectives, points of another kind or another space.
    """
    import optuna

    if not re.fullmatch(NAME, name):
        raise InputError(f"study={name}: only letters, digits, spaces and _ - . : / are possible.")
    directions = [objective.direction for objective in objectives]
    made: dict[str, Any] = {"study_name": name, "storage": storage, "directions": directions}
    study = _retry(
        lambda: optuna.create_study(**made, **samplers, load_if_exists=True), f"study={name}"
    )
    metrics = [objective.metric for objective in objectives]
    wanted, known = {names.METRICS: metrics, **attributes}, study.user_attrs
    for fixed in (names.METRICS, names.KIND, names.SIGNATURE):
        if fixed in known and known[fixed] != wanted.get(fixed):
            what = fixed.removeprefix("rgbt.")
            raise InputError(f"study={name}: one with other {what} exists; choose another name.")
    for key, value in wanted.items():
        if known.get(key) != value:
            study.set_user_attr(key, value)
    study.set_metric_names(metrics)
    return study


def known_studies(storage: str | None, runs_dir: Path) -> dict[str, optuna.Study]:
    """The studies of a storage by name; none where it does not exist, and nothing is created."""
    import optuna

    path = storage_url(storage, runs_dir).removeprefix("sqlite:///")
    if "://" not in path and not Path(path).exists():
        return {}
    opened = open_storage(storage, runs_dir)
    found = [study.study_name for study in opened.get_all_studies()]
    return {name: optuna.load_study(study_name=name, storage=opened) for name in found}


def counted_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Trials of a study, by number, without those that were lost, released or duplicates."""
    trials = study.get_trials(deepcopy=False)
    return [t for t in trials if t.state.name != "FAIL" or names.REASON in t.user_attrs]


def trials_by_key(study: optuna.Study | None) -> dict[str, list[FrozenTrial]]:
    """Trials that count by the key of their point, earlier ones first."""
    groups: dict[str, list[FrozenTrial]] = {}
    for trial in counted_trials(study) if study else ():
        groups.setdefault(trial.user_attrs.get(names.KEY, ""), []).append(trial)
    return groups


class TrialStore:
    """One study and the driver that works on it."""

    def __init__(self, study: optuna.Study, storage: RDBStorage) -> None:
        self.study = study
        self._storage = storage
        self._study_id = storage.get_study_id_from_name(study.study_name)
        self._begun: set[int] = set()

    def trials(self) -> list[FrozenTrial]:
        """All trials that count, by number."""
        return counted_trials(self.study)

    def claim(self, attributes: Mapping[str, Any], replaced: Collection[int] = ()) -> int | None:
        """The number of a new running trial of ours; None if an earlier trial has the point.

        `replaced` are numbers of earlier trials that do not count: of failed or deleted runs.
        """
        from optuna.trial import TrialState, create_trial

        first = dict(attributes)
        label = {names.LABEL: first.pop(names.LABEL)}  # after the heartbeat, see `fail_stale`

        trial = create_trial(state=TrialState.RUNNING, user_attrs=first)
        trial_id = self._storage.create_new_trial(self._study_id, trial)
        self._storage.record_heartbeat(trial_id)
        number = self._storage.get_trial(trial_id).number
        self.update_unfinished(number, label)
        for other in trials_by_key(self.study)[attributes[names.KEY]]:
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
                for other in trials_by_key(self.study)[trial.user_attrs[names.KEY]]
                if other.number != trial.number
            )
        if is_surplus:
            self._finish(trial.number, "FAIL", {})
        return None if is_surplus else trial

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

    def update_unfinished(
        self, number: int, attributes: Mapping[str, Any], then: Callable[[], object] | None = None
    ) -> None:
        """Write user attributes, and do more; no error if another driver has finished the trial."""
        try:
            for name, value in attributes.items():
                self._storage.set_trial_user_attr(self._id(number), name, value)
            if then is not None:
                then()
        except (RuntimeError, ValueError):  # Optuna: UpdateFinishedTrialError is a RuntimeError
            if not self._storage.get_trial(self._id(number)).state.is_finished():
                raise

    def _id(self, number: int) -> int:
        return self._storage.get_trial_id_from_study_id_trial_number(self._study_id, number)

    def _finish(
        self, number: int, state: str, notes: Mapping[str, Any], values: Any = None
    ) -> None:
        from optuna.trial import TrialState

        end = TrialState[state]
        self.update_unfinished(number, notes, lambda: self.study.tell(number, values, state=end))
