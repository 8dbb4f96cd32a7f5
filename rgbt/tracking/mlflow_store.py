"""The trackers of a run: MLflow, filled from the run folder, or none.

The run folder is the source of truth; ``rgbt sync`` fills what could not be sent. The address of a
store comes from the configuration, never from a run folder.
"""

from __future__ import annotations

import logging
import math
import os
import shlex
import shutil
import sqlite3
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

from rgbt.checks import InputError
from rgbt.files.atomic import holding
from rgbt.files.plain_files import check_links
from rgbt.ranges import Text
from rgbt.runs.folder import Description, RunFolder, read_description, shown_key
from rgbt.runs.provenance import without_passwords
from rgbt.tracking.mlflow_upload import UploadState, is_sent, read_upload_state, upload
from rgbt.tracking.mlflow_view import view_tags
from rgbt.tracking.tracker import Link, Status, Tracking

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
EXPERIMENT = "rgbt"
# Seconds until a call to a server ends, one to a database of our own, one with files, and until
# another process must free its lock.
SERVER_S, CALL_S, FILE_S, LOCK_WAIT_S = 9.0, 30.0, 600.0, 50.0

OUTSIDE = "uri: the store keeps files outside its folder, at {}; name it (uri=...) to trust it."

# Seconds that a training waits before it uses a failed store again, doubled each time; it does not
# use one again that took longer than `SLOW_S` to fail.
PAUSE_S, SLOW_S = 300.0, 3.0

EXPERIMENT_NOTE = """\
One run per configuration and seed. mIoU, Var, region/..., class/...: test split, percent (Var:
squared percent points). In profile/iou_by_region the "step" is the region, 1 = innermost ring.
Layouts under *Views*: every run, means over seeds, tables."""


class StoreBusyError(Exception):
    """Another process holds a lock for too long."""


@dataclass(frozen=True)
class MlflowStore:
    """MLflow's client, the experiment, and the folder that files must lie in, if any."""

    client: Any
    experiment_id: str
    files: Path | None = None

    def check_files(self, artifact_uri: str) -> None:
        """InputError where files of a run would leave the folder of a store that nobody named."""
        address = urlparse(artifact_uri)
        is_local = address.scheme in ("", "file")
        path = Path(unquote(address.path)).resolve()
        if self.files and not (is_local and path.is_relative_to(self.files)):
            raise InputError(OUTSIDE.format(artifact_uri))
        if self.files:
            check_links(path)


class LimitedClient:
    """MLflow's client; a call raises TimeoutError where a server sends a byte now and then."""

    def __init__(self, uri: str) -> None:
        set_environment()
        from mlflow import MlflowClient  # takes seconds, hence not at the top

        is_patient = uri.startswith(SQLITE) or os.environ[TIMEOUT] != ENVIRONMENT[TIMEOUT]
        self._limit_s = CALL_S if is_patient else SERVER_S
        self._client = self._within(self._limit_s, MlflowClient, tracking_uri=uri)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        call, limit_s = getattr(self._client, name), FILE_S if "artifact" in name else self._limit_s
        return lambda *values, **named: self._within(limit_s, call, *values, **named)

    def _within(self, limit_s: float, call: Callable[..., Any], *values: Any, **named: Any) -> Any:
        """What `call` returns. After `limit_s` it continues in its thread."""
        outcome: Future[Any] = Future()

        def work() -> None:
            try:
                outcome.set_result(call(*values, **named))
            except Exception as error:
                outcome.set_exception(error)

        threading.Thread(target=work, daemon=True).start()
        return outcome.result(limit_s)


def set_environment() -> None:
    """Keep MLflow quiet, and patient for seconds only."""
    logging.getLogger("alembic").setLevel(logging.ERROR)
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)


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
            set_environment()
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
    """Hold a lock; StoreBusyError where another process does, because a stopped one never ends."""
    with holding(path, wait_s=LOCK_WAIT_S) as holder:
        if holder is not None:
            raise StoreBusyError(f"{holder} has held {path} for {LOCK_WAIT_S:g} s")
        yield


class NoTracking(Tracking):
    """Writes only the run folder; `rgbt sync` can send it later."""


