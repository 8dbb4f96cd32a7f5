"""Real servers for a test: PostgreSQL and MLflow, only on this machine's loopback."""

from __future__ import annotations

import os
import pwd
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

START_S = 180
STOP_S = 30
DEBIAN = "usr/lib/postgresql/*/bin"
"""Where Debian keeps the server's programs, off the path."""

QUIET = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
"""Without the second one the server starts seven more processes for work that we have not."""

ACCOUNT = "postgres"
"""Who runs the server where we are root, as which it refuses to start."""


def need_postgres() -> None:
    """Skip the test where PostgreSQL, or the driver for it, cannot be used."""
    pytest.importorskip("psycopg", reason="psycopg is missing: pip install -e '.[dev]'")
    if not _program("initdb"):
        pytest.skip("PostgreSQL's server is not installed: apt-get install postgresql")
    if os.getuid() == 0 and ACCOUNT not in {account.pw_name for account in pwd.getpwall()}:
        pytest.skip(f"PostgreSQL does not run as root, and there is no account '{ACCOUNT}'")


@contextmanager
def postgres(folder: Path) -> Iterator[str]:
    """A fresh PostgreSQL server.

    Args:
        folder: exists; the server's log is written there.

    Yields:
        postgresql://rgbt:PASSWORD@127.0.0.1:PORT/rgbt, the address of an empty database whose
        owner may make others (`new_database`).
    """
    need_postgres()
    # Not inside pytest's folder, which nobody but us may enter, and whose name is too long for a
    # socket.
    place = Path(tempfile.mkdtemp(prefix="rgbt-postgres-"))
    as_user: dict[str, Any] = {}
    if os.getuid() == 0:
        as_user = {"user": ACCOUNT, "group": ACCOUNT, "extra_groups": []}
        shutil.chown(place, ACCOUNT, ACCOUNT)
    password, port = secrets.token_hex(8), free_port()
    url = f"postgresql://rgbt:{password}@127.0.0.1:{port}"
    (place / "password").write_text(password)
    (place / "password").chmod(0o644)
    try:
        with (folder / "postgres.log").open("ab") as log:
            subprocess.run(_initdb(place), cwd=place, stdout=log, stderr=log, check=True, **as_user)
            server = subprocess.Popen(
                _server(place, port),
                cwd=place,
                stdout=log,
                stderr=log,
                start_new_session=True,
                **as_user,
            )
        with _stopping(server, signal.SIGINT):
            _until(lambda: _connects(f"{url}/postgres"), server, folder / "postgres.log")
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
    """A running MLflow server that keeps the files itself.

    Args:
        backend_url: its database, e.g. one of `postgres`.
        artifacts: folder of the files; the server's log is written beside it.

    Yields:
        its address, http://127.0.0.1:PORT.
    """
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    log_file = artifacts.with_name(f"{artifacts.name}.log")
    command = [
        *(sys.executable, "-m", "mlflow", "server", "--workers", "1"),
        *("--host", "127.0.0.1", "--port", str(port), "--backend-store-uri", backend_url),
        *("--artifacts-destination", artifacts.as_uri()),
    ]
    with log_file.open("ab") as log:
        server = subprocess.Popen(
            command,
            cwd=artifacts.parent,
            env={**os.environ, **QUIET},
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    with _stopping(server, signal.SIGTERM):
        _until(lambda: _answers(f"{url}/health"), server, log_file)
        yield url


def free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _program(name: str) -> str | None:
    folders = [os.environ.get("PATH", ""), *map(str, sorted(Path("/").glob(DEBIAN), reverse=True))]
    return shutil.which(name, path=os.pathsep.join(folders))


def _initdb(place: Path) -> Sequence[str]:
    return (
        *(str(_program("initdb")), "--pgdata", str(place / "data"), "--username", "rgbt"),
        *("--auth", "scram-sha-256", "--pwfile", str(place / "password")),
        *("--encoding", "UTF8", "--locale", "C", "--no-sync"),
    )


def _server(place: Path, port: int) -> Sequence[str]:
    return (
        *(str(_program("postgres")), "-D", str(place / "data"), "-k", str(place)),
        *("-h", "127.0.0.1", "-p", str(port), "-c", "fsync=off"),
    )


@contextmanager
def _stopping(server: subprocess.Popen[bytes], number: signal.Signals) -> Iterator[None]:
    """Stop the server at the end, with everything it has started."""
    try:
        yield
    finally:
        server.send_signal(number)
        with suppress(subprocess.TimeoutExpired):
            server.wait(STOP_S)
        with suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
        server.wait(STOP_S)


def _until(ready: Callable[[], bool], server: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + START_S
    while not ready():
        tail = log.read_text(errors="replace")[-2000:]
        assert server.poll() is None, f"the server ended:\n{tail}"
        assert time.monotonic() < end, f"the server does not answer:\n{tail}"
        time.sleep(0.1)


def _connects(url: str) -> bool:
    import psycopg

    try:
        psycopg.connect(url, connect_timeout=5).close()
    except psycopg.OperationalError:
        return False
    return True


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=5) as answer:
            return bool(answer.status == 200)
    except (urllib.error.URLError, OSError):
        return False
