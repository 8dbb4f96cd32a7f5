"""Show runs in MLflow, filled from the run folder during training.

The run folder is the source of truth; ``rgbt sync`` fills what could not be sent. The address of a
store comes from the configuration, never from a run folder.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace
from pathlib import Path

from rgbt.checks import InputError
from rgbt.ranges import Text
from rgbt.runs.folder import Description, RunFolder, read_description, shown_key
from rgbt.runs.provenance import without_passwords
from rgbt.terminal import shell_command
from rgbt.tracking.mlflow_client import (
    ARTIFACTS,
    SQLITE,
    ExperimentClient,
    locked,
    set_environment,
)
from rgbt.tracking.mlflow_upload import UploadState, is_sent, read_upload_state, upload
from rgbt.tracking.tracker import Link, Status, Tracking

EXPERIMENT = "rgbt"

# Seconds that a training waits before it uses a failed store again, doubled each time; it does not
# use one again that took longer than `SLOW_S` to fail.
PAUSE_S, SLOW_S = 300.0, 3.0


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
        self._place = [] if artifact_uri is None else [f"artifact_uri={artifact_uri}"]
        if artifact_uri is None and not self.uri.startswith("http"):
            artifact_uri = (root / ARTIFACTS).as_uri()
        self.artifact_uri, self.experiment = artifact_uri, experiment
        self._shown_uri = without_passwords(self.uri)
        place = f"runs_dir={root}" if uri is None else f"uri={self._shown_uri}"
        self._words = [place, *([f"experiment={experiment}"] if experiment != EXPERIMENT else [])]
        self._store: ExperimentClient | None = None
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
        """Return the command that opens the pages, or that sends the run to its store."""
        is_sent = bool(self._state(self._folder).run_id)
        return [("open MLflow", self.ui_command()) if is_sent else ("MLflow later", self._later())]

    def ui_command(self) -> str:
        """Return the command that opens the pages of this store."""
        return shell_command("ui", *self._words)

    def _later(self) -> str:
        named = [word for word in self._words if not word.startswith("runs_dir=")]
        place = map(without_passwords, self._place)  # that of a new experiment never changes
        return shell_command("sync", f"run={self._folder.path}", *named, *place)

    def sync(self, folder: RunFolder, status: Status) -> str:
        """Bring this store up to date; return the id of the MLflow run. Raises what it raises."""
        store = self.store()
        # A training and a sync by hand may meet in one folder.
        with locked(folder.path / "mlflow.lock"):
            state = self._state(folder)
            upload(store, folder, state, status)
        return state.run_id

    @property
    def is_open(self) -> bool:
        """Return whether the store has answered."""
        return self._store is not None

    def store(self) -> ExperimentClient:
        """Open the store, made where it does not exist; raises what MLflow raises."""
        if self._store is None:
            self._store = ExperimentClient(
                self.uri, self.experiment, self.artifact_uri, self._files
            )
        return self._store

    def _state(self, folder: RunFolder) -> UploadState:
        """Return what this store has of the run; nothing if the folder was sent to another one.

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
    """Return the first line of what was raised, without passwords."""
    line = (str(error).splitlines() or [""])[0][:300]
    name = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
    return f"{name}{without_passwords(line)}"