class MlflowTracking(Tracking):
    """Shows runs in MLflow.

    Args:
        uri, artifact_uri: the store, and where a new experiment keeps its files; None:
            ``mlflow.db`` and ``mlartifacts`` in `runs_dir`, a server's own storage.
        experiment, runs_dir: name of the experiment, and the folder of all runs.
    """

    def __init__(
        self,
        uri: Text | None = None,
        *,
        artifact_uri: Text | None = None,
        experiment: Text = EXPERIMENT,
        runs_dir: Text,
    ) -> None:
        root = Path(runs_dir).resolve()
        self.uri = f"{SQLITE}{root / 'mlflow.db'}" if uri is None else uri
        self._files = root if uri is None and artifact_uri is None else None
        if artifact_uri is None and not self.uri.startswith("http"):
            artifact_uri = (root / ARTIFACTS).as_uri()
        self.artifact_uri, self.experiment = artifact_uri, experiment
        self._shown_uri = without_passwords(self.uri)
        place = f"runs_dir={root}" if uri is None else f"uri={self._shown_uri}"
        self._words = [place, *([f"experiment={experiment}"] if experiment != EXPERIMENT else [])]
        self._store: MlflowStore | None = None
        self._folder: RunFolder
        self._is_connected = self._warned = False
        self._quiet_until, self._pause_s = 0.0, PAUSE_S

    def start(self, folder: RunFolder, description: Description) -> None:
        """Note the folder. MLflow takes seconds to start: the first step does not wait for it."""
        self._folder = folder
        folder.describe(description)

    def after_step(self) -> None:
        """Start or continue the MLflow run after the first step."""
        if not self._is_connected:
            self.update()

    def refresh(self, folder: RunFolder, description: Description) -> None:
        """Send what the store lacks of a finished run; without any, MLflow is not imported."""
        self._folder = folder
        if read_description(folder.path) != description:
            folder.describe(description)
        database = Path(self.uri.removeprefix(SQLITE))
        has_store = database.is_file() or not self.uri.startswith(SQLITE)
        has_name = shown_key(folder) == folder.path.name  # a replaced run gets another one
        is_shown = has_store and has_name and is_sent(folder, self._state(folder))
        if not is_shown:
            self.finish("FINISHED")

    def update(self) -> None:
        """Send what is new, unless the store failed a short time ago."""
        self._is_connected = True
        if time.monotonic() >= self._quiet_until:
            self._guarded("RUNNING")

    def finish(self, status: Status) -> None:
        """Send what is new and close the run."""
        if self._quiet_until < math.inf:
            self._guarded(status)

    def links(self) -> list[Link]:
        """The command that opens the pages, or that sends the run to its store."""
        is_sent = bool(self._state(self._folder).run_id)
        return [("open MLflow", self.ui_command()) if is_sent else ("MLflow later", self._later())]

    def ui_command(self) -> str:
        """The command that opens the pages of this store."""
        return shlex.join(["rgbt", "ui", *self._words])

    def _later(self) -> str:
        named = [word for word in self._words if not word.startswith("runs_dir=")]
        return shlex.join(["rgbt", "sync", f"run={self._folder.path}", *named])

    def sync(self, folder: RunFolder, status: Status) -> str:
        """Bring this store up to date; the id of the MLflow run. Raises what the store raises."""
        store = self.store()
        # A training and a sync by hand may meet in one folder.
        with locked(folder.path / "mlflow.lock"):
            state = self._state(folder)
            upload(store, folder, state, status)
        return state.run_id

    @property
    def is_open(self) -> bool:
        """Whether the store has answered."""
        return self._store is not None

    def store(self) -> MlflowStore:
        """The open store, made where it does not exist; raises what MLflow raises."""
        if self._store is not None:
            return self._store
        if self.uri.startswith(SQLITE):
            database = Path(self.uri.removeprefix(SQLITE))
            _create_database(database, self.artifact_uri)
            if self._files is not None:
                _take_files_along(database, self._files)
        client = LimitedClient(self.uri)
        found = client.get_experiment_by_name(self.experiment)
        if found is None:
            with suppress(Exception):  # another process may create it at this moment
                client.create_experiment(self.experiment, artifact_location=self.artifact_uri)
            found = client.get_experiment_by_name(self.experiment)
        store = MlflowStore(client, found.experiment_id, self._files)
        for name, value in {"mlflow.note.content": EXPERIMENT_NOTE, **view_tags()}.items():
            if found.tags.get(name) != value:
                client.set_experiment_tag(found.experiment_id, name, value)
        self._store = store
        return store

    def _state(self, folder: RunFolder) -> UploadState:
        """What this store has of the run; nothing if the folder was sent to another one.

        Where the folder of runs was moved or copied, all files are sent again, to the same run.
        """
        fresh = UploadState(self._shown_uri, self.experiment)
        try:
            state = read_upload_state(folder) or fresh
        except InputError as error:  # `upload` finds the run by its key and sends everything
            sys.stderr.write(f"rgbt: {error}\n")
            return fresh
        if (state.uri, state.experiment) == (fresh.uri, fresh.experiment):
            return state
        is_own = self._files is not None and state.uri.endswith("/mlflow.db")
        is_moved = is_own and state.experiment == fresh.experiment
        return replace(state, uri=fresh.uri, sent=0.0) if is_moved else fresh

    def _guarded(self, status: Status) -> None:
        """Sync; what the store raises becomes a line on stderr, once."""
        set_environment()
        import mlflow  # noqa: F401 - its seconds are no delay of the store

        began = time.monotonic()
        try:
            self.sync(self._folder, status)
        except InputError as error:  # a damaged file of the run
            sys.stderr.write(f"rgbt: not sent to MLflow: {error}\n")
        except Exception as error:  # Catches everything: a dead tracker must never stop a training.
            now = time.monotonic()
            self._quiet_until = math.inf if now - began > SLOW_S else now + self._pause_s
            self._pause_s *= 2
            if not self._warned:
                sys.stderr.write(
                    f"rgbt: MLflow at {self._shown_uri} cannot be used "
                    f"({reason_of(error)}). The run continues; later: {self._later()}\n"
                )
            self._warned = True


def reason_of(error: Exception) -> str:
    """First line of what was raised, without passwords."""
    line = (str(error).splitlines() or [""])[0][:300]
    name = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
    return f"{name}{without_passwords(line)}"
