"""What a strange folder, a slow server and a signal may not do to MLflow and a run."""

from __future__ import annotations

import os
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from rgbt.files.atomic import holding
from rgbt.runs.folder import Description, RunFolder, counts_name
from rgbt.tracking import mlflow_store, sync
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.mlflow_upload import UploadState, read_upload_state, write_upload_state
from tests.commands import code_of

SECRET = "the user's own file"


def run_folder(path: Path) -> RunFolder:
    folder = RunFolder(path)
    folder.describe(Description("grbm", {}, {}))
    folder.append(5, "train", {"loss": 3.0})
    folder.finish({"steps": 5})
    return folder


@pytest.fixture
def address(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Of a server that nobody may contact."""
    monkeypatch.setenv("MLFLOW_TRACKING_TOKEN", "token of the user")
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}"
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()


def test_nothing_is_sent_to_an_address_of_a_folder(
    tmp_path: Path, address: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = run_folder(tmp_path / "stranger" / "key")
    (tmp_path / "secret").write_text(SECRET)
    for name in ("config.yaml", counts_name("test"), "figures"):
        (folder.path / name).symlink_to(tmp_path if name == "figures" else tmp_path / "secret")
    (tmp_path / "mine.png").write_text(SECRET)
    os.mkfifo(folder.path / "diff.patch")
    write_upload_state(folder, UploadState(address, "rgbt", "f00"))
    assert code_of(sync.entry, [f"run={folder.path}"]) == 2
    assert code_of(sync.entry, [f"runs_dir={folder.path.parent}"]) == 0, "it is left out"
    # The links were made after the folder was opened.
    MlflowTracking(runs_dir=str(folder.path.parent)).sync(folder, "FINISHED")
    for name in ("config.yaml", counts_name("test"), "figures", "diff.patch"):
        (folder.path / name).unlink()
    sent = [path for path in (tmp_path / "stranger" / "mlartifacts").rglob("*") if path.is_file()]
    assert {path.name for path in sent} == {"result.json"}
    # The store of the stranger's folder names an address for files.
    (folder.path / "new.patch").write_text("new")
    for place in (f"file://{tmp_path}/x", (tmp_path / "stranger" / "mlartifacts").as_uri()):
        with closing(sqlite3.connect(tmp_path / "stranger" / "mlflow.db")) as database, database:
            database.execute("UPDATE runs SET artifact_uri = ?", [address])
            database.execute("UPDATE experiments SET artifact_location = ?", [place])
        capsys.readouterr()
        assert code_of(sync.entry, [f"run={folder.path}"]) == 2
        assert "outside its folder" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_a_slow_server_and_a_pipe_are_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(mlflow_store, "CALL_S", 2.0)
    os.mkfifo(tmp_path / "mlflow.db")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def drip() -> None:
            connection, _ = server.accept()
            connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n")
            while True:
                time.sleep(0.5)
                connection.sendall(b" ")

        threading.Thread(target=drip, daemon=True).start()
        slow = f"http://127.0.0.1:{server.getsockname()[1]}"
        for uri, reason in ((slow, "TimeoutError"), (None, "not a regular file")):
            began = time.monotonic()
            tracker = MlflowTracking(uri, runs_dir=str(tmp_path))
            tracker.start(RunFolder(tmp_path / "key"), Description("grbm", {}, {}))
            tracker.after_step()
            assert time.monotonic() - began < 60
            error = capsys.readouterr().err
            assert error.count("\n") == 1
            assert reason in error


@pytest.mark.slow
def test_a_held_lock_is_waited_for_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(mlflow_store, "LOCK_WAIT_S", 0.3)
    folder = run_folder(tmp_path / "a")
    run_folder(tmp_path / "b")
    with holding(tmp_path / ".mlflow.db.lock"):
        tracker = MlflowTracking(runs_dir=str(tmp_path))
        tracker.refresh(folder, Description("grbm", {}, {}))
        assert "StoreBusyError: process" in capsys.readouterr().err
        assert tracker.links() == [("MLflow later", f"rgbt sync run={folder.path}")]
        assert code_of(sync.entry, [f"runs_dir={tmp_path}"]) == 1
        assert capsys.readouterr().err.count("was not sent") == 1
    assert code_of(sync.entry, [f"runs_dir={tmp_path}"]) == 0
    assert read_upload_state(folder) is not None


START = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from rgbt.runs.folder import Description, RunFolder
from rgbt.tracking.mlflow_store import MlflowTracking
runs, key = sys.argv[1:]
tracker = MlflowTracking(runs_dir=runs)
tracker.start(RunFolder(f"{runs}/{key}"), Description(key, {}, {}))
tracker.after_step()
"""


@pytest.mark.slow
def test_many_processes_may_start_on_a_fresh_store(tmp_path: Path) -> None:
    words = [sys.executable, "-c", START, str(tmp_path)]
    workers = [subprocess.Popen([*words, key], stderr=subprocess.PIPE) for key in "abcd"]
    errors = [worker.communicate()[1] for worker in workers]
    assert errors == [b""] * 4, "no warning of ours, no noise of MLflow's"
    states = [read_upload_state(RunFolder(tmp_path / key)) for key in "abcd"]
    assert len({state.run_id for state in states if state}) == 4
