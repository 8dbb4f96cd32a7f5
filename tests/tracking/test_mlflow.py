"""MLflow filled from run folders: live, later, again, and with no store at all."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.files.atomic import holding
from rgbt.metrics.names import shown
from rgbt.tracking import mlflow_client, sync
from rgbt.tracking.mlflow_store import MlflowTracking, NoTracking
from rgbt.tracking.mlflow_upload import (
    UploadState,
    artifact_table,
    read_upload_state,
    write_upload_state,
)
from rgbt.tracking.mlflow_view import view_tags
from rgbt.tracking.replaced_runs import replace_finished
from rgbt.tracking.run_files import Description, counts_name
from rgbt.tracking.run_folder import RunFolder
from rgbt.tracking.tables import ClassTable, RegionTable, ResultTables
from tests.commands import code_of

CONF = Path(__file__).resolve().parents[2] / "conf" / "tracking"
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


def begin(folder: RunFolder, tracker: MlflowTracking | NoTracking) -> None:
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


def points(store: Any, run_id: str, name: str) -> list[tuple[int, float]]:
    return [(point.step, point.value) for point in store.get_metric_history(run_id, name)]


@pytest.fixture(scope="module")
def finished(runs_dir: Path) -> RunFolder:
    """A run killed after step 10 with its checkpoint at step 5, continued, finished."""
    folder = RunFolder(runs_dir / "killed")
    folder.write_config("seed: 0\n")
    folder.add_provenance({"command": "python -m rgbt.run", "started": "2026-01-01T00:00:00+00:00"})
    first = tracking(runs_dir)
    begin(folder, first)
    folder.append(5, "train", {"loss": 3.0})
    folder.append(10, "train", {"loss": 2.0})
    folder.append(10, "val", {"mIoU": 0.123456})
    first.update()
    first.update()
    (folder.path / "first_run_id").write_text(run_id(folder))

    # The lines beyond the checkpoint are written again, at another time.
    folder.truncate_after(5)
    second = tracking(runs_dir)
    begin(folder, second)
    folder.append(10, "train", {"loss": 2.0})
    folder.append(10, "val", {"mIoU": 0.123456})
    folder.append(15, "train", {"loss": 1.0})
    second.update()
    conclude(folder)
    second.finish("FINISHED")
    second.finish("FINISHED")
    return folder


def run_id(folder: RunFolder) -> str:
    sent = read_upload_state(folder)
    assert sent is not None
    assert sent.run_id
    return sent.run_id


def test_a_killed_run_continues_in_the_same_mlflow_run_without_duplicates(
    runs_dir: Path, finished: RunFolder
) -> None:
    store, run = client(runs_dir), run_id(finished)
    assert run == (finished.path / "first_run_id").read_text()
    assert points(store, run, "train/loss") == [(5, 3.0), (10, 2.0), (15, 1.0)]
    assert points(store, run, "val/mIoU") == [(10, 12.35)]
    assert points(store, run, "mIoU") == [(0, 40.0)]
    assert points(store, run, "Var") == [(0, 156.25)]
    assert points(store, run, "profile/iou_by_region") == [(1, 25.0), (2, 50.0)]


def test_sending_lines_again_after_a_crash_leaves_no_duplicate(runs_dir: Path) -> None:
    folder = RunFolder(runs_dir / "crashed")
    NoTracking().start(folder, Description("grbm", TAGS, PARAMS))
    folder.append(5, "train", {"loss": 3.0})
    conclude(folder)
    tracking(runs_dir).sync(folder, "FINISHED")
    sent = read_upload_state(folder)
    assert sent is not None
    write_upload_state(folder, replace(sent, steps={}, profile=False))
    tracking(runs_dir).sync(folder, "FINISHED")
    assert points(client(runs_dir), sent.run_id, "train/loss") == [(5, 3.0)]
    assert points(client(runs_dir), sent.run_id, "profile/iou_by_region") == [(1, 25.0), (2, 50.0)]
    assert read_upload_state(folder) == sent


def unnoted(runs_dir: Path, name: str) -> RunFolder:
    """A folder whose MLflow run was made by a process that was killed before it noted the id."""
    folder = RunFolder(runs_dir / name)
    folder.add_provenance({"started": "2026-01-02T00:00:00+00:00"})
    begin(folder, tracking(runs_dir))
    return folder


@pytest.mark.parametrize(
    ("name", "content"), [('it\'s \\ "unnoted"', None), ("unnoted", ""), ("other", '{"uri": 3')]
)
def test_run_without_noted_id_is_identified_by_its_key(
    runs_dir: Path,
    name: str,
    content: str | None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = unnoted(runs_dir, f"{name} {content!r}".replace("/", ""))
    first = run_id(folder)
    sent = folder.path / "mlflow.json"
    sent.unlink() if content is None else sent.write_text(content)
    again = tracking(runs_dir)
    begin(folder, again)
    conclude(folder)
    again.finish("FINISHED")
    assert run_id(folder) == first
    assert client(runs_dir).get_run(first).info.status == "FINISHED"
    said = capsys.readouterr().err
    assert said.count("is damaged") == (0 if content is None else 1)
    assert "Traceback" not in said


def test_a_run_trained_anew_under_the_same_key_is_another_mlflow_run(runs_dir: Path) -> None:
    folder = unnoted(runs_dir, "anew")
    first = run_id(folder)
    (folder.path / "mlflow.json").unlink()
    (folder.path / "provenance.json").unlink()
    folder.add_provenance({"started": "2026-01-03T00:00:00+00:00"})
    begin(folder, tracking(runs_dir))
    assert run_id(folder) != first


def test_mlflow_run_says_what_it_is(runs_dir: Path, finished: RunFolder) -> None:
    store = client(runs_dir)
    run = store.get_run(run_id(finished))
    assert run.info.status == "FINISHED"
    assert run.info.run_name == "grbm seed=0"
    assert run.info.start_time == 1767225600000
    assert TAGS.items() <= run.data.tags.items()
    assert run.data.tags["rgbt.key"] == finished.path.name
    assert run.data.params["masker.sigma_div"] == "2"
    assert len(run.data.params["long"]) == 500
    assert "class/car" not in run.data.metrics, "a score that does not exist is not drawn"
    assert "| grbm | 25.00 | 50.00 | 40.00 | 156.25 |" in run.data.tags["mlflow.note.content"]
    table = Path(store.download_artifacts(run.info.run_id, "tables/iou.json"))
    assert json.loads(table.read_text()) == artifact_table(TABLES)
    logged = json.loads(run.data.tags["mlflow.loggedArtifacts"])
    assert logged == [{"path": "tables/iou.json", "type": "table"}]
    names = {item.path for item in store.list_artifacts(run.info.run_id)}
    assert {"config.yaml", "provenance.json", "counts_test.npz", "figures", "result.json"} <= names
    experiment = store.get_experiment_by_name("rgbt")
    assert view_tags().items() <= experiment.tags.items()
    assert experiment.artifact_location == (runs_dir / "mlartifacts").as_uri()
    assert max(map(len, view_tags().values())) < 5000, "MLflow's limit on a tag"


def test_a_run_without_a_result_ends_as_failed_and_can_go_on(runs_dir: Path) -> None:
    folder = RunFolder(runs_dir / "failed")
    tracker = tracking(runs_dir)
    begin(folder, tracker)
    tracker.finish("FAILED")
    sent = read_upload_state(folder)
    assert sent is not None
    store = client(runs_dir)
    assert store.get_run(sent.run_id).info.status == "FAILED"
    tracker.start(folder, Description("grbm sigma_div=4 seed=0", TAGS, PARAMS))
    tracker.update()
    info = store.get_run(sent.run_id).info
    assert (info.status, info.run_name) == ("RUNNING", "grbm sigma_div=4 seed=0")


def test_a_replaced_run_is_another_mlflow_run_than_what_replaces_it(runs_dir: Path) -> None:
    folder = RunFolder(runs_dir / "again")
    folder.add_provenance({"started": "2026-01-04T00:00:00+00:00"})
    tracker = tracking(runs_dir)
    ids = []
    for _ in range(2):
        begin(folder, tracker)
        conclude(folder)
        tracker.finish("FINISHED")
        ids.append(run_id(folder))
        if len(ids) == 1:
            replace_finished(folder, tracker)
            folder = RunFolder(runs_dir / "again")
    old, new = (client(runs_dir).get_run(each) for each in ids)
    assert (old.info.run_name, new.info.run_name) == ("grbm seed=0 (replaced)", "grbm seed=0")
    assert (old.info.status, new.info.status) == ("FINISHED", "FINISHED")
    kept = RunFolder(runs_dir / "replaced" / "again-1")
    (kept.path / "mlflow.json").unlink()
    begin(kept, tracking(runs_dir))
    assert run_id(kept) == ids[0], "found again where its id was not noted"
    keys = ("rgbt.key", "rgbt.group", "rgbt.replaced")
    assert [old.data.tags.get(key) for key in keys] == [
        *("replaced/again-1", "grbm (replaced)", "true"),
    ]
    assert [new.data.tags.get(key) for key in keys] == ["again", "grbm", None]


def test_a_run_deleted_in_the_pages_is_made_again(runs_dir: Path) -> None:
    folder = RunFolder(runs_dir / "deleted")
    NoTracking().start(folder, Description("grbm", TAGS, PARAMS))
    tracker = tracking(runs_dir)
    folder.append(5, "train", {"loss": 3.0})
    first = tracker.sync(folder, "RUNNING")
    store = client(runs_dir)
    store.delete_run(first)
    second = tracker.sync(folder, "RUNNING")
    assert second != first
    assert points(store, second, "train/loss") == [(5, 3.0)]


def test_dead_tracker_warns_once_and_a_later_sync_fills_it(
    runs_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = RunFolder(runs_dir / "dead")
    tracker = tracking(runs_dir, DEAD)
    begin(folder, tracker)
    for step in (5, 10):
        folder.append(step, "train", {"loss": float(step)})
        tracker.update()
    conclude(folder)
    tracker.finish("FAILED")
    warning = capsys.readouterr().err
    assert warning.count("rgbt: MLflow at http://127.0.0.1:9 cannot be used") == 1
    assert f"-m rgbt.tracking.sync run={folder.path}" in warning
    assert tracker.links()[0][0] == "MLflow later"

    uri = f"sqlite:///{runs_dir / 'mlflow.db'}"
    assert code_of(sync.entry, [f"run={folder.path}", f"uri={uri}"]) == 0
    assert code_of(sync.entry, [f"run={folder.path}"]) == 0, "the requested store is remembered"
    sent = read_upload_state(folder)
    assert sent is not None
    assert sent.uri == uri
    assert sent.run_id in capsys.readouterr().out
    assert points(client(runs_dir), sent.run_id, "train/loss") == [(5, 5.0), (10, 10.0)]


def test_sync_of_all_folders_sends_runs_made_without_tracker(
    runs_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = RunFolder(runs_dir / "untracked")
    tracker = NoTracking()
    begin(folder, tracker)
    tracker.update()
    tracker.finish("FAILED")
    assert tracker.links() == []
    assert read_upload_state(folder) is None
    shutil.rmtree(runs_dir / "dead", ignore_errors=True)  # has no reachable store if it ran alone
    assert code_of(sync.entry, [f"runs_dir={runs_dir}"]) == 0
    output = capsys.readouterr().out
    assert f"{folder.path}  ->  MLflow run " in output
    assert "mlflow ui --workers 1 --backend-store-uri sqlite:///" in output
    sent = read_upload_state(folder)
    assert sent is not None
    assert client(runs_dir).get_run(sent.run_id).info.status == "KILLED"


def test_sync_of_all_folders_sends_those_behind_a_damaged_one(
    runs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    uri = f"uri=sqlite:///{runs_dir / 'mlflow.db'}"
    damaged = {"a": "result.json", "b": "mlflow.json", "c": "metrics.jsonl"}
    for key in "abcd":
        begin(RunFolder(tmp_path / key), NoTracking())
    for key, name in damaged.items():
        (tmp_path / key / name).write_text("{\n")
    assert code_of(sync.entry, [f"runs_dir={tmp_path}", uri]) == 1
    output = capsys.readouterr()
    for key, name in damaged.items():
        folder = tmp_path / key
        assert f"rgbt: {folder} was not sent ({folder / name} is damaged" in output.err
    assert f"{tmp_path / 'd'}  ->  MLflow run " in output.out
    assert code_of(sync.entry, [f"run={tmp_path / 'a'}"]) == 2


def test_a_damaged_log_and_a_held_lock_do_not_halt_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(mlflow_client, "LOCK_WAIT_S", 0.3)
    monkeypatch.setattr(mlflow_client, "QUIET_WAIT_S", 0.1)
    for name in "abc":
        begin(RunFolder(tmp_path / name), NoTracking())
    folder, tracker = RunFolder(tmp_path / "waits"), tracking(tmp_path)
    with holding(tmp_path / ".mlflow.db.lock"):
        begin(folder, tracker)
        tracker.finish("FINISHED")
        said = capsys.readouterr().err
        assert said.count("waiting for process") == 2, "at the start and at the end"
        assert said.count("cannot be used") == 1
        assert re.search(r"StoreBusyError: process \d+ on .* has held ", said)
        assert "To send it later: `" in said
        assert f"rgbt.tracking.sync run={folder.path}`" in said
        # A sync of many runs waits once.
        assert code_of(sync.entry, [f"runs_dir={tmp_path}"]) == 1
        said = capsys.readouterr().err
        assert (said.count("waiting for process"), said.count("was not sent")) == (1, 4)
    assert code_of(sync.entry, [f"run={folder.path}"]) == 0
    assert run_id(folder)
    capsys.readouterr()
    # The store works; the run repairs its log when it resumes.
    tracker = tracking(tmp_path)
    (folder.path / "metrics.jsonl").write_text("{\n")
    begin(folder, tracker)
    assert "not sent to MLflow:" in capsys.readouterr().err
    folder.truncate_after(0)
    folder.append(5, "train", {"loss": 3.0})
    tracker.update()
    assert points(client(tmp_path), run_id(folder), "train/loss") == [(5, 3.0)]
    assert capsys.readouterr().err == ""


def test_a_store_is_contacted_after_the_first_step_and_not_at_every_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    contacts: list[str] = []
    monkeypatch.setattr(MlflowTracking, "sync", lambda _, __, status: contacts.append(status))
    folder, tracker = RunFolder(tmp_path / "late"), tracking(tmp_path)
    tracker.start(folder, Description("grbm seed=0", TAGS, PARAMS))
    assert contacts == []
    sent = read_upload_state(folder)
    assert sent is not None, "a run that is killed now is sent to this store by rgbt sync"
    assert sent.uri == tracker.uri
    for _ in range(3):
        tracker.after_step()
    assert contacts == ["RUNNING"]
    tracker.update()
    tracker.finish("FINISHED")
    assert contacts == ["RUNNING", "RUNNING", "FINISHED"]


def test_a_finished_run_is_sent_again_only_if_the_store_lacks_something(
    runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder(runs_dir / "shown")
    folder.add_provenance({"started": "2026-01-05T00:00:00+00:00"})
    tracker = tracking(runs_dir)
    begin(folder, tracker)
    conclude(folder)
    tracker.finish("FINISHED")
    sent: list[str] = []
    real = MlflowTracking.sync

    def noted(self: MlflowTracking, folder: RunFolder, status: Any) -> str:
        sent.append(status)
        return real(self, folder, status)

    monkeypatch.setattr(MlflowTracking, "sync", noted)

    def refreshed(name: str = "grbm seed=0", tags: dict[str, str] = TAGS) -> list[str]:
        sent.clear()
        tracker = tracking(runs_dir)
        tracker.refresh(folder, Description(name, tags, PARAMS))
        assert tracker.links()[-3][0] == "this run"
        return list(sent)

    assert refreshed() == []
    assert refreshed("sigma_div=4 seed=0 · grbm") == ["FINISHED"]
    assert client(runs_dir).get_run(run_id(folder)).info.run_name == "sigma_div=4 seed=0 · grbm"
    assert refreshed("sigma_div=4 seed=0 · grbm") == []
    assert refreshed(tags={**TAGS, "row": "b"}) == ["FINISHED"]
    assert refreshed() == ["FINISHED"], "the name and tags of before"
    (folder.path / "evaluations").mkdir()
    (folder.path / "evaluations" / "later.npz").write_bytes(b"counts")
    assert refreshed() == ["FINISHED"]
    assert refreshed() == []
    (folder.path / "evaluations" / "later.npz").write_bytes(b"more counts")
    assert refreshed() == ["FINISHED"]
    folder.append(30, "val", {"mIoU": 0.5})
    assert refreshed() == ["FINISHED"]
    assert refreshed() == []
    record = read_upload_state(folder)
    assert record is not None
    write_upload_state(folder, replace(record, shown=""))
    assert refreshed() == ["FINISHED"], "a record of an older version"
    database = runs_dir / "mlflow.db"
    database.rename(runs_dir / "away.db")
    monkeypatch.setattr(MlflowTracking, "sync", lambda *arguments: sent.append(arguments[-1]))
    assert refreshed() == ["FINISHED"], "the file of the store is missing"
    (runs_dir / "away.db").rename(database)


def test_links_open_the_pages(runs_dir: Path) -> None:
    tracker = tracking(runs_dir)
    begin(RunFolder(runs_dir / "links"), tracker)
    links = dict(tracker.links())
    assert links["open MLflow"].endswith(f"sqlite:///{runs_dir / 'mlflow.db'}")
    assert links["compare runs"].startswith("http://127.0.0.1:50")
    assert "viewStateShareKey=rgbt-runs" in links["compare runs"]


@pytest.mark.slow
def test_many_processes_may_start_on_a_fresh_store(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "from rgbt.tracking.run_files import Description\n"
        "from rgbt.tracking.run_folder import RunFolder\n"
        "from rgbt.tracking.mlflow_store import MlflowTracking\n"
        "runs, key = sys.argv[1:]\n"
        "t = MlflowTracking(None, artifact_uri=None, experiment='rgbt', runs_dir=runs)\n"
        "t.start(RunFolder(f'{runs}/{key}'), Description(key, {}, {}))\n"
        "t.after_step()\n"
    )
    workers = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path), key], stderr=subprocess.PIPE, text=True
        )
        for key in "abcd"
    ]
    errors = [worker.communicate()[1] for worker in workers]
    assert errors == [""] * 4, "no warning of ours, no noise of MLflow's"
    assert len(client(tmp_path).search_runs(["1"])) == 4


def test_values_are_shown_as_the_papers_print_them() -> None:
    assert shown("mIoU", 0.61236) == 61.24
    assert shown("night/mIoU", 0.5) == 50.0
    assert shown("region/1", 0.55283) == 55.28
    assert shown("class/car", 0.1) == 10.0
    assert shown("day/Var", 10.899) == 10.9
    assert shown("loss/class", 0.123456) == 0.123456
    assert shown("seconds", 0.123456) == 0.123456


def test_artifact_table_has_unique_first_column_and_summaries_first() -> None:
    table = artifact_table(TABLES)
    assert table["columns"] == ["score", "IoU %", "accuracy %"]
    firsts = [row[0] for row in table["data"]]
    assert len(set(firsts)) == len(firsts)
    assert firsts[:5] == ["mIoU", "Var", "mIoU day", "mIoU ring 1", "mIoU ring 2"]
    assert table["data"][5:7] == [["road", 50.0, 60.0], ["car", 30.0, None]]
    assert table["data"][-1] == ["car / ring 2", None, None]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "expected either run=<run folder> or runs_dir=<folder of runs>"),
        (["run=a", "runs_dir=b"], "expected either run="),
        (["runs_dir=/nowhere"], "does not exist"),
        (["run=/nowhere"], "not a run folder"),
    ],
)
def test_sync_refuses_in_one_sentence(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(sync.entry, words) == 2
    error = capsys.readouterr().err
    assert error.startswith("rgbt: ")
    assert sentence in error
    assert error.count("\n") == 1


def test_sync_hides_the_password_of_a_store_that_refuses(
    runs_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = RunFolder(runs_dir / "key")
    begin(folder, NoTracking())
    address = "http://me:Secret@127.0.0.1:9"

    def refuse(*_: object) -> str:
        raise ConnectionError(f"API request to {address}/api failed")

    monkeypatch.setattr(MlflowTracking, "sync", refuse)
    assert code_of(sync.entry, [f"run={folder.path}", f"uri={address}"]) == 1
    error = capsys.readouterr().err
    assert "was not sent (API request to http://me:***@127.0.0.1:9/api failed)" in error
    assert "Secret" not in error


def test_a_store_is_the_same_however_much_of_its_address_was_hidden(tmp_path: Path) -> None:
    uri, hidden = (
        "postgresql://u:123/abc@h/db?sslpassword=x",
        "postgresql://u:***@h/db?sslpassword=***",
    )
    partly = "postgresql://u:123/abc@h/db?sslpassword=***"
    folder, place = RunFolder(tmp_path / "run"), "sftp://u:pw@h/files"
    store = MlflowTracking(uri, artifact_uri=place, experiment="e", runs_dir=str(tmp_path))
    assert store._sent(folder) == UploadState(hidden, "e", "sftp://u:***@h/files")
    for stored in (hidden, uri, partly, "postgresql://u:***@h/db?sslpassword=x"):
        write_upload_state(folder, UploadState(stored, "e", None, "1", "the run"))
        assert store._sent(folder) == UploadState(hidden, "e", None, "1", "the run")
    write_upload_state(folder, UploadState(f"{hidden}&y=1", "e", None, "1", "the run"))
    assert store._sent(folder).run_id == ""


@pytest.mark.parametrize(
    ("state", "key"),
    [
        (UploadState("postgresql://u:***@h/db", "e"), "uri"),
        (UploadState("https://***@h", "e"), "uri"),
        (UploadState("http://h:5000", "e", "sftp://u:***@h/files"), "artifact_uri"),
    ],
)
def test_a_password_that_is_not_kept_must_be_given(
    tmp_path: Path, state: UploadState, key: str
) -> None:
    folder = RunFolder(tmp_path / "run")
    write_upload_state(folder, state)
    with pytest.raises(InputError, match=rf"give {key}=\.\.\. with the password"):
        sync.tracking_of(folder, sync.Options(run=folder.path))
    given = sync.Options(run=folder.path, **{key: "sftp://u:pw@h/files"})
    assert sync.tracking_of(folder, given).experiment == "e"


@pytest.mark.parametrize(
    "uri", ["postgresql://u:123/abc@127.0.0.1:9/db", "mysql+pymysql://127.0.0.1:9/db"]
)
def test_a_database_that_nobody_serves_is_reported_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], uri: str
) -> None:
    started = time.monotonic()
    begin(RunFolder(tmp_path / "away"), tracking(tmp_path, uri))
    assert time.monotonic() - started < 10, "MLflow itself tries for minutes"
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "(ConnectionRefusedError: " in said
