"""Open an MLflow store: make its database, find its experiment, and limit the time of every call.

`rgbt.tracking.mlflow_upload` sends runs with this client, `rgbt.tracking.mlflow_store` decides
when.
"""

from __future__ import annotations

import logging
import os
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

from rgbt.checks import InputError
from rgbt.files.atomic import holding
from rgbt.files.plain_files import check_links
from rgbt.tracking.mlflow_view import view_tags

TIMEOUT = "MLFLOW_HTTP_REQUEST_TIMEOUT"

# Environment variables set before mlflow is imported, unless the user has set them.
ENVIRONMENT = {
    "DO_NOT_TRACK": "true",
    "MLFLOW_LOGGING_LEVEL": "ERROR",
    # A lost server must delay a training by seconds, not by the minutes of the defaults (7, 120).
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0",
    TIMEOUT: "8",
    "GIT_PYTHON_REFRESH": "quiet",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
}

SQLITE, ARTIFACTS = "sqlite:///", "mlartifacts"
# Seconds until a call to a server ends, one to a database of our own, one with files, and until
# another process must free its lock.
SERVER_S, CALL_S, FILE_S, LOCK_WAIT_S = 9.0, 30.0, 600.0, 50.0

OUTSIDE = "uri: the store keeps files outside its folder, at {}; name it (uri=...) to trust it."

EXPERIMENT_NOTE = """\
One run per configuration and seed. mIoU, Var, IoU1..., class/...: test split, percent (Var:
squared percent points). In profile/iou_by_region the "step" is the region, 1 = innermost ring.
Layouts under *Views*: every run, means over seeds, tables."""


def set_environment() -> None:
    """Keep MLflow quiet, and patient for seconds only."""
    logging.getLogger("alembic").setLevel(logging.ERROR)
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)


class ExperimentClient:
    """MLflow's client for one experiment, both made where they do not exist.

    Every method of MLflow's client can be called; TimeoutError: the store takes too long, also
    where a server sends a byte now and then.

    Args:
        uri: address of the store.
        experiment, artifact_uri: name of the experiment, and where a new one keeps its files.
        files: the folder that files of runs must lie in; None: anywhere.

    Raises:
        InputError: the store keeps files outside of `files`. MLflow raises anything else.
    """

    def __init__(
        self, uri: str, experiment: str, artifact_uri: str | None, files: Path | None
    ) -> None:
        self.files = files
        set_environment()
        if uri.startswith(SQLITE):
            database = Path(uri.removeprefix(SQLITE))
            _create_database(database, artifact_uri)
            if files is not None:
                _take_files_along(database, files)
        from mlflow import MlflowClient  # takes seconds, hence not at the top

        is_patient = uri.startswith(SQLITE) or os.environ[TIMEOUT] != ENVIRONMENT[TIMEOUT]
        self._limit_s = CALL_S if is_patient else SERVER_S
        self._client = _within(self._limit_s, MlflowClient, tracking_uri=uri)
        found = self.get_experiment_by_name(experiment)
        if found is None:
            with suppress(Exception):  # another process may create it at this moment
                self.create_experiment(experiment, artifact_location=artifact_uri)
            found = self.get_experiment_by_name(experiment)
        self.experiment_id: str = found.experiment_id
        for name, value in {"mlflow.note.content": EXPERIMENT_NOTE, **view_tags()}.items():
            if found.tags.get(name) != value:
                self.set_experiment_tag(self.experiment_id, name, value)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        is_file = "artifact" in name or name == "log_image"
        call, limit_s = getattr(self._client, name), FILE_S if is_file else self._limit_s
        return lambda *values, **named: _within(limit_s, call, *values, **named)

    def check_files(self, artifact_uri: str) -> None:
        """Refuse a run whose files would leave the folder of a store that nobody named.

        InputError: `artifact_uri` is outside of `files`, or a link there leads out of it.
        """
        if self.files is None:
            return
        address = urlparse(artifact_uri)
        path = Path(unquote(address.path)).resolve()
        if address.scheme not in ("", "file") or not path.is_relative_to(self.files):
            raise InputError(OUTSIDE.format(artifact_uri))
        check_links(path)


def _within(limit_s: float, call: Callable[..., Any], *values: Any, **named: Any) -> Any:
    """What `call` returns. After `limit_s` seconds it continues in its thread (TimeoutError)."""
    outcome: Future[Any] = Future()

    def work() -> None:
        try:
            outcome.set_result(call(*values, **named))
        except Exception as error:
            outcome.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    return outcome.result(limit_s)


def _create_database(database: Path, artifact_uri: str | None) -> None:
    """Make an SQLite file with its tables under another name, and rename it once it is whole.

    Two processes that make the tables of one file together break it, as does one that is killed.
    """
    if database.exists():
        if not database.is_file():
            raise InputError(f"uri: {database} is not a regular file.")
        return
    database.parent.mkdir(parents=True, exist_ok=True)
    with locked(database.with_name(f".{database.name}.lock")):
        if database.exists():
            return
        for left in database.parent.glob(f".{database.name}.new-*"):
            shutil.rmtree(left, ignore_errors=True)
        scratch = tempfile.mkdtemp(prefix=f".{database.name}.new-", dir=database.parent)
        try:
            from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

            made = Path(scratch, database.name)
            SqlAlchemyStore(f"{SQLITE}{made}", artifact_uri or "./mlruns").engine.dispose()
            made.rename(database)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def _take_files_along(database: Path, files: Path) -> None:
    """Let the store of a folder that was moved or copied name the files that moved with it.

    MLflow notes the absolute address of the files of every run. InputError: one lies elsewhere.
    """
    with closing(sqlite3.connect(database)) as connection, connection:
        for table, column in (("experiments", "artifact_location"), ("runs", "artifact_uri")):
            rows = connection.execute(f"SELECT {column}, rowid FROM {table}").fetchall()
            found = [(_address_in(files / ARTIFACTS, str(uri)), row) for uri, row in rows]
            changed = set(found) - set(rows)
            connection.executemany(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", changed)


def _address_in(own: Path, uri: str) -> str:
    """`uri` if its files are in the folder `own`, or where they moved to in it; else InputError."""
    address = urlparse(uri)
    path = Path(unquote(address.path))
    if ".." not in path.parts and not address.netloc:
        is_local = address.scheme in ("", "file")
        # The latter is of an experiment that somebody made in the pages.
        if (is_local and path.is_relative_to(own)) or address.scheme == "mlflow-artifacts":
            return uri
        _, found, rest = str(path).rpartition(f"/{ARTIFACTS}")
        moved = Path(f"{own}{rest}")
        is_moved = is_local and found and rest[:1] in ("", "/")
        if is_moved and (moved.exists() or not path.exists()):
            return moved.as_uri()
    raise InputError(OUTSIDE.format(uri))


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock; TimeoutError where another process does, because a stopped one never ends."""
    with holding(path, wait_s=LOCK_WAIT_S) as holder:
        if holder is not None:
            raise TimeoutError(f"{holder} has held {path} for {LOCK_WAIT_S:g} s")
        yield
