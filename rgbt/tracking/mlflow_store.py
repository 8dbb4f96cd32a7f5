"""The trackers of a run: MLflow, filled from the run folder, or none.

The run folder is the source of truth. ``rgbt sync`` later sends data that could not be sent during
training.
"""

from __future__ import annotations

import importlib.util
import shlex
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from rgbt.checks import InputError
from rgbt.ranges import Text
from rgbt.tracking.mlflow_client import MlflowStore, locked, open_store, started_monitor
from rgbt.tracking.mlflow_server import pages_of, python_command
from rgbt.tracking.mlflow_upload import (
    UploadState,
    is_up_to_date,
    read_upload_state,
    upload,
    write_upload_state,
)
from rgbt.tracking.mlflow_view import GROUPS_VIEW, RUNS_VIEW, run_path, view_path
from rgbt.tracking.provenance import without_passwords
from rgbt.tracking.run_files import Description
from rgbt.tracking.run_folder import RunFolder
from rgbt.tracking.tracker import Link, Status, Tracking

PAUSE_S = 300.0
"""Seconds that a training waits before it uses a failed store again."""


class NoTracking(Tracking):
    """Writes only the run folder; `rgbt sync` can send it later."""


class MlflowTracking(Tracking):
    """Shows runs in MLflow.

    Args:
        uri: the store: sqlite:///..., postgresql://..., http://...;
            None is ``sqlite:///<runs_dir>/mlflow.db``.
        artifact_uri: where a new experiment keeps its files; None is ``<runs_dir>/mlartifacts`` for
            a database, and the server's own storage for http.
        experiment: its name.
        runs_dir: the folder of all runs.
        log_model: whether the best checkpoint of a finished run is logged as a model.
        system_metrics: whether MLflow measures processor, memory and GPU while a run trains.

    Raises:
        InputError: system metrics without the package that measures them.
    """

    def __init__(
        self,
        uri: Text | None,
        *,
        artifact_uri: Text | None,
        experiment: Text,
        runs_dir: Text,
        log_model: bool = False,
        system_metrics: bool = False,
    ) -> None:
        if system_metrics and importlib.util.find_spec("psutil") is None:
            raise InputError(
                "tracking.system_metrics=true requires the package psutil; install the extra: "
                "pip install 'rgbt[system-metrics]'."
            )
        root = Path(runs_dir).resolve()
        self.uri = f"sqlite:///{root / 'mlflow.db'}" if uri is None else uri
        is_server = self.uri.startswith(("http://", "https://"))
        default_uri = None if is_server else (root / "mlartifacts").as_uri()
        self.artifact_uri = default_uri if artifact_uri is None else artifact_uri
        self.experiment = experiment
        self.log_model = log_model
        self._system_metrics = system_metrics
        self._monitor: Any = None
        self._store: MlflowStore | None = None
        self._folder: RunFolder | None = None
        self._is_connected = False
        self._quiet_until = 0.0
        self._warned = False

    def start(self, folder: RunFolder, description: Description) -> None:
        """Note where the run of `folder` is sent; `after_step` connects.

        MLflow takes seconds to import and to open its database. The first step does not wait for
        it, and a run that fails before contacts the store only in the end.
        """
        self._folder = folder
        folder.describe(description)
        write_upload_state(folder, self._sent(folder))

    def after_step(self) -> None:
        """After the first step, start the MLflow run, or continue its existing run."""
        if not self._is_connected:
            self.update()

    def refresh(self, folder: RunFolder, description: Description) -> None:
        """Send what the store lacks of a finished run; without any, MLflow is not imported.

        What the store has is read from ``mlflow.json``. That it has lost runs since is detected
        only where the file of an SQLite store is missing; `rgbt sync` asks every store.
        """
        self._folder = folder
        folder.describe(description)
        sent = self._sent(folder)
        if self._has_file():
            with suppress(InputError):  # a damaged file of the run: the upload reports it
                if is_up_to_date(folder, sent, "FINISHED"):
                    return
        write_upload_state(folder, sent)
        self.finish("FINISHED")

    def update(self) -> None:
        """Send what is new, unless the store failed a short time ago."""
        self._is_connected = True
        if time.monotonic() >= self._quiet_until:
            self._guarded("RUNNING")

    def finish(self, status: Status) -> None:
        """Send what is new and close the run."""
        if self._monitor is not None:
            self._monitor.finish()  # reports its errors itself
            self._monitor = None
        self._guarded(status)

    def links(self) -> list[Link]:
        """Addresses of this run and of the charts, after the command where no server runs."""
        assert self._folder is not None, "start() comes before links()"
        sent = self._sent(self._folder)
        if not sent.run_id:
            return [("MLflow later", sync_command(self._folder))]
        shown = pages_of(self.uri, sent.run_id)
        pages = [
            ("this run", shown.address + run_path(sent.experiment_id, sent.run_id)),
            ("compare runs", shown.address + view_path(sent.experiment_id, RUNS_VIEW)),
            ("over seeds", shown.address + view_path(sent.experiment_id, GROUPS_VIEW)),
        ]
        return pages if shown.command is None else [("open MLflow", shown.command), *pages]

    def sync(self, folder: RunFolder, status: Status) -> str:
        """Bring this store up to date with `folder`; the id of the MLflow run.

        Unlike the calls of a running training this raises what the store raises.
        """
        store = self.store()
        # A training and a sync by hand may meet in one folder.
        with locked(folder.path / "mlflow.lock"):
            sent = self._sent(folder)
            upload(store, folder, sent, status)
        if status == "RUNNING" and self._system_metrics and self._monitor is None:
            self._monitor = started_monitor(self.uri, sent.run_id)
        return sent.run_id

    def store(self) -> MlflowStore:
        """The open store, made where it does not exist; raises what MLflow raises."""
        if self._store is None:
            self._store = open_store(self.uri, self.artifact_uri, self.experiment)
        return self._store

    def _has_file(self) -> bool:
        """Whether the database file exists; True for servers, which are not contacted."""
        path = self.uri.removeprefix("sqlite:///")
        return path == self.uri or Path(path).is_file()

    def _sent(self, folder: RunFolder) -> UploadState:
        """What this store has of the run; nothing if the folder was sent to another one."""
        uri, artifacts = without_passwords(self.uri), self.artifact_uri
        fresh = UploadState(
            uri,
            self.experiment,
            None if artifacts is None else without_passwords(artifacts),
            log_model=self.log_model,
        )
        try:
            sent = read_upload_state(folder)
        except InputError as error:
            # Repaired by the next write: `upload` finds the run by its key and sends everything.
            sys.stderr.write(f"rgbt: {error}\n")
            return fresh
        # A version that hid less may have stored it: both are compared as they are hidden now.
        same = sent is not None and without_passwords(sent.uri) == uri
        if sent is not None and same and sent.experiment == self.experiment:
            return replace(sent, uri=uri, log_model=self.log_model)
        return fresh

    def _guarded(self, status: Status) -> None:
        """Sync; what the store raises becomes a line on stderr, once."""
        assert self._folder is not None, "start() comes first"
        try:
            self.sync(self._folder, status)
        except InputError as error:
            # A damaged file of the run: the store works, and the run repairs its log on resuming.
            sys.stderr.write(f"rgbt: not sent to MLflow: {error}\n")
        except Exception as error:  # Catches everything: a dead tracker must never stop a training.
            self._quiet_until = time.monotonic() + PAUSE_S
            if self._warned:
                return
            self._warned = True
            reason = (str(error).splitlines() or [""])[0][:120]
            sys.stderr.write(
                f"rgbt: MLflow at {without_passwords(self.uri)} cannot be used "
                f"({type(error).__name__}: {without_passwords(reason)}). The run continues. To "
                f"send it later: `{sync_command(self._folder)}`\n"
            )


def sync_command(folder: RunFolder) -> str:
    """The command that sends a run folder to its store."""
    return f"{python_command()} -m rgbt.tracking.sync {shlex.quote(f'run={folder.path}')}"
