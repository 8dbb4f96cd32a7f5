"""Sends run folders to MLflow: ``python -m rgbt.tracking.sync runs_dir=runs`` or ``run=runs/KEY``.

Safe to repeat: only what a store does not have is sent. ``uri=``, ``artifact_uri=`` and
``experiment=`` choose another store than the one the run was started with.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from rgbt.checks import InputError, nearest
from rgbt.tracking.folder import RunFolder, runs_in
from rgbt.tracking.mlflow_client import StoreBusyError
from rgbt.tracking.mlflow_fill import read_sent
from rgbt.tracking.mlflow_server import ui_command
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.provenance import HIDDEN, without_passwords
from rgbt.tracking.replaced import REPLACED, runs_dir_of
from rgbt.tracking.tracker import Status

KEYS = ("run", "runs_dir", "uri", "artifact_uri", "experiment")
EXPERIMENT = "rgbt"


def parse(arguments: Sequence[str]) -> dict[str, str]:
    """``key=value`` words as a dictionary.

    Raises:
        InputError: a word of another form, an unknown key, both or none of run and runs_dir.
    """
    options: dict[str, str] = {}
    for word in arguments:
        key, equals, value = word.partition("=")
        if not equals or not value:
            raise InputError(f"'{word}': expected key=value; known: {', '.join(KEYS)}.")
        if key not in KEYS:
            raise InputError(f"'{key}' is not a key of this command; {nearest(key, KEYS)}.")
        options[key] = value
    if ("run" in options) == ("runs_dir" in options):
        raise InputError("give either run=<run folder> or runs_dir=<folder of runs>.")
    return options


def folders_of(options: dict[str, str]) -> list[RunFolder]:
    """The run folders that are requested.

    Raises:
        InputError: the folder is missing or is no run folder.
    """
    if "runs_dir" in options:
        replaced = Path(options["runs_dir"]) / REPLACED
        return [*runs_in(options["runs_dir"]), *(runs_in(replaced) if replaced.is_dir() else ())]
    path = Path(options["run"])
    if not (path / "run.json").exists():
        raise InputError(f"{path} is not a run folder (it has no run.json).")
    return [RunFolder(path)]


def tracking_of(folder: RunFolder, options: dict[str, str]) -> MlflowTracking:
    """The store of one folder: as requested, else the one it was started with, else the default.

    Raises:
        InputError: the store needs a password, which is not kept in the folder.
    """
    sent = read_sent(folder)
    uri = options.get("uri", sent.uri if sent else None)
    artifact_uri = None
    if sent is not None and uri is not None:
        same_store = without_passwords(uri) == without_passwords(sent.uri)
        artifact_uri = sent.artifact_uri if same_store else None
    artifact_uri = options.get("artifact_uri", artifact_uri)
    for key, address in (("uri", uri), ("artifact_uri", artifact_uri)):
        if address is not None and HIDDEN in address:
            raise InputError(
                f"{folder.path}: the password of {address} is not kept; give {key}=... with it."
            )
    return MlflowTracking(
        uri,
        artifact_uri=artifact_uri,
        experiment=options.get("experiment", sent.experiment if sent else EXPERIMENT),
        runs_dir=str(runs_dir_of(folder)),
    )


def status_of(folder: RunFolder) -> Status:
    """Finished, running (a process holds the folder), or killed."""
    if folder.result() is not None:
        return "FINISHED"
    return "RUNNING" if folder.is_locked() else "KILLED"


def sync_all(options: dict[str, str]) -> int:
    """Send every folder; 1 if one of them could not be sent.

    Raises:
        InputError: see `folders_of`; of ``run=...`` also `tracking_of`, and a damaged file.
    """
    stores: dict[tuple[str, str], MlflowTracking] = {}
    failed = 0
    busy: dict[str, StoreBusyError] = {}
    # What is wrong with one of many folders must not keep the others from being sent.
    raised: tuple[type[InputError], ...] = (InputError,) if "run" in options else ()
    for folder in folders_of(options):
        try:
            named = tracking_of(folder, options)
            tracking = stores.setdefault((named.uri, named.experiment), named)
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
    for uri, _ in stores:
        if not uri.startswith("http"):
            sys.stdout.write(f"open MLflow  {ui_command(uri)}\n")
    return 1 if failed else 0


def main(arguments: Sequence[str]) -> int:
    """The exit code: 0 sent, 1 a store failed, 2 the input was wrong."""
    try:
        return sync_all(parse(arguments))
    except InputError as error:
        sys.stderr.write(f"rgbt: {error}\n")
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
