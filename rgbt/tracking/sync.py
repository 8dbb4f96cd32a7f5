"""Send run folders to MLflow: ``rgbt sync runs_dir=runs`` or ``run=runs/KEY``.

The command can be repeated, because it only sends data that the store does not have. ``uri=``,
``artifact_uri=`` and ``experiment=`` choose another store than that of the run.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rgbt.checks import InputError
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.tracking.mlflow_client import StoreBusyError
from rgbt.tracking.mlflow_server import ui_command
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.mlflow_upload import read_upload_state
from rgbt.tracking.provenance import HIDDEN, without_passwords
from rgbt.tracking.replaced_runs import REPLACED, runs_dir_of
from rgbt.tracking.run_files import read_result
from rgbt.tracking.run_folder import RunFolder, runs_in
from rgbt.tracking.tracker import Status

EXPERIMENT = "rgbt"


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    run: Annotated[Path | None, Help("a single run folder")] = None
    runs_dir: Annotated[
        Path | None, Help("a folder of runs, all of which are sent; use it instead of run")
    ] = None
    uri: Annotated[str | None, Help("address of the store; default: that of the run")] = None
    artifact_uri: Annotated[str | None, Help("address for the files; default: that of the run")] = (
        None
    )
    experiment: Annotated[str | None, Help("experiment of MLflow; default: that of the run")] = None
    log_model: Annotated[
        bool | None,
        Help(
            "true: log the best checkpoint of finished runs as a model for mlflow.pyfunc; default: "
            "as the run was started"
        ),
    ] = None

    def __post_init__(self) -> None:
        if (self.run is None) == (self.runs_dir is None):
            raise InputError("expected either run=<run folder> or runs_dir=<folder of runs>.")


def folders_of(options: Options) -> list[RunFolder]:
    """The run folders that are requested.

    Raises:
        InputError: the folder is missing or is no run folder.
    """
    if options.run is None:
        runs_dir = options.runs_dir or Path()
        replaced = runs_dir / REPLACED
        return [*runs_in(runs_dir), *(runs_in(replaced) if replaced.is_dir() else ())]
    path = options.run
    if not (path / "run.json").exists():
        raise InputError(f"{path} is not a run folder (it has no run.json).")
    return [RunFolder(path)]


def tracking_of(folder: RunFolder, options: Options) -> MlflowTracking:
    """The store of one folder: as requested, else the one it was started with, else the default.

    Raises:
        InputError: the store needs a password, which is not kept in the folder.
    """
    sent = read_upload_state(folder)
    uri = options.uri or (sent.uri if sent else None)
    artifact_uri = None
    if sent is not None and uri is not None:
        same_store = without_passwords(uri) == without_passwords(sent.uri)
        artifact_uri = sent.artifact_uri if same_store else None
    artifact_uri = options.artifact_uri or artifact_uri
    for key, address in (("uri", uri), ("artifact_uri", artifact_uri)):
        if address is not None and HIDDEN in address:
            raise InputError(
                f"{folder.path}: the password of {address} is not stored; give {key}=... with the "
                "password."
            )
    return MlflowTracking(
        uri,
        artifact_uri=artifact_uri,
        experiment=options.experiment or (sent.experiment if sent else EXPERIMENT),
        runs_dir=str(runs_dir_of(folder)),
        log_model=bool(sent and sent.log_model) if options.log_model is None else options.log_model,
    )


def status_of(folder: RunFolder) -> Status:
    """Finished, running (a process holds the folder), or killed."""
    if read_result(folder.path) is not None:
        return "FINISHED"
    return "RUNNING" if folder.is_locked() else "KILLED"


def main(options: Options, overrides: list[str]) -> int:
    """Send run folders to MLflow. A repeated call sends only data that the store does not have."""
    del overrides  # none is heeded
    stores: dict[tuple[str, str, bool], MlflowTracking] = {}
    failed = 0
    busy: dict[str, StoreBusyError] = {}
    # An error in one of many folders must not prevent sending the others.
    raised: tuple[type[InputError], ...] = (InputError,) if options.run else ()
    for folder in folders_of(options):
        try:
            named = tracking_of(folder, options)
            key = (named.uri, named.experiment, named.log_model)
            tracking = stores.setdefault(key, named)
            if named.uri in busy:  # waited for once, not for every run
                raise busy[named.uri]
            run_id = tracking.sync(folder, status_of(folder))
        except raised:
            raise
        except Exception as error:  # A store may fail in any way; the next folder may be sent.
            if isinstance(error, StoreBusyError):
                busy[named.uri] = error
            failed += 1
            reason = without_passwords((str(error).splitlines() or [""])[0]).rstrip(".")
            sys.stderr.write(f"rgbt: {folder.path} was not sent ({reason}).\n")
        else:
            sys.stdout.write(f"{folder.path}  ->  MLflow run {run_id}\n")
    for uri in dict.fromkeys(uri for uri, _, _ in stores):
        if not uri.startswith("http"):
            sys.stdout.write(f"open MLflow  {ui_command(uri)}\n")
    return 1 if failed else 0


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
