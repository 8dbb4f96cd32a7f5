"""Finished runs: their scores and files, here and in MLflow, and tags that are added to them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from rgbt.checks import RunError
from rgbt.runs.folder import RunFolder
from rgbt.runs.result import RunResult
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.tracker import Tracking
from sweeps.run.run_store import RunStore
from tests.sweeps.fakes import DATASET, finish


@pytest.fixture
def runs(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path, Tracking())


def test_find_returns_finished_runs_only(runs: RunStore) -> None:
    finish(runs.runs_dir / "a")
    RunFolder(runs.runs_dir / "b").append(1, "val", {"mIoU": 0.5})
    found = runs.find("a", DATASET)
    assert found is not None
    assert (found.key, found.folder, found.run_id) == ("a", runs.runs_dir / "a", "")
    assert found.result["test"] == {"mIoU": 0.25, "Var": 9.0}
    assert runs.find("b", DATASET) is None
    assert runs.find("c", DATASET) is None
    assert not (runs.runs_dir / "c").exists()


def test_find_run_on_other_data_raises(runs: RunStore) -> None:
    finish(runs.runs_dir / "a", dataset="another-fingerprint")
    with pytest.raises(RunError, match=r"a was trained on other files .*another-, now fingerpr"):
        runs.find("a", DATASET)


def tags_of(folder: Path) -> dict[str, str]:
    return dict(json.loads((folder / "run.json").read_text())["tags"])


def test_tags_are_added_to_those_that_a_run_has(runs: RunStore) -> None:
    finish(runs.runs_dir / "a", tags={"rgbt.table/one": "row"})
    found = RunResult(runs.runs_dir / "a")
    runs.tag(found, {"rgbt.table/two": "other row"})
    tags = {"rgbt.key": "a", "rgbt.table/one": "row", "rgbt.table/two": "other row"}
    assert tags_of(found.folder) == tags
    before = (found.folder / "run.json").stat().st_mtime_ns
    runs.tag(found, {"rgbt.table/two": "other row"})
    assert (found.folder / "run.json").stat().st_mtime_ns == before, "nothing new, nothing written"


def test_run_store_unreachable_mlflow_warns_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    away = Mock(side_effect=ConnectionError("no route to\nthe host"))
    monkeypatch.setattr(MlflowTracking, "store", away)
    place: Any = {"artifact_uri": None, "experiment": "rgbt", "runs_dir": str(tmp_path)}
    runs = RunStore(tmp_path, MlflowTracking("http://127.0.0.1:9", **place))
    runs.create_tables()
    finish(tmp_path / "a")
    found = runs.find("a", DATASET)
    assert found is not None
    runs.tag(found, {"rgbt.table/one": "row"})
    runs.sync(found)
    assert tags_of(found.folder)["rgbt.table/one"] == "row", "kept for a later sync"
    (told,) = capsys.readouterr().err.splitlines()
    assert "no route to" in told
    away.assert_called_once()
