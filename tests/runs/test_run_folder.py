"""The run folder: whole files, a lock that dies with its process, results read back and kept."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.files.atomic import is_held, write_atomic
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import (
    Description,
    RunFolder,
    find_run,
    is_finished,
    read_description,
    read_provenance,
    read_result,
    read_tables,
    runs_dir_of,
    runs_in,
    set_aside,
    shown_description,
)
from rgbt.runs.result import RunResult
from rgbt.tables import ClassTable, RegionTable, ResultTables
from rgbt.tracking.sync import Options, folders_of
from tests.measured import measurement, store


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_write_atomic_is_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    path = tmp_path / "a.json"
    for content in (b"older", b"old"):
        write_atomic(path, content)

    def stopped(_: int) -> None:
        raise error

    monkeypatch.setattr(os, "fsync", stopped)
    with pytest.raises(type(error)):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_truncate_drops_what_a_resumed_run_writes_again(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    assert folder.lines() == []
    for step in (10, 20, 30):
        folder.append(step, "train", {"loss": 1.0 / step, "odd": math.nan})
    folder.append(20, "test", {"mIoU": 0.5})
    path = tmp_path / "metrics.jsonl"
    before, whole = folder.lines(), path.read_bytes()
    path.write_bytes(whole[:-1] + b"?")
    with pytest.raises(InputError, match=r"line 4: it does not match its checksum"):
        folder.lines()
    for cut in (whole[:-1], whole + b'{"step": 40, "ki'):  # cut short by a crash
        path.write_bytes(cut)
        assert str(folder.lines()) == str(before), "NaN is not equal to itself"
    assert [(line.step, line.kind) for line in before[2:]] == [(30, "train"), (20, "test")]
    assert json.loads(path.read_text().splitlines()[0])["values"] == {"loss": 0.1, "odd": None}
    assert str(folder.truncate_after(20)) == str(before)
    after = folder.lines()
    assert [(line.step, line.kind) for line in after] == [(10, "train"), (20, "train")]
    assert (after[1].time, math.isnan(after[1].values["odd"])) == (before[1].time, True)
    # Lines of an evaluation that was not committed.
    for step in (20, 30):
        folder.append(step, "val", {"x": 1.0})
    folder.truncate_after(30, 20)
    assert [line.step for line in folder.lines() if line.kind == "val"] == [20]


@pytest.mark.parametrize("text", [b"", b"{", b"\xff", b'{"step": 20}', b"[" * 100_000, b"{}" * 9])
def test_a_damaged_line_is_named(tmp_path: Path, text: bytes) -> None:
    folder = RunFolder(tmp_path)
    folder.append(10, "train", {"loss": 1.0})
    with (tmp_path / "metrics.jsonl").open("ab") as file:
        file.write(text + b"\n")
    for use in (folder.lines, lambda: folder.truncate_after(30)):
        with pytest.raises(InputError, match=r"metrics\.jsonl is damaged \(line 2"):
            use()


@pytest.mark.parametrize(
    "text",
    [
        *("{", "[" * 100_000, '{"datasft": "0123"}', '{"steps": "9"}'),
        *('{"dataset": "0123", "crc32": "00000000"}', '{"dataset": "0123"}'),
    ],
    ids=range(6),
)
def test_a_damaged_result_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "result.json").write_text(text)
    with pytest.raises(InputError, match="result.json"):
        read_result(tmp_path)


def test_lock_refuses_a_second_holder_and_names_the_first(tmp_path: Path) -> None:
    first, second = RunFolder(tmp_path), RunFolder(tmp_path)
    assert not first.is_locked()
    with first.lock():
        (tmp_path / ".last.pt.partial").touch()
        second.clean()
        assert (tmp_path / ".last.pt.partial").exists(), "it may be written now"
        assert second.is_locked()
        with pytest.raises(InputError, match=f"process {os.getpid()} on "), second.lock():
            pass
        assert second.is_locked(), "a refused lock must not free the other's"
    with second.lock():
        pass


FORKING = """
import os, sys, time
from pathlib import Path
from rgbt.files.atomic import holding
with holding(Path(sys.argv[1])):
    child = os.fork()
    if child: print(child, flush=True)
    time.sleep(60)
