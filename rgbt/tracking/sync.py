"""Send run folders to MLflow: ``rgbt sync runs_dir=runs`` or ``run=runs/KEY``.

The command can be repeated, because it only sends data that the store does not have.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rgbt.checks import InputError, without_controls
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.runs.folder import REPLACED, RunFolder, is_finished, runs_dir_of, runs_in
from rgbt.terminal import info
from rgbt.tracking.mlflow_store import EXPERIMENT, MlflowTracking, reason_of
from rgbt.tracking.tracker import Status


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    run: Annotated[Path | None, Help("a single run folder")] = None
    runs_dir: Annotated[Path | None, Help("a folder of runs, all of which are sent")] = None
    uri: Annotated[str | None, Help("store; default: mlflow.db in the folder of runs")] = None
    artifact_uri: Annotated[str | None, Help("address for the files of a new experiment")] = None
    experiment: Annotated[str, Help("experiment of MLflow")] = EXPERIMENT

    def __post_init__(self) -> None:
        if (self.run is None) == (self.runs_dir is None):
            raise InputError("expected either run=<run folder> or runs_dir=<folder of runs>.")


def folders_of(options: Options) -> list[RunFolder]:
    """Return the run folders that are requested; InputError where there is none."""
    if options.run is None:
        runs_dir = options.runs_dir or Path()
        replaced = runs_dir / REPLACED
        return [*runs_in(runs_dir), *(runs_in(replaced) if replaced.is_dir() else ())]
    if not (options.run / "run.json").exists():
        raise InputError(f"{options.run} is not a run folder (it has no run.json).")
    return [RunFolder(options.run)]


def main(options: Options, overrides: list[str]) -> int:
    """Send run folders to MLflow. A repeated call sends only data that the store does not have."""
    del overrides  # none is heeded
    folders = folders_of(options)
    tracking = MlflowTracking(
        options.uri,
        artifact_uri=options.artifact_uri,
        experiment=options.experiment,
        runs_dir=str(options.runs_dir or runs_dir_of(folders[0])),
    )
    failed = 0
    for folder in folders:
        try:
            status: Status = "RUNNING" if folder.is_locked() else "KILLED"
            run_id = tracking.sync(folder, "FINISHED" if is_finished(folder.path) else status)
            sys.stdout.write(without_controls(f"{folder.path}  ->  MLflow run {run_id}\n"))
        except Exception as error:  # A store may fail in any way; the next folder may be sent.
            if options.run and isinstance(error, InputError):
                raise
            failed += 1
            info(f"{folder.path} was not sent ({reason_of(error)}).")
            if isinstance(error, TimeoutError) or not tracking.is_open:
                break  # waited for once, not for every run
    sys.stdout.write(f"open MLflow  {tracking.ui_command()}\n")
    return 1 if failed else 0


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
