"""MLflow filled from run folders: live, later, again, with no store; data sets; metrics."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rgbt.runs.folder import (
    Description,
    RunFolder,
    counts_name,
    read_description,
    set_aside,
)
from rgbt.tables import ClassTable, RegionTable, ResultTables
from rgbt.tracking import sync
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.mlflow_upload import (
    artifact_table,
    read_upload_state,
    write_upload_state,
)
from rgbt.tracking.mlflow_view import view_tags
from rgbt.tracking.tracker import Tracking
from tests.commands import code_of

DEAD = "http://127.0.0.1:9"
TAGS = {"rgbt.group": "grbm", "rgbt.seed": "0"}
PARAMS = {"seed": "0", "masker.sigma_div": "2", "long": "x" * 900}
TABLES = ResultTables(
    split="test",
    step=20,
    region_names=("ring 1", "ring 2"),
    regions=RegionTable("grbm", (0.25, 0.5), 0.4, 156.25),
    classes=ClassTable(
        names=("road", "car"),
        ious=(0.5, 0.3),
        accuracies=(0.6, math.nan),
        region_ious=((0.25, 0.75), (0.25, math.nan)),
        subset_mious={"day": 0.4},
    ),
)


@pytest.fixture(scope="module")
def runs_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder of runs, so that the store is made once."""
    return tmp_path_factory.mktemp("runs")


def tracking(runs_dir: Path, uri: str | None = None) -> MlflowTracking:
    return MlflowTracking(uri, artifact_uri=None, experiment="rgbt", runs_dir=str(runs_dir))


def begin(folder: RunFolder, tracker: Tracking) -> None:
    tracker.start(folder, Description("grbm seed=0", TAGS, PARAMS))
    tracker.after_step()


def conclude(folder: RunFolder) -> None:
    """What a run writes at its end."""
    folder.append(20, "test", {"mIoU": 0.4, "Var": 156.25, "region/1": 0.25, "class/car": math.nan})
    folder.write_tables(TABLES)
    folder.figure_path("region_iou").write_bytes(b"png")
    (folder.path / counts_name("test")).write_bytes(b"npz")
    folder.finish({"mIoU": 0.4})


def client(runs_dir: Path) -> Any:
    from mlflow import MlflowClient

    return MlflowClient(tracking_uri=f"sqlite:///{runs_dir / 'mlflow.db'}")


def run_id(folder: RunFolder) -> str:
    sent = read_upload_state(folder)
    assert sent is not None
    assert sent.run_id
    return sent.run_id


def run_of(runs_dir: Path, folder: RunFolder) -> Any:
    return client(runs_dir).get_run(run_id(folder))


def points(store: Any, run_id: str, name: str) -> list[tuple[int, float]]:
    history = store.get_metric_history(run_id, name)
    return [(point.step, point.value) for point in history if not math.isnan(point.value)]


LINES = (
    *((5, "train", {"loss": 3.0}), (10, "train", {"loss": 2.0}), (10, "val", {"mIoU": 0.123456})),
    (15, "train", {"loss": 1.0}),
)


@pytest.fixture(scope="module")
def finished(runs_dir: Path) -> RunFolder:
    """A run killed after step 10 with its checkpoint at step 5, continued, finished."""
    folder = RunFolder(runs_dir / "killed")
    folder.write_config("seed: 0\n")
    folder.add_provenance({"command": "python -m rgbt.run", "started": "2026-01-01T00:00:00+00:00"})
    first = tracking(runs_dir)
    begin(folder, first)
    for step, kind, values in LINES[:3]:
        folder.append(step, kind, values)
    first.update()
    first.update()
    (folder.path / "first_run_id").write_text(run_id(folder))

    # The lines beyond the checkpoint are written again, at another time.
    folder.truncate_after(5)
    second = tracking(runs_dir)
    begin(folder, second)
    for step, kind, values in LINES[1:]:
        folder.append(step, kind, values)
    second.update()
    conclude(folder)
    second.finish("FINISHED")
    second.finish("FINISHED")
    return folder


POINTS = {
    "train/loss": [(5, 3.0), (10, 2.0), (15, 1.0)],
    "val/mIoU": [(10, 12.35)],
    "mIoU": [(0, 40.0)],
    "Var": [(0, 156.25)],
    "profile/iou_by_region": [(1, 25.0), (2, 50.0)],
}


def test_killed_run_continues_its_mlflow_run_without_duplicates(
    runs_dir: Path, finished: RunFolder
) -> None:
    run = run_id(finished)
    assert run == (finished.path / "first_run_id").read_text()
    assert {name: points(client(runs_dir), run, name) for name in POINTS} == POINTS


