"""Find the web pages of a store: the address of a running server, or the command to start one."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import socket
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path

from rgbt.tracking.provenance import without_passwords

HOST = "127.0.0.1"
DEFAULT_PORT = 5000
ANSWER_S = 1.0
"""Seconds that a server on this machine gets to answer."""


@dataclass(frozen=True)
class Pages:
    """The address of a store's pages.

    Attributes:
        address: "http://host:port", without a slash at the end.
        command: what starts the server at `address`; None where it runs.
    """

    address: str
    command: str | None


def pages_of(uri: str, run_id: str) -> Pages:
    """The pages that show a run.

    Args:
        uri: the store: http://..., sqlite:///..., postgresql://...
        run_id: an MLflow run of that store; a server that knows it shows this store.
    """
    if uri.startswith(("http://", "https://")):
        return Pages(without_passwords(uri.rstrip("/")), None)
    # The MLflow servers of this machine, read from the running commands (Linux).
    for port in sorted({_port_of(words) for words in _commands() if _is_server(words)}):
        address = f"http://{HOST}:{port}"
        if _shows(address, run_id):
            return Pages(address, None)
    port = _free_port()
    return Pages(f"http://{HOST}:{port}", ui_command(uri, port))


def ui_command(uri: str, port: int | None = None) -> str:
    """The command that opens MLflow's pages on a database; one worker is enough for one person.

    Args:
        uri: sqlite:///... or postgresql://...; its password is hidden.
        port: None: the first free one from 5000 on, which is MLflow's default.
    """
    port = _free_port() if port is None else port
    words = ["mlflow", "ui", "--workers", "1", "--backend-store-uri", without_passwords(uri)]
    words += [] if port == DEFAULT_PORT else ["--port", str(port)]
    return f"{python_command()} -m {shlex.join(words)}"


def python_command() -> str:
    """Command for this interpreter, which may not be on the path (`make` uses one in .venv)."""
    if shutil.which("python") == sys.executable:
        return "python"
    here, program = Path.cwd(), Path(sys.executable)
    program = program.relative_to(here) if program.is_relative_to(here) else program
    return shlex.quote(str(program))


def _commands() -> Iterator[list[str]]:
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            yield path.read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue  # the process has ended


def _is_server(words: list[str]) -> bool:
    return any("mlflow" in word for word in words) and any(
        word in ("ui", "server") or word.startswith("mlflow.server") for word in words
    )


def _port_of(words: list[str]) -> int:
    found = re.search(r"\0(?:--port|-p)[=\0](\d{1,5})\0", "\0".join(["", *words, ""]))
    return int(found.group(1)) if found else DEFAULT_PORT


def _shows(address: str, run_id: str) -> bool:
    """Whether the server at `address` knows the run."""
    # Never through a proxy: the server is on this machine.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    query = f"{address}/api/2.0/mlflow/runs/get?run_id={run_id}"
    try:
        with opener.open(query, timeout=ANSWER_S) as answer:
            return bool(json.load(answer)["run"]["info"]["run_id"] == run_id)
    except (OSError, HTTPException, ValueError, KeyError, TypeError):
        return False  # no server, another store, or something else that listens there


def _free_port() -> int:
    """The first port from MLflow's default on that nobody listens at."""
    for port in range(DEFAULT_PORT, DEFAULT_PORT + 20):
        with socket.socket() as probe:
            probe.settimeout(ANSWER_S)
            if probe.connect_ex((HOST, port)) != 0:
                return port
    return DEFAULT_PORT
