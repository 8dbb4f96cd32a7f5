"""Connect to an MLflow store with short timeouts, safely for processes that start together."""

from __future__ import annotations

import logging
import os
import re
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rgbt.files.atomic import holding
from rgbt.tracking.mlflow_view import view_tags

ENVIRONMENT = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    # A lost server must delay a training by seconds, not by the minutes of the defaults (7, 120).
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "GIT_PYTHON_REFRESH": "quiet",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
}
"""Set before the first import of mlflow, unless the user set them."""

DATABASE_PORTS = {"postgresql": 5432, "mysql": 3306, "mssql": 1433}
CONNECT_S = 10.0
"""Seconds until a database server must have answered."""

LOCK_WAIT_S = 60.0
"""Seconds to wait for another process: several that create the tables take seconds each."""

QUIET_WAIT_S = 15.0
"""Seconds of these before the waiting is reported."""

EXPERIMENT_NOTE = """\
One run per configuration and seed. **mIoU**, **Var**, **region/...**, **class/...** are of the last
evaluation (test split); **val/...** and **train/...** are curves over training steps. Scores are
in percent; Var is the variance over regions in squared percent points. The two layouts under
*Views* show the scores first, for every run or as means over seeds.

**profile/iou_by_region** is a line over the *regions*: its "step" is the number of the region,
1 = innermost ring. Group the charts by a parameter to see its mean and its spread over seeds.

The table of classes and regions is the artifact `tables/iou.json`; every run's
description holds it too.
"""


@dataclass(frozen=True)
class MlflowStore:
    """An open store: MLflow's client and the experiment that runs go to."""

    client: Any
    experiment_id: str


def open_store(uri: str, artifact_uri: str | None, experiment: str) -> MlflowStore:
    """Connect, making database and experiment where they do not exist.

    Args:
        uri: sqlite:///..., postgresql://..., http://...
        artifact_uri: where a new experiment keeps its files; None: the store decides.
        experiment: its name.

    Raises:
        Exception: whatever MLflow raises when the store cannot be used.
    """
    check_reachable(uri)
    make_client = quiet_client()  # imported before others wait for the lock
    # Two processes that create the tables of one SQLite file together break it.
    database = Path(uri.removeprefix("sqlite:///"))
    lock = database.with_name(f".{database.name}.lock")
    is_file = uri.startswith("sqlite:///")
    if is_file:
        database.parent.mkdir(parents=True, exist_ok=True)
    with locked(lock) if is_file else nullcontext():
        client = make_client(tracking_uri=uri)
        found = client.get_experiment_by_name(experiment)
        found = found or _created(client, experiment, artifact_uri)
    tags = {"mlflow.note.content": EXPERIMENT_NOTE, **view_tags()}
    for name, value in tags.items():
        if found.tags.get(name) != value:
            client.set_experiment_tag(found.experiment_id, name, value)
    return MlflowStore(client, str(found.experiment_id))


def quiet_client() -> Any:
    """The class of MLflow's client, without the messages of MLflow."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    # Takes seconds, hence not at the top.
    from mlflow import MlflowClient

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    return MlflowClient


def started_monitor(uri: str, run_id: str) -> Any:
    """A thread of MLflow that sends metrics ``system/...`` of this machine until its `finish`.

    It stops by itself if the store fails. A run that resumes continues its steps.
    """
    from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

    monitor = SystemMetricsMonitor(run_id, resume_logging=True, tracking_uri=uri)
    monitor.start()
    return monitor


def check_reachable(uri: str) -> None:
    """Raise OSError where nobody listens at the address of a database server.

    MLflow itself would try again for minutes, with a page of errors each time.
    """
    port = DATABASE_PORTS.get(re.split(r"[+:]", uri)[0])
    if port is None:
        return
    from sqlalchemy.engine import make_url  # as MLflow reads it: a password may hold anything

    address = make_url(uri)
    if address.host:  # else a socket of this machine
        with socket.create_connection((address.host, address.port or port), timeout=CONNECT_S):
            pass


class StoreBusyError(Exception):
    """Another process holds a lock of the store, or of a run's way to it, for too long."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock `path` of a store or of a run's way to it.

    Raises:
        StoreBusyError: another process holds it for `LOCK_WAIT_S`; a stopped one would for ever.
    """
    with holding(path, wait_s=QUIET_WAIT_S) as holder:
        if holder is None:
            yield
            return
    sys.stderr.write(f"rgbt: waiting for {holder}, which holds {path} (up to {LOCK_WAIT_S:g} s).\n")
    with holding(path, wait_s=LOCK_WAIT_S - QUIET_WAIT_S) as holder:
        if holder is not None:
            raise StoreBusyError(f"{holder} has held {path} for {LOCK_WAIT_S:g} s")
        yield


def _created(client: Any, name: str, artifact_uri: str | None) -> Any:
    """A new experiment; another machine may be creating it at this moment."""
    try:
        client.create_experiment(name, artifact_location=artifact_uri)
    except Exception:
        time.sleep(1.0)
        if client.get_experiment_by_name(name) is None:
            raise
    return client.get_experiment_by_name(name)
