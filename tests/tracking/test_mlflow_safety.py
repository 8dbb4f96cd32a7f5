"""What a strange folder, a slow server and a signal may not do to MLflow and a run."""

from __future__ import annotations

import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt.files.atomic import holding
from rgbt.runs.folder import Description, RunFolder, counts_name
from rgbt.terminal import shell_command
from rgbt.tracking import mlflow_client, mlflow_store, sync, ui
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.mlflow_upload import UploadState, read_upload_state, write_upload_state
from tests.commands import code_of

PNG = cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes()
SECRET = "the user's own file"
UPDATE_RUNS = "UPDATE runs SET artifact_uri = '{}/' || run_uuid || '/artifacts'"


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
    tmp_path: Path,
    address: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(ui, "subprocess", None)  # no server is started
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
    files, mine = tmp_path / "stranger" / "mlartifacts", tmp_path / "mlartifacts"
    (mine / "x").mkdir(parents=True)
    run, everywhere = UPDATE_RUNS.format(files.as_uri()), f"file://{tmp_path}/x"
    for runs, experiments in (
        (UPDATE_RUNS.format(address), files.as_uri()),
        (run, everywhere),
        (run, f"{mine.as_uri()}/x"),  # would be that of a folder that was moved, but for x
        (run, f"{files.as_uri()}/../../mlartifacts/x"),
        (run, f"file://{address[7:]}{files}"),
        (run, f"mlflow-artifacts://{address[7:]}/1"),
        (run, f"s3://{files}"),
    ):
        with closing(sqlite3.connect(tmp_path / "stranger" / "mlflow.db")) as database, database:
            database.execute(runs)
            database.execute("UPDATE experiments SET artifact_location = ?", [experiments])
        for entry, words in ((sync, f"run={folder.path}"), (ui, f"runs_dir={folder.path.parent}")):
            capsys.readouterr()
            assert code_of(entry.entry, [words]) == 2
            assert "outside its folder" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
    with closing(sqlite3.connect(tmp_path / "stranger" / "mlflow.db")) as database, database:
        database.execute(UPDATE_RUNS.format(mine.as_uri()))
        database.execute("UPDATE experiments SET artifact_location = ?", [mine.as_uri()])
    assert code_of(sync.entry, [f"run={folder.path}"]) == 0, "as of a folder that was moved"
    assert [path.name for path in mine.rglob("*")] == ["x"]
    # A link in the folder of files leads out of it.
    (next(files.glob("*/artifacts")) / "figures").symlink_to(tmp_path)
    for entry, words in ((sync, f"run={folder.path}"), (ui, f"runs_dir={folder.path.parent}")):
        assert code_of(entry.entry, [words]) == 2
        assert "leads out of" in capsys.readouterr().err


def test_a_folder_of_runs_that_was_moved_keeps_its_store(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mlflow_client.set_environment()
    from mlflow import MlflowClient
    from mlflow.tracking._tracking_service import utils

    folders = [run_folder(tmp_path / "runs" / key) for key in "ab"]
    for folder in folders:
        folder.add_provenance({"started": f"2026-01-0{ord(folder.path.name) - 96}T00:00:00+00:00"})
        folder.figure_path("panel").write_bytes(PNG)
    assert code_of(sync.entry, [f"runs_dir={tmp_path / 'runs'}"]) == 0
    before = [read_upload_state(folder).run_id for folder in folders]
    shutil.copytree(tmp_path / "runs", tmp_path / "a copy")  # its source stays
    (tmp_path / "runs").rename(tmp_path / "möved")
    (tmp_path / "möved" / "b" / "mlflow.json").unlink()  # found by its key
    for place in (tmp_path / "möved", tmp_path / "a copy"):
        utils._artifact_repos_cache.clear()  # of MLflow: addresses by run, in one process
        assert code_of(sync.entry, [f"runs_dir={place}"]) == 0, capsys.readouterr().err
        store = MlflowClient(tracking_uri=f"sqlite:///{place / 'mlflow.db'}")
        found = {run.info.run_id: run for run in store.search_runs(["1"])}
        assert sorted(found) == sorted(before), "no run is there twice"
        for key, name in zip("ab", before, strict=True):
            assert found[name].data.tags["rgbt.folder"] == str(place / key)
            files = (place / "mlartifacts" / name / "artifacts").as_uri()
            assert found[name].info.artifact_uri == files
            assert Path(store.download_artifacts(name, "figures/panel.png")).read_bytes() == PNG
            assert len(store.get_metric_history(name, "train/loss")) == 1
    assert not (tmp_path / "runs").exists(), "nothing is written there"


def test_a_server_that_never_answers_is_waited_for_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert float(mlflow_client.ENVIRONMENT[mlflow_client.TIMEOUT]) < mlflow_client.SERVER_S < 10
    monkeypatch.setenv(mlflow_client.TIMEOUT, "1")
    monkeypatch.setattr(mlflow_store, "SLOW_S", 0.9)
    with socket.create_server(("127.0.0.1", 0)) as server:
        tracker = MlflowTracking(
            f"http://127.0.0.1:{server.getsockname()[1]}", runs_dir=str(tmp_path)
        )
        folder = run_folder(tmp_path / "key")
        tracker.start(folder, Description("grbm", {}, {}))
        tracker.after_step()
        tracker.update()
        tracker.finish("FINISHED")
        server.setblocking(False)
        server.accept()[0].close()
        with pytest.raises(BlockingIOError):
            server.accept()
    error = capsys.readouterr().err
    assert (error.count("\n"), "rgbt sync run=" in error) == (1, True)


@pytest.mark.slow
def test_a_slow_server_and_a_pipe_are_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(mlflow_client, "SERVER_S", 2.0)
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
    monkeypatch.setattr(mlflow_client, "LOCK_WAIT_S", 0.3)
    folder = run_folder(tmp_path / "a")
    run_folder(tmp_path / "b")
    with holding(tmp_path / ".mlflow.db.lock"):
        tracker = MlflowTracking(runs_dir=str(tmp_path))
        tracker.refresh(folder, Description("grbm", {}, {}))
        assert "TimeoutError: process" in capsys.readouterr().err
        command = shell_command("sync", f"run={folder.path}")
        assert tracker.links() == [("MLflow later", command)]
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
