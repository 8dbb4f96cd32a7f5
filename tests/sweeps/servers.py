"""Real servers for a test: PostgreSQL and MLflow, only on this machine's loopback."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

START_S, STOP_S = 180, 30
DEBIAN = "usr/lib/postgresql/*/bin"
QUIET = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
"""Without the second one the server starts seven more processes for work that we have not."""


@contextmanager
def postgres(folder: Path) -> Iterator[str]:
    """A fresh PostgreSQL server, whose log is written to `folder`; the address of a database."""
    pytest.importorskip("psycopg", reason="psycopg is missing: pip install -e '.[dev]'")
    if not _program("initdb"):
        pytest.skip("PostgreSQL's server is not installed: apt-get install postgresql")
    # Not inside pytest's folder, which nobody but us may enter; its name is too long for a socket.
    place = Path(tempfile.mkdtemp(prefix="rgbt-postgres-"))
    options: dict[str, Any] = {"cwd": place}
    if os.getuid() == 0:  # as which it refuses to start
        options |= {"user": "postgres", "group": "postgres", "extra_groups": []}
        shutil.chown(place, "postgres", "postgres")
    password, port = secrets.token_hex(8), free_port()
    url = f"postgresql://rgbt:{password}@127.0.0.1:{port}"
    (place / "password").write_text(password)
    (place / "password").chmod(0o644)
    made = (
        *(_program("initdb"), "--pgdata", str(place / "data"), "--username", "rgbt"),
        *("--auth", "scram-sha-256", "--pwfile", str(place / "password")),
        *("--encoding", "UTF8", "--locale", "C", "--no-sync"),
    )
    started = (
        *(_program("postgres"), "-D", str(place / "data"), "-k", str(place)),
        *("-h", "127.0.0.1", "-p", str(port), "-c", "fsync=off"),
    )

    def connects() -> bool:
        import psycopg

        with suppress(psycopg.OperationalError):
            psycopg.connect(f"{url}/postgres", connect_timeout=5).close()
            return True
        return False

    try:
        log = folder / "postgres.log"
        with log.open("ab") as file:
            subprocess.run(made, stdout=file, stderr=file, check=True, **options)
        with _running(started, signal.SIGINT, connects, log, **options):
            yield new_database(f"{url}/postgres", "rgbt")
    finally:
        shutil.rmtree(place, ignore_errors=True)


def new_database(url: str, name: str) -> str:
    """Make an empty database on the server of `url`; its address."""
    import psycopg

    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute(f'CREATE DATABASE "{name}"')
    return f"{url.rpartition('/')[0]}/{name}"


@contextmanager
def mlflow_server(backend_url: str, artifacts: Path) -> Iterator[str]:
    """A running MLflow server on a database, which keeps the files itself; its address."""
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    command = (
        *(sys.executable, "-m", "mlflow", "server", "--workers", "1"),
        *("--host", "127.0.0.1", "--port", str(port), "--backend-store-uri", backend_url),
        *("--artifacts-destination", artifacts.as_uri()),
    )

    def answers() -> bool:
        with suppress(OSError), urllib.request.urlopen(f"{url}/health", timeout=5) as answer:
            return bool(answer.status == 200)
        return False

    log, options = artifacts.with_name(f"{artifacts.name}.log"), {"cwd": artifacts.parent}
    environment = {**os.environ, **QUIET}
    with _running(command, signal.SIGTERM, answers, log, env=environment, **options):
        yield url


def free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _program(name: str) -> str:
    folders = [os.environ.get("PATH", ""), *map(str, sorted(Path("/").glob(DEBIAN), reverse=True))]
    return shutil.which(name, path=os.pathsep.join(folders)) or ""


@contextmanager
def _running(
    command: Any, number: signal.Signals, ready: Callable[[], bool], log: Path, **options: Any
) -> Iterator[None]:
    """Wait until the server is ready; stop it at the end, with everything it has started."""
    with log.open("ab") as file:
        both: Any = {"stdout": file, "stderr": file, "start_new_session": True}
        server = subprocess.Popen(command, **both, **options)
    end = time.monotonic() + START_S
    try:
        while not ready():
            assert server.poll() is None, log.read_text(errors="replace")[-2000:]
            assert time.monotonic() < end, log.read_text(errors="replace")[-2000:]
            time.sleep(0.1)
        yield
    finally:
        server.send_signal(number)
        with suppress(subprocess.TimeoutExpired):
            server.wait(STOP_S)
        with suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
        server.wait(STOP_S)
