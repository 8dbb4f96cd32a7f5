"""The storage of studies: SQLite, or PostgreSQL for several machines."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rgbt.checks import InputError, nearest
from rgbt.runs.provenance import without_passwords
from sweeps import attributes as names
from sweeps.settings import Objective

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

Opened = TypeVar("Opened")

NAME = r"[\w\-. :/]+"
"""Pattern of the name of a study or a table: it is part of MLflow tags."""

HEARTBEAT_S, STALE_S = 20, 120
"""Seconds between two heartbeats of a trial, and without one until it is lost."""

ATTEMPTS, PAUSE_S = 8, 0.7
FINAL = ("refused", "could not translate", "authentication", "unable to open", "parse", "plugin")
"""Words of errors that no later attempt cures."""


def storage_url(storage: str | None, runs_dir: Path) -> str:
    """The address of a storage for SQLAlchemy; "" and None: the file in the folder of runs."""
    url = storage or f"sqlite:///{runs_dir / 'studies.db'}"
    # SQLAlchemy before 2.1 takes a bare postgresql:// for psycopg2, which we do not install.
    return re.sub(r"^postgres(ql)?://", "postgresql+psycopg://", url)


def storage_file(url: str) -> Path | None:
    """The file of a storage; None for a database server."""
    path = url.removeprefix("sqlite:///")
    return None if "://" in path else Path(path)


def open_storage(storage: str | None, runs_dir: Path) -> optuna.storages.RDBStorage:
    """Open a storage, and create it if it does not exist.

    `storage` is None for the file ``<runs_dir>/studies.db``, or sqlite:///FILE, or
    postgresql://USER@HOST/NAME (psycopg 3; the password belongs in ~/.pgpass).
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    warnings.filterwarnings("ignore", message="Heartbeat of storage")  # for optimize(), it says
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
    for attempt in range(ATTEMPTS):
        try:
            return opening()
        except Exception as error:  # Any error of the driver: a later try finds the tables.
            is_final = isinstance(error, ImportError) or any(w in str(error).lower() for w in FINAL)
            if is_final or attempt == ATTEMPTS - 1:
                reason = without_passwords(f"{what}: {str(error).splitlines()[0]}")
                raise InputError(reason) from error
            time.sleep(PAUSE_S * (1 + attempt))
    raise AssertionError("the last attempt returns or raises")


def open_study(
    name: str,
    storage: optuna.storages.BaseStorage,
    objectives: Sequence[Objective],
    attributes: Mapping[str, Any],
    sampler: optuna.samplers.BaseSampler | None = None,
    pruner: optuna.pruners.BasePruner | None = None,
) -> optuna.Study:
    """The study called `name`, created if it does not exist.

    InputError: there is one with other objectives, points of another kind or another space.
    """
    import optuna

    if not re.fullmatch(NAME, name):
        raise InputError(f"study={name}: only letters, digits, spaces and _ - . : / are possible.")
    study = _retry(
        lambda: optuna.create_study(
            study_name=name,
            storage=storage,
            directions=[objective.direction for objective in objectives],
            sampler=sampler,
            pruner=pruner,
            load_if_exists=True,
        ),
        f"study={name}",
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


def find_study(name: str, storage: str | None, runs_dir: Path) -> optuna.Study | None:
    """The study called `name`; None where it does not exist."""
    file = storage_file(storage_url(storage, runs_dir))
    if file is not None and not file.exists():
        return None
    found = open_storage(storage, runs_dir)
    is_known = name in {study.study_name for study in found.get_all_studies()}
    return load_study(name, found) if is_known else None


def load_study(name: str, storage: optuna.storages.BaseStorage) -> optuna.Study:
    """The study called `name`; InputError, which names the nearest one, if there is none."""
    import optuna

    known = [study.study_name for study in storage.get_all_studies()]
    if name not in known:
        raise InputError(f"name={name}: there is no such study; {nearest(name, known)}.")
    return optuna.load_study(study_name=name, storage=storage)
