"""The storage of studies: a journal file, SQLite, or PostgreSQL for several machines."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rgbt.checks import InputError, nearest, one_line
from rgbt.runs.provenance import without_passwords
from sweeps import attributes as names
from sweeps.settings import Objective

if TYPE_CHECKING:
    import optuna

Opened = TypeVar("Opened")

JOURNAL = "studies.journal"
NAME = r"[\w\-. :/]+"
"""Pattern of the name of a study or a table: it is part of MLflow tags."""

SCHEMES = ("sqlite", "postgresql", "postgres")
ATTEMPTS = 8
PAUSE_S = 0.7
FIXED = {
    names.METRICS: "other objectives",
    names.KIND: "points of another kind",
    names.SIGNATURE: "another space or other overrides",
}
"""Attributes of a study that must not change, and how messages name a change."""

UNREACHABLE = ("connection refused", "could not translate", "authentication", "does not exist")
"""Words of errors of a connection that no later attempt cures."""


def open_storage(storage: str | None, runs_dir: Path) -> optuna.storages.BaseStorage:
    """Open the storage; create it if it does not exist.

    Args:
        storage: None for the journal file ``<runs_dir>/studies.journal``; a path that ends in
            .journal; or a database: sqlite:///file.db, postgresql://user@host/name (psycopg 3; the
            password belongs in ~/.pgpass).
        runs_dir: the folder of runs.

    Raises:
        InputError: the storage cannot be opened, or a package for it is missing.
    """
    import optuna
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    url = _checked(storage, runs_dir)
    if not url.endswith(".journal"):
        return _retry(lambda: _database(url), url)
    path = Path(url).expanduser().resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        return optuna.storages.JournalStorage(JournalFileBackend(str(path)))
    except (OSError, MemoryError):
        raise
    except Exception as error:  # The border to Optuna, which assumes a whole journal.
        raise InputError(
            f"storage={path} is damaged ({type(error).__name__}: {one_line(error)}); restore it "
            "from a copy, or remove it: finished runs are reused, other trials restart."
        ) from error


def _checked(storage: str | None, runs_dir: Path) -> str:
    """The address of the storage; refused if it has none of the forms, or no folder."""
    url = str(runs_dir / JOURNAL) if storage is None else storage
    scheme = url.partition("://")[0].partition("+")[0]
    if not url.endswith(".journal") and ("://" not in url or scheme not in SCHEMES):
        raise InputError(
            f"storage={without_passwords(url)}: expected a file that ends in .journal, "
            "sqlite:///FILE or postgresql://USER@HOST/NAME."
        )
    if url.startswith("sqlite:///") and not Path(url.removeprefix("sqlite:///")).parent.is_dir():
        raise InputError(f"storage={url}: its folder does not exist; create it first.")
    return url


def storage_file(url: str) -> Path | None:
    """The file of a storage; None for a database server."""
    path = url.removeprefix("sqlite:///")
    return None if "://" in path else Path(path).expanduser()


def _database(url: str, *, create: bool = True) -> optuna.storages.RDBStorage:
    import optuna

    scheme, mark, rest = url.partition("://")
    if scheme in ("postgresql", "postgres"):
        # SQLAlchemy before 2.1 takes a bare postgresql:// for psycopg2, which we do not install.
        url = f"postgresql+psycopg{mark}{rest}"
    # A firewall may cut a connection that is idle while a run trains for hours.
    options = {"pool_pre_ping": True}
    return optuna.storages.RDBStorage(url, engine_kwargs=options, skip_table_creation=not create)


def _retry(opening: Callable[[], Opened], url: str) -> Opened:
    """Retry: of two processes that create the tables of a new database at once, one may fail."""
    import sqlalchemy.exc

    shown = without_passwords(url)
    for attempt in range(ATTEMPTS):
        try:
            return opening()
        except ImportError as error:
            raise InputError(
                f"storage={shown}: {error}; for PostgreSQL install pip install 'rgbt[cluster]'."
            ) from error
        except sqlalchemy.exc.ArgumentError as error:
            raise InputError(f"storage={shown}: {error}.") from error
        except Exception as error:  # Any error of the driver: a later try finds the tables.
            text = str(error).lower()
            is_final = "connection" in text and any(word in text for word in UNREACHABLE)
            if attempt == ATTEMPTS - 1 or is_final:
                reason = str(error).splitlines()[0]
                raise InputError(f"storage={shown} cannot be opened: {reason}") from error
            time.sleep(PAUSE_S * (1 + attempt))
    raise AssertionError("the last attempt returns or raises")


def study_names(storage: optuna.storages.BaseStorage) -> list[str]:
    """Names of all studies of a storage."""
    import optuna

    return sorted(optuna.get_all_study_names(storage))


def open_study(
    name: str,
    storage: optuna.storages.BaseStorage,
    objectives: Sequence[Objective],
    attributes: Mapping[str, Any],
    sampler: optuna.samplers.BaseSampler | None = None,
    pruner: optuna.pruners.BasePruner | None = None,
) -> optuna.Study:
    """The study called `name`, created if it does not exist.

    Args:
        name: of the study.
        storage: its storage.
        objectives: of its trials.
        attributes: of the study; those of `FIXED` must not have changed.
        sampler: of a search.
        pruner: of a search.

    Raises:
        InputError: there is a study of that name with another space or other objectives.
    """
    import optuna

    if not re.fullmatch(NAME, name):
        raise InputError(
            f"study={name}: MLflow allows only letters, digits, spaces and _ - . : / in names."
        )
    study = _retry(
        lambda: optuna.create_study(
            study_name=name,
            storage=storage,
            directions=[objective.direction for objective in objectives],
            sampler=sampler,
            pruner=pruner,
            load_if_exists=True,
        ),
        name,
    )
    metrics = [objective.metric for objective in objectives]
    wanted = {names.METRICS: metrics, **attributes}
    known = study.user_attrs
    for fixed, what in FIXED.items():
        if fixed in known and known[fixed] != wanted.get(fixed):
            raise InputError(
                f"a study '{name}' with {what} already exists; choose another name: "
                "hydra.sweeper.study=..."
            )
    for key, value in wanted.items():
        if known.get(key) != value:
            study.set_user_attr(key, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        study.set_metric_names(metrics)
    return study


def find_study(name: str, storage: str | None, runs_dir: Path) -> optuna.Study | None:
    """The study called `name`; None where it does not exist. Nothing is created.

    Raises:
        InputError: the storage cannot be reached, or its address is of no known form.
    """
    import optuna

    url = _checked(storage, runs_dir)
    file = storage_file(url)
    if file is not None and not file.exists():
        return None
    try:
        is_journal = url.endswith(".journal")
        found = open_storage(storage, runs_dir) if is_journal else _database(url, create=False)
        return load_study(name, found) if name in study_names(found) else None
    except optuna.exceptions.StorageInternalError as error:
        if "connection" in str(error.__cause__).lower():
            raise InputError(
                f"storage={without_passwords(url)} cannot be reached: {error}"
            ) from error
        return None  # a database without Optuna's tables holds no study


def load_study(name: str, storage: optuna.storages.BaseStorage) -> optuna.Study:
    """The study called `name`.

    Raises:
        InputError: there is none; the message lists the existing ones.
    """
    import optuna

    names = study_names(storage)
    if name not in names:
        known = nearest(name, names) if names else "the storage has none"
        raise InputError(f"there is no study '{name}'; {known}.")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return optuna.load_study(study_name=name, storage=storage)
