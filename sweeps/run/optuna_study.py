"""The study of a search in Optuna's storage, which its driver alone opens."""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError
from rgbt.files.atomic import holding
from rgbt.runs.provenance import without_passwords
from rgbt.terminal import info
from sweeps import attributes as names
from sweeps.settings import Objective

if TYPE_CHECKING:
    import optuna
    from optuna.storages import BaseStorage

# Pattern of the name of a study or a table: it is part of MLflow tags.
NAME = r"[\w\-. :/]+"
DATABASE = "optuna.db"


def study_folder(runs_dir: Path, name: str) -> Path:
    """Return the folder of a study: lock, database, report; / etc. in its name are replaced."""
    safe = re.sub(r"[^\w+=.-]+", "_", name).lstrip(".")[:80]
    if safe != name:
        safe += "-" + hashlib.sha256(name.encode()).hexdigest()[:6]
    return runs_dir / "studies" / safe


@contextmanager
def driving(runs_dir: Path, name: str) -> Iterator[bool]:
    """Take the study for this process; yields whether it is free, and prints who drives it."""
    if not re.fullmatch(NAME, name):
        raise InputError(f"study={name}: only letters, digits, spaces and _ - . : / are possible.")
    folder = study_folder(runs_dir, name)
    folder.mkdir(parents=True, exist_ok=True)
    with holding(folder / "lock") as holder:
        if holder is not None:
            info(f"study {name} is driven by {holder}, which shows its progress.")
        yield holder is None


def storage_url(storage: str | None, runs_dir: Path, name: str) -> str:
    """Return the address of a study's storage for SQLAlchemy: by default, a file in its folder."""
    return storage or f"sqlite:///{study_folder(runs_dir, name) / DATABASE}"


def open_storage(url: str) -> BaseStorage:
    """Open a storage, and create it if it does not exist; InputError where it cannot be opened."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    # A firewall may cut a connection that is idle while a run trains for hours.
    options: dict[str, Any] = {"pool_pre_ping": True}
    if url.startswith("sqlite"):  # `rgbt study` may read it meanwhile
        options["connect_args"] = {"timeout": 60.0}
    try:
        return optuna.storages.RDBStorage(url, options)
    except Exception as error:  # any error of the driver of a database
        reason = without_passwords(f"storage={url}: {str(error).splitlines()[0]}")
        raise InputError(reason) from error


def open_study(
    name: str,
    storage: BaseStorage,
    objectives: Sequence[Objective],
    attributes: Mapping[str, Any],
) -> optuna.Study:
    """Open the study called `name`, and create it if it does not exist.

    InputError: there is one with other objectives or another space.
    """
    import optuna

    directions = [objective.direction for objective in objectives]
    study = optuna.create_study(
        study_name=name, storage=storage, directions=directions, load_if_exists=True
    )
    metrics = [objective.metric for objective in objectives]
    wanted, known = {names.METRICS: metrics, **attributes}, study.user_attrs
    for fixed in (names.METRICS, names.SIGNATURE):
        if fixed in known and known[fixed] != wanted.get(fixed):
            what = fixed.removeprefix("rgbt.")
            raise InputError(f"study={name}: one with other {what} exists; choose another name.")
    for key, value in wanted.items():
        if known.get(key) != value:
            study.set_user_attr(key, value)
    study.set_metric_names(metrics)
    return study


def known_studies(storage: str | None, runs_dir: Path) -> dict[str, optuna.Study]:
    """Return the studies of a storage, or of a folder of runs, by name; nothing is created."""
    import optuna

    files = sorted(runs_dir.glob(f"studies/*/{DATABASE}"))
    urls = [storage] if storage else [f"sqlite:///{file}" for file in files]
    found = dict[str, optuna.Study]()
    for url in urls:
        path = url.removeprefix("sqlite:///")
        if "://" in path or Path(path).exists():
            opened = open_storage(url)
            for name in optuna.get_all_study_names(opened):
                found[name] = optuna.load_study(study_name=name, storage=opened)
    return found
