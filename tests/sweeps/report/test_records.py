from __future__ import annotations

from pathlib import Path
from typing import Any

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


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture
def table_file(tmp_path: Path) -> Path:
    path = tmp_path / "table.md"
    path.write_text("first")
    return path


@pytest.mark.slow
def test_a_record_is_one_run_that_a_repeat_updates(place: Path, table_file: Path) -> None:
    tracking = tracking_in(place)
    links = sent(tracking, table_file)
    table_file.write_text("second")
    assert sent(tracking_in(place), table_file, note="x\n" * NOTE_LENGTH) == links
    sent(tracking, table_file, name="own/other demo")
    client, experiment = tracking.store().client, tracking.store().experiment_id
    runs = client.search_runs([experiment], filter_string="tags.`rgbt.record` = 'own/t demo'")
    (run,) = runs
    assert run.info.status == "FINISHED"
    assert run.data.tags["kind"] == "table"
    assert run.data.tags["rgbt.table"] == "own/t"
    assert run.data.metrics == {"order/mIoU _all_": 0.5}
    note = run.data.tags["mlflow.note.content"]
    assert len(note) <= NOTE_LENGTH
    assert note.endswith("x\n\n(the rest is in the artifacts)\n")
    copy = client.download_artifacts(run.info.run_id, "table.md")
    assert Path(copy).read_text() == "second"
    assert links == [("open MLflow", f"rgbt ui runs_dir={place}")]


@pytest.mark.slow
def test_record_concurrent_creation_keeps_older_run(place: Path, table_file: Path) -> None:
    tracking = tracking_in(place)
    store = tracking.store()
    made = []

    class Client:
        """Another process makes its run while ours is being made."""

        def __getattr__(self, name: str) -> Any:
            return getattr(store.client, name)

        def create_run(self, experiment: str, **words: Any) -> Any:
            assert words["tags"] == {"rgbt.record": words["run_name"]}
            other = store.client.create_run(experiment, start_time=1, **words)
            made.append(other.info.run_id)
            return store.client.create_run(experiment, **words)

    tracking._store = type(store)(Client(), store.experiment_id)
    sent(tracking, table_file, name="own/raced demo")
    runs = store.client.search_runs(
        [store.experiment_id], filter_string="tags.`rgbt.record` = 'own/raced demo'"
    )
    assert [run.info.run_id for run in runs] == made


def test_a_store_that_is_away_costs_a_line(
    table_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    tracking = tracking_in(table_file.parent)

    def away() -> None:
        raise ConnectionError("postgresql://me:secret@host is away\nsecond line")

    monkeypatch.setattr(tracking, "store", away)
    assert sent(tracking, table_file) == []
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert "the table was not sent to MLflow (ConnectionError: postgresql://me:***@host" in told[0]


def test_without_mlflow_nothing_is_done(
    table_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sent(NoTracking(), table_file) == []
    assert capsys.readouterr().err == ""
