"""Stores that cannot be read: one sentence each, and no store is created."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from analysis.report import collect as collecting
from analysis.report.store import MlflowRun, RunFiles, read_store
from rgbt.checks import InputError, RunError
from rgbt.tracking.mlflow_store import MlflowTracking, NoTracking
from tests.analysis.report.stores import RGB, RGB_FILE


def read(runs_dir: Path, uri: str | None = None) -> list[MlflowRun]:
    given: dict[str, Any] = {"artifact_uri": None, "experiment": "rgbt", "runs_dir": str(runs_dir)}
    return read_store(MlflowTracking(uri, **given), runs_dir, runs_dir)


def test_missing_store_is_refused_and_not_made(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there is no MLflow store .*mlflow\.db"):
        read(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_server_that_does_not_answer_is_one_sentence(tmp_path: Path) -> None:
    uri = "http://me:secret@127.0.0.1:9"
    with pytest.raises(RunError, match=r"^MLflow at http://me:\*\*\*@127\.0\.0\.1:9 cannot"):
        read(tmp_path, uri)


def test_a_file_that_is_no_database_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "mlflow.db").write_text("no database")
    with pytest.raises(RunError, match="cannot be read"):
        read(tmp_path)


def test_without_mlflow_there_is_nothing_to_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="made from an MLflow store"):
        read_store(NoTracking(), tmp_path, tmp_path)


def test_evaluation_path_is_that_of_sweeps() -> None:
    assert RGB.path == RGB_FILE


def test_replaced_runs_are_excluded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stored(run_id: str, **tags: str) -> MlflowRun:
        known = {"run_id": run_id, "name": run_id, "status": "RUNNING", "started": ""}
        return MlflowRun(
            **known, seconds=None, tags=tags, params={}, metrics={}, files=RunFiles((), None)
        )

    both = [stored("new"), stored("old", **{"rgbt.replaced": "true"})]
    monkeypatch.setattr(collecting, "read_store", lambda *_: both)
    for entries in ("table_entries", "study_entries", "mask_pictures", "difference_entries"):
        monkeypatch.setattr(collecting, entries, lambda *_: ())
    tracking = MlflowTracking("sqlite:///x", artifact_uri=None, experiment="r", runs_dir="x")
    data = collecting.collect(tracking, tmp_path, 100, "", (), lambda things, _: list(things))
    assert [run.run_id for run in data.runs] == ["new"]