def test_a_run_sent_again_leaves_no_duplicate(runs_dir: Path) -> None:
    """MLflow itself drops what it has; the record of the folder is not needed for it."""
    folder = RunFolder(runs_dir / "crashed")
    Tracking().start(folder, Description("grbm", TAGS, PARAMS))
    folder.append(5, "train", {"loss": 3.0})
    conclude(folder)
    for _ in range(3):
        tracking(runs_dir).sync(folder, "FINISHED")
        sent = read_upload_state(folder)
        assert sent is not None
        write_upload_state(folder, replace(sent, steps={}, sent=0.0))
    assert points(client(runs_dir), sent.run_id, "train/loss") == [(5, 3.0)]
    assert points(client(runs_dir), sent.run_id, "profile/iou_by_region") == [(1, 25.0), (2, 50.0)]


@pytest.mark.parametrize("content", [None, '{"uri": 3'])
def test_run_without_noted_id_is_found_by_its_key(
    runs_dir: Path, content: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its process was killed before it noted the id, or the note is damaged."""
    folder = RunFolder(runs_dir / f"it's \\ {content!r}".replace("/", ""))
    folder.add_provenance({"started": "2026-01-02T00:00:00+00:00"})
    begin(folder, tracking(runs_dir))
    first, sent = run_id(folder), folder.path / "mlflow.json"
    sent.unlink() if content is None else sent.write_text(content)
    again = tracking(runs_dir)
    begin(folder, again)
    conclude(folder)
    again.finish("FINISHED")
    assert run_id(folder) == first
    assert run_of(runs_dir, folder).info.status == "FINISHED"
    assert capsys.readouterr().err.count("is damaged") == (content is not None)
    # Trained anew under the same key: another run of MLflow.
    for name in ("mlflow.json", "provenance.json"):
        (folder.path / name).unlink()
    folder.add_provenance({"started": "2026-01-03T00:00:00+00:00"})
    begin(folder, tracking(runs_dir))
    assert run_id(folder) != first


def test_mlflow_run_says_what_it_is(runs_dir: Path, finished: RunFolder) -> None:
    store, run = client(runs_dir), run_of(runs_dir, finished)
    assert (run.info.status, run.info.run_name) == ("FINISHED", "grbm seed=0")
    assert next(iter(run.data.metrics)) == "mIoU", "the compare page draws the first one"
    assert run.info.start_time == 1767225600000
    assert {**TAGS, "rgbt.key": finished.path.name}.items() <= run.data.tags.items()
    assert (run.data.params["masker.sigma_div"], len(run.data.params["long"])) == ("2", 500)
    assert "class/car" not in run.data.metrics, "a score that does not exist is not drawn"
    assert "| grbm | 25.00 | 50.00 | 40.00 | 156.25 |" in run.data.tags["mlflow.note.content"]
    table = Path(store.download_artifacts(run.info.run_id, "tables/iou.json"))
    assert json.loads(table.read_text()) == artifact_table(TABLES)
    names = {item.path for item in store.list_artifacts(run.info.run_id)}
    assert {"config.yaml", "provenance.json", "counts_test.npz", "figures", "result.json"} <= names
    experiment = store.get_experiment_by_name("rgbt")
    assert view_tags().items() <= experiment.tags.items()
    assert experiment.artifact_location == (runs_dir / "mlartifacts").as_uri()


def test_a_user_without_a_name_is_tracked(runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that runs as a number: Python knows no name for it."""
    for name in ("LOGNAME", "USER", "LNAME", "USERNAME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 54321)
    folder = RunFolder(runs_dir / "nameless")
    begin(folder, tracking(runs_dir))
    assert run_of(runs_dir, folder).data.tags.items() >= TAGS.items()


def test_replaced_run_and_its_successor_are_two_mlflow_runs(runs_dir: Path) -> None:
    folder, tracker = RunFolder(runs_dir / "again"), tracking(runs_dir)
    for _ in range(2):
        kept = set_aside(folder)
        if kept is not None:
            known = read_description(kept.path)
            assert known is not None
            tracker.refresh(kept, known)
        folder = RunFolder(runs_dir / "again")
        folder.add_provenance({"started": "2026-01-04T00:00:00+00:00"})
        begin(folder, tracker)
        conclude(folder)
        tracker.finish("FINISHED")
    assert kept is not None
    old, new = (run_of(runs_dir, path) for path in (kept, folder))
    assert (old.info.run_name, new.info.run_name) == ("grbm seed=0 (replaced)", "grbm seed=0")
    found = [(run.data.tags["rgbt.key"], run.data.tags["rgbt.group"]) for run in (old, new)]
    assert found == [("replaced/again-1", "grbm (replaced)"), ("again", "grbm")]


def test_a_run_deleted_in_the_pages_is_made_again(runs_dir: Path) -> None:
    folder = RunFolder(runs_dir / "deleted")
    Tracking().start(folder, Description("grbm", TAGS, PARAMS))
    tracker = tracking(runs_dir)
    folder.append(5, "train", {"loss": 3.0})
    first = tracker.sync(folder, "RUNNING")
    store = client(runs_dir)
    store.delete_run(first)
    second = tracker.sync(folder, "RUNNING")
    assert second != first
    assert points(store, second, "train/loss") == [(5, 3.0)]


def test_dead_tracker_warns_once_and_sync_fills_it_later(
    runs_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, files = RunFolder(runs_dir / "dead"), "s3://bucket/files"
    tracker = MlflowTracking(DEAD, artifact_uri=files, runs_dir=str(runs_dir))
    begin(folder, tracker)
    folder.append(5, "train", {"loss": 5.0})
    tracker.update()
    conclude(folder)
    tracker.finish("FAILED")
    warning = capsys.readouterr().err
    assert warning.count("rgbt: MLflow at http://127.0.0.1:9 cannot be used") == 1
    assert f"rgbt sync run={folder.path} uri={DEAD} artifact_uri={files}\n" in warning
    assert code_of(sync.entry, [f"run={folder.path}"]) == 0
    assert run_id(folder) in capsys.readouterr().out
    assert points(client(runs_dir), run_id(folder), "train/loss") == [(5, 5.0)]


def test_sync_continues_behind_a_damaged_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = {"a": "result.json", "b": "run.json", "c": "metrics.jsonl"}
    for key in "abcd":
        begin(RunFolder(tmp_path / key), Tracking())
    for key, name in damaged.items():
        (tmp_path / key / name).write_text("{\n")
    assert read_upload_state(RunFolder(tmp_path / "d")) is None
    assert code_of(sync.entry, [f"runs_dir={tmp_path}"]) == 1
    output = capsys.readouterr()
    for key, name in damaged.items():
        folder = tmp_path / key
        assert f"rgbt: {folder} was not sent ({folder / name} is damaged" in output.err
    assert f"{tmp_path / 'd'}  ->  MLflow run " in output.out
    assert run_of(tmp_path, RunFolder(tmp_path / "d")).info.status == "KILLED"
    for words in ([f"run={tmp_path / 'a'}"], [], ["runs_dir=/nowhere"], ["run=/nowhere"]):
        assert code_of(sync.entry, words) == 2


@pytest.mark.slow
def test_a_store_is_contacted_if_it_lacks_something(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[str] = []
    real = MlflowTracking.sync

    def noted(self: MlflowTracking, folder: RunFolder, status: Any) -> str:
        sent.append(status)
        return real(self, folder, status)

    monkeypatch.setattr(MlflowTracking, "sync", noted)
    folder, tracker = RunFolder(tmp_path / "shown"), tracking(tmp_path)
    tracker.start(folder, Description("grbm seed=0", TAGS, PARAMS))
    assert sent == [], "not before the first step"
    for _ in range(3):
        tracker.after_step()
    tracker.update()
    conclude(folder)
    tracker.finish("FINISHED")
    assert sent == ["RUNNING", "RUNNING", "FINISHED"]

    def refreshed(name: str = "grbm seed=0", **tags: str) -> int:
        sent.clear()
        tracking(tmp_path).refresh(folder, Description(name, {**TAGS, **tags}, PARAMS))
        return len(sent)

    assert refreshed() == 0
    assert (refreshed("other"), refreshed("other")) == (1, 0)
    assert run_of(tmp_path, folder).info.run_name == "other"
    assert (refreshed(row="b"), refreshed()) == (1, 1), "the name and tags of before"
    (folder.path / "evaluations").mkdir()
    for content in (b"counts", b"more counts"):
        (folder.path / "evaluations" / "later.npz").write_bytes(content)
        assert (refreshed(), refreshed()) == (1, 0)
    folder.append(30, "val", {"mIoU": 0.5})
    assert (refreshed(), refreshed()) == (1, 0)
    (tmp_path / "mlflow.db").rename(tmp_path / "away.db")
    assert refreshed() == 1, "the file of the store is missing"


def test_artifact_table_has_unique_first_column_and_summaries_first() -> None:
    table = artifact_table(TABLES)
    firsts = [row[0] for row in table["data"]]
    assert len(set(firsts)) == len(firsts)
    assert firsts[:5] == ["mIoU", "Var", "mIoU day", "mIoU ring 1", "mIoU ring 2"]
    assert table["data"][5:7] == [["road", 50.0, 60.0], ["car", 30.0, None]]
    assert table["data"][-1] == ["car / ring 2", None, None]


def test_sync_hides_the_password_of_a_store_that_refuses(
    runs_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = RunFolder(runs_dir / "key")
    begin(folder, Tracking())
    address = "http://me:Secret@127.0.0.1:9"

    def refuse(*_: object) -> str:
        raise ConnectionError(f"API request to {address}/api failed")

    monkeypatch.setattr(MlflowTracking, "sync", refuse)
    assert code_of(sync.entry, [f"run={folder.path}", f"uri={address}"]) == 1
    error = capsys.readouterr().err
    assert "API request to http://me:***@127.0.0.1:9/api failed" in error
    assert "Secret" not in error
