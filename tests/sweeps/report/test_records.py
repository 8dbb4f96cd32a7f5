"""Tables and studies in MLflow: one run each, also when two drivers end at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from rgbt.tracking.mlflow_store import MlflowTracking, NoTracking
from sweeps.report.records import NOTE_LENGTH, record


def tracking_in(folder: Path) -> MlflowTracking:
    return MlflowTracking(None, artifact_uri=None, experiment="rgbt", runs_dir=str(folder))


def sent(tracking: Any, path: Path, **changed: Any) -> list[tuple[str, str]]:
    given: dict[str, Any] = {
        "name": "own/t demo",
        "kind": "table",
        "files": [path],
        "metrics": {"order/mIoU (all)": 0.5, "order/Var": float("nan")},
        "tags": {"rgbt.table": "own/t"},
        "note": "**note**",
    }
    return record(tracking, **(given | changed))


@pytest.mark.slow
def test_record_is_one_run_that_a_repeat_updates(tmp_path: Path) -> None:
    tracking, table_file = tracking_in(tmp_path), tmp_path / "table.md"
    table_file.write_text("first")
    links = sent(tracking, table_file)
    table_file.write_text("second")
    assert sent(tracking_in(tmp_path), table_file, note="x\n" * NOTE_LENGTH) == links
    store = tracking.store()
    runs = store.client.search_runs([store.experiment_id])
    (run,) = runs
    assert (run.data.tags["kind"], run.data.tags["rgbt.table"]) == ("table", "own/t")
    assert run.data.metrics == {"order/mIoU _all_": 0.5}
    assert len(run.data.tags["mlflow.note.content"]) <= NOTE_LENGTH
    copy = store.client.download_artifacts(run.info.run_id, "table.md")
    assert Path(copy).read_text() == "second"
    assert links == [("open MLflow", f"rgbt ui runs_dir={tmp_path}")]


def test_record_without_store_costs_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert sent(NoTracking(), tmp_path) == []
    tracking = tracking_in(tmp_path)
    away = ConnectionError("postgresql://me:secret@host is away\nsecond line")
    monkeypatch.setattr(tracking, "store", Mock(side_effect=away))
    assert sent(tracking, tmp_path) == []
    (told,) = capsys.readouterr().err.splitlines()
    assert "ConnectionError: postgresql://me:***@host" in told