"""


def test_lock_of_killed_process_is_freed_despite_forked_child(
    tmp_path: Path,
) -> None:
    path = tmp_path / "lock"
    command = [sys.executable, "-c", FORKING, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        assert is_held(path)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        deadline = time.monotonic() + 30
        while is_held(path) and time.monotonic() < deadline:
            time.sleep(0.05)  # the child may not have reached its first instruction yet
        is_free = not is_held(path)
        os.kill(child, signal.SIGKILL)
    assert is_free


def test_what_a_killed_process_left_half_written_is_removed(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    (tmp_path / "lock").write_text("process 4711 on node7")
    (tmp_path / "evaluations").mkdir()
    (tmp_path / "checkpoints" / "3").mkdir(parents=True)
    left = (
        *(".run.json.4711", ".counts_val.npz.4711", "evaluations/.a.npz.4711", ".last.pt.partial"),
        *("checkpoints/3/.best.pt.partial", ".old.json.98"),
    )
    # Of others, that may be at it now; and names that mean something else.
    kept = (".mlflow.json.99", "evaluations/.b.npz.99", "notes.4711", "run.json")
    for name in (*left, *kept):
        (tmp_path / name).touch()
    os.utime(tmp_path / ".old.json.98", (0, 0))
    with folder.lock():
        found = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert found == {*kept, "lock"}


def test_small_files_come_back(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "key")
    provenance = folder.path / "provenance.json"
    assert (read_description(folder.path), read_tables(folder.path)) == (None, None)
    assert read_provenance(provenance) == []
    description = Description("grbm", {"rgbt.seed": "0"}, {"seed": "0"})
    folder.describe(description)
    regions = RegionTable("grbm", (0.5,), 0.5, math.nan)
    classes = ClassTable(("car",), (0.5,), (0.5,), ((0.5,),), {"day": 0.25})
    folder.write_tables(ResultTables("test", 5, ("ring_1",), regions, classes))
    assert read_description(folder.path) == description
    found = read_tables(folder.path)
    assert found is not None
    assert found.classes == classes
    assert math.isnan(found.regions.variance)
    for command, diff in (("a", "--- x\n"), ("b", ""), ("c", "--- y\n")):
        folder.add_provenance({"command": command, "diff": diff})
    entries = [tuple(entry.values()) for entry in read_provenance(provenance)]
    assert entries == [("a", "diff.patch"), ("b", None), ("c", "diff_3.patch")]
    assert (folder.path / "diff.patch").read_text() == "--- x\n"
    assert [run.path for run in runs_in(tmp_path)] == [folder.path]


def test_only_the_process_that_writes_changes_a_folder(tmp_path: Path) -> None:
    written = RunFolder(tmp_path / "key")
    regions = RegionTable("a", (0.5,), 0.5, 0.0)
    classes = ClassTable(("car",), (0.5,), (0.5,), ((0.5,),), {})
    nowhere = tmp_path / "none"
    for folder in (
        written,
        RunFolder(written.path, writes=False),
        RunFolder(nowhere, writes=False),
    ):
        before = {path.name: path.read_bytes() for path in written.path.iterdir()}
        folder.mark({"names": str(len(before)), "files": "b"})
        folder.write_config(f"a: {len(before)}")
        folder.describe(Description(f"grbm {len(before)}", {}, {}))
        folder.add_provenance({"command": "a", "diff": "--- x\n"})
        folder.append(1, "train", {"loss": 0.5})
        folder.append(2, "train", {"loss": 0.25})
        lines = folder.truncate_after(1)
        folder.write_tables(ResultTables("test", len(before), ("ring_1",), regions, classes))
        folder.finish({"name": str(len(before))})
        after = {path.name: path.read_bytes() for path in written.path.iterdir()}
        assert (before == after) == (folder is not written)
        assert len(lines) == {"key": 2 if folder is written else 1, "none": 0}[folder.path.name]
    assert len(after) == 8
    assert not nowhere.exists()


def counts(dataset: str = "d", split: str = "test") -> Counts:
    matrix = np.ones((1, 1, 2, 2), np.int64)
    of = measurement(dataset=dataset, split=split, partition="ring1")
    names, classes = ("a",), ("road", "car")
    return Counts(counts=matrix, names=names, night=None, classes=classes, measurement=of)


@pytest.fixture
def run(tmp_path: Path) -> RunResult:
    folder = RunFolder(tmp_path / "abc")
    folder.describe(Description("a name", {"rgbt.group": "grbm", "rgbt.seed": "3"}, {"k": "v"}))
    folder.add_provenance({"git_commit": "0123456789abcdef", "git_dirty": True, "diff": ""})
    folder.add_provenance({"git_commit": "f" * 16, "diff": ""})
    store(folder.path, counts())
    assert not is_finished(folder.path)
    scores = {"mIoU": 0.25, "Var": 2.5, "region/1": None}
    folder.finish(
        {"name": "a name", "key": "abc", "dataset": "d", "val": {"mIoU": 0.5}, "test": scores}
    )
    return RunResult(folder.path)


def test_run_result_reads_what_the_run_wrote(run: RunResult) -> None:
    assert (run.key, run.run_id, run.fingerprint, run.is_finished) == ("abc", "", "d", True)
    assert (run.description.name, run.tags["rgbt.seed"]) == ("a name", "3")
    assert run.commit == "0123456789+"
    assert run.recorded_scores() == {"val/mIoU": 50.0, "test/mIoU": 25.0, "test/Var": 2.5}

    unfinished = RunResult(run.folder / "none")
    assert (unfinished.is_finished, unfinished.tags, unfinished.commit) == (False, {}, None)
    assert not unfinished.folder.exists(), "reading makes no folder"


def test_measurements_are_those_of_all_files_of_counts(
    run: RunResult, capsys: pytest.CaptureFixture[str]
) -> None:
    store(run.folder, counts(split="val"))
    store(run.folder, counts(), view="thermal")
    store(run.folder, counts(), dataset="0123456789", dataset_name="kp")
    counts().save(run.folder / "a_copy.npz")
    (run.folder / "evaluations/damaged.npz").write_text("no archive")
    found = {path: (of.split, of.view, of.dataset) for path, of in run.measurements().items()}
    assert found == {
        "counts_test.npz": ("test", "rgbt", "d"),
        "counts_val.npz": ("val", "rgbt", "d"),
        "evaluations/test_thermal.npz": ("test", "thermal", "d"),
        "evaluations/test_kp-01234567.npz": ("test", "rgbt", "0123456789"),
    }
    assert capsys.readouterr().err.count("damaged.npz is left out") == 1
    for path, of in run.measurements().items():
        assert run.counts(path).measurement == of


def test_counts_of_another_run_are_refused(run: RunResult) -> None:
    path = store(run.folder, counts(), view="thermal", run="0123456789ab")
    with pytest.raises(InputError, match="has counts of the run 0123456789ab, not of abc"):
        run.counts(f"evaluations/{path.name}")


TAGS = {"rgbt.key": "abc", "rgbt.group": "grbm", "rgbt.seed": "0"}


def finished(tmp_path: Path) -> RunFolder:
    folder = RunFolder(tmp_path / "abc")
    folder.describe(Description("grbm seed=0", TAGS, {}))
    folder.write_config("seed: 0\n")
    folder.finish({"key": "abc"})
    return folder


def test_set_aside_keeps_finished_runs_outside_their_group(tmp_path: Path) -> None:
    kept = [set_aside(finished(tmp_path)), set_aside(finished(tmp_path))]
    paths = [folder.path for folder in kept if folder]
    assert paths == [tmp_path / "replaced" / "abc-1", tmp_path / "replaced" / "abc-2"]
    assert not (tmp_path / "abc").exists()
    assert read_result(paths[0]) == {"key": "abc"}
    assert find_run("replaced/abc-1", tmp_path) == paths[0]
    write_json(paths[1] / "mlflow.json", {"run_id": "f00"})
    assert find_run("f00", tmp_path) == paths[1]

    present = finished(tmp_path)
    assert [run.path for run in runs_in(tmp_path)] == [present.path]
    sent = folders_of(Options(runs_dir=tmp_path))
    assert [run.path for run in sent] == [present.path, *paths]
    assert {runs_dir_of(run) for run in sent} == {tmp_path}
    shown = shown_description(RunFolder(paths[0]))
    replaced = {"rgbt.key": "replaced/abc-1", "rgbt.group": "grbm (replaced)"}
    tags = {**TAGS, **replaced, "rgbt.replaced": "true"}
    assert shown == Description("grbm seed=0 (replaced)", tags, {})
    # A run that trains, and an unfinished one, stay.
    with present.lock(), pytest.raises(InputError, match="is being trained"):
        set_aside(present)
    (present.path / "result.json").unlink()
    assert (set_aside(present), present.path.is_dir()) == (None, True)
