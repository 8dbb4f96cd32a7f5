"""Open MLflow's pages: ``rgbt ui``, or ``rgbt ui runs_dir=runs``, ``uri=...``, ``port=5000``.

The address opens the saved view of all runs (`rgbt.tracking.mlflow_view`).
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
import webbrowser
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from rgbt.checks import InputError, RunError, of_posix
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.files.plain_files import check_links, inside
from rgbt.runs.provenance import without_passwords
from rgbt.tracking.mlflow_client import ARTIFACTS, SQLITE
from rgbt.tracking.mlflow_store import EXPERIMENT, MlflowTracking, reason_of
from rgbt.tracking.mlflow_view import view_path

HOST = "127.0.0.1"
NO_JOBS = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
# Longest times, in seconds, until the server answers, and until it has ended.
START_S, STOP_S = 120.0, 10.0


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    runs_dir: Annotated[Path, Help("folder of runs, whose mlflow.db is shown")] = Path("runs")
    uri: Annotated[str | None, Help("address of another store, or of a running server")] = None
    experiment: Annotated[str, Help("experiment of MLflow")] = EXPERIMENT
    port: Annotated[int, Interval(ge=0, le=65535), Help("of the server; 0: a free one")] = 0


def main(options: Options, overrides: list[str]) -> int:
    """Open the pages of an MLflow store. Ctrl-C ends their server."""
    del overrides  # none is heeded
    kill_group = of_posix("os.killpg", "rgbt ui, which ends MLflow's server with its workers,")
    tracking = MlflowTracking(
        options.uri, experiment=options.experiment, runs_dir=str(options.runs_dir)
    )
    database = Path(tracking.uri.removeprefix(SQLITE))
    if tracking.uri.startswith(SQLITE) and not database.is_file():
        raise InputError(f"runs_dir={options.runs_dir}: there is no MLflow store {database}.")
    if options.uri is None:  # the pages show every file
        check_links(inside(options.runs_dir / ARTIFACTS, options.runs_dir))
    try:
        page = view_path(tracking.store().experiment_id)
    except InputError:
        raise
    except Exception as error:  # The border to a store that may fail in any way.
        raise RunError(f"uri={without_passwords(tracking.uri)}: {reason_of(error)}") from error
    if tracking.uri.startswith("http"):
        _open(without_passwords(tracking.uri.rstrip("/")) + page)
        return 0
    with socket.socket() as probe:
        probe.bind((HOST, options.port))
        port = probe.getsockname()[1]
    server = subprocess.Popen(
        [sys.executable, *f"-m mlflow server --workers 1 --host {HOST} --port {port}".split()],
        # The address may hold a password, which a command line would show to everyone.
        env={**os.environ, "MLFLOW_BACKEND_STORE_URI": tracking.uri, **NO_JOBS},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C ends it through us, with all its workers
    )
    try:
        # Never through a proxy: the server is on this machine.
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        end, is_up = time.monotonic() + START_S, False
        while not is_up:
            if server.poll() is not None or time.monotonic() > end:
                raise RunError(f"port={port}: MLflow's server did not start.")
            time.sleep(0.2)
            with suppress(OSError), opener.open(f"http://{HOST}:{port}/health", timeout=1):
                is_up = True
        _open(f"http://{HOST}:{port}{page}")
        return server.wait()
    finally:
        for number in (signal.SIGTERM, signal.SIGKILL):
            with suppress(ProcessLookupError, subprocess.TimeoutExpired):
                kill_group(server.pid, number)
                server.wait(STOP_S)


def _open(address: str) -> None:
    sys.stdout.write(f"open MLflow  {address}\n")
    sys.stdout.flush()
    if sys.platform == "darwin" or {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        webbrowser.open(address)


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
