"""Links lead to the MLflow server that runs, and otherwise to the command that starts one."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from rgbt.tracking import mlflow_server
from rgbt.tracking.mlflow_server import Pages, pages_of, ui_command

STORE = "sqlite:////data/my runs/mlflow.db"


class Answer(BaseHTTPRequestHandler):
    """Knows the run "mine", as an MLflow server on the same store does."""

    def do_GET(self) -> None:
        known = self.path == "/api/2.0/mlflow/runs/get?run_id=mine"
        content = {"run": {"info": {"run_id": "mine"}}} if known else {"error_code": "MISSING"}
        self.send_response(200 if known else 404)
        self.end_headers()
        self.wfile.write(json.dumps(content).encode())

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[int]:
    """Port of a server."""
    with HTTPServer(("127.0.0.1", 0), Answer) as found:
        threading.Thread(target=found.serve_forever, daemon=True).start()
        yield found.server_port
        found.shutdown()


def runs(monkeypatch: pytest.MonkeyPatch, *commands: str) -> None:
    """Let these be the commands that run on this machine."""
    monkeypatch.setattr(mlflow_server, "_commands", lambda: [each.split() for each in commands])


@pytest.mark.parametrize(
    "command",
    [
        "python -m mlflow ui --port {}",
        "/usr/bin/mlflow server --port={} --workers 1",
        "mlflow ui -p {}",
        "python -m uvicorn --host 127.0.0.1 --port {} mlflow.server.fastapi_app:app",
    ],
)
def test_pages_of_a_server_that_runs_need_no_command(
    monkeypatch: pytest.MonkeyPatch, server: int, command: str
) -> None:
    runs(monkeypatch, "bash -c sleep", command.format(server))
    assert pages_of(STORE, "mine") == Pages(f"http://127.0.0.1:{server}", None)


@pytest.mark.parametrize("command", ["python -m mlflow ui --port {}", "python -m http.server {}"])
def test_a_server_of_another_store_or_program_is_not_linked(
    monkeypatch: pytest.MonkeyPatch, server: int, command: str
) -> None:
    runs(monkeypatch, command.format(server))
    found = pages_of(STORE, "other")
    assert found.command is not None
    assert found.address != f"http://127.0.0.1:{server}"


def test_a_port_that_is_taken_is_not_proposed(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        monkeypatch.setattr(mlflow_server, "DEFAULT_PORT", taken)
        runs(monkeypatch)
        found = pages_of(STORE, "mine")
    port = int(found.address.rpartition(":")[2])
    assert port != taken
    assert found.command is not None
    assert found.command.endswith(f"--port {port}")


def test_the_address_of_a_server_is_shown_without_its_password() -> None:
    assert pages_of("http://me:secret@host:5000/", "x") == Pages("http://me:***@host:5000", None)


def test_the_command_quotes_paths_and_hides_passwords() -> None:
    assert "'sqlite:////data/my runs/mlflow.db'" in ui_command(STORE, 5000)
    assert "secret" not in ui_command("postgresql://me:secret@host/db", 5000)


def test_the_running_commands_are_read() -> None:
    assert any("pytest" in word for words in mlflow_server._commands() for word in words)
