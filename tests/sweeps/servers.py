"""A server of MLflow for a test, only on this machine's loopback."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

START_S, STOP_S = 180, 30
QUIET = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
"""Without the second one the server starts seven more processes for work that we have not."""


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
    log, env = artifacts.with_name(f"{artifacts.name}.log"), {**os.environ, **QUIET}
    with log.open("ab") as file:
        server = subprocess.Popen(
            command, stdout=file, stderr=file, cwd=log.parent, env=env, start_new_session=True
        )
    end = time.monotonic() + START_S
    try:
        while not _answers(url):
            assert server.poll() is None, log.read_text(errors="replace")[-2000:]
            assert time.monotonic() < end, log.read_text(errors="replace")[-2000:]
            time.sleep(0.1)
        yield url
    finally:  # with everything it has started
        server.terminate()
        with suppress(subprocess.TimeoutExpired):
            server.wait(STOP_S)
        with suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
        server.wait(STOP_S)


def _answers(url: str) -> bool:
    with suppress(OSError), urllib.request.urlopen(f"{url}/health", timeout=5) as answer:
        return bool(answer.status == 200)
    return False


def free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
