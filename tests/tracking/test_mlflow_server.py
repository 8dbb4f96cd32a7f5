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
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Port of a server, the first at which one is looked for."""
    with HTTPServer(("127.0.0.1", 0), Answer) as found:
        threading.Thread(target=found.serve_forever, daemon=True).start()
        monkeypatch.setattr(mlflow_server, "DEFAULT_PORT", found.server_port)
        yield found.server_port
        found.shutdown()


def test_pages_of_a_server_that_runs_need_no_command(server: int) -> None:
    assert pages_of(STORE, "mine") == Pages(f"http://127.0.0.1:{server}", None)


def test_pages_of_another_store_are_not_linked(server: int) -> None:
    found = pages_of(STORE, "other")
    port = int(found.address.rpartition(":")[2])
    assert port != server
    assert found.command is not None
    assert found.command.endswith(f"--port {port}")
    assert ui_command(STORE).endswith(f"--port {port}")


def test_pages_behind_something_that_speaks_no_http_are_not_linked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        monkeypatch.setattr(mlflow_server, "DEFAULT_PORT", other.getsockname()[1])
        monkeypatch.setattr(mlflow_server, "ANSWER_S", 0.1)
        assert pages_of(STORE, "mine").command is not None


def test_address_and_command_hide_passwords_and_quote_paths() -> None:
    assert pages_of("http://me:secret@host:5000/", "x") == Pages("http://me:***@host:5000", None)
    assert "'sqlite:////data/my runs/mlflow.db'" in ui_command(STORE, 5000)
    assert "secret" not in ui_command("postgresql://me:secret@host/db", 5000)
