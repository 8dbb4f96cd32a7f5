"""The run folder: whole files, a lock that dies with its process, lines without duplicates."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.files.atomic import is_held, write_atomic
from rgbt.tracking.run_files import (
    Description,
    counts_name,
    read_description,
    read_provenance,
    read_result,
    read_tables,
)
from rgbt.tracking.run_folder import RunFolder, runs_in
from rgbt.tracking.tables import ClassTable, RegionTable, ResultTables


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_write_atomic_is_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    path = tmp_path / "a.json"
    for content in (b"older", b"old"):
        write_atomic(path, content)
    assert path.read_bytes() == b"old"

    def stopped(_: int) -> None:
        raise error

    monkeypatch.setattr(os, "fsync", stopped)
    with pytest.raises(type(error)):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert [each.name for each in tmp_path.iterdir()] == ["a.json"]


def test_result_exists_only_when_finished(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "runs" / "key")
    assert read_result(folder.path) is None
    folder.finish({"mIoU": 0.5})
    assert read_result(folder.path) == {"mIoU": 0.5}


def test_lines_are_read_as_written(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    assert folder.lines() == []
    folder.append(10, "train", {"loss": 2.0})
    folder.append(10, "val", {"mIoU": 0.25, "class/bump": math.nan})
    first, second = folder.lines()
    assert (first.step, first.kind, first.values) == (10, "train", {"loss": 2.0})
    assert second.values["mIoU"] == 0.25
    assert math.isnan(second.values["class/bump"])
    written = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[1])
    assert set(written) == {"step", "kind", "time", "values", "crc32"}
    assert written["values"]["class/bump"] is None


def test_truncate_drops_what_a_resumed_run_writes_again(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    for step in (10, 20, 30):
        folder.append(step, "train", {"loss": 1.0 / step, "odd": math.nan})
    folder.append(20, "test", {"mIoU": 0.5})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 40, "ki')  # cut short by a crash
    before = folder.lines()
    assert [line.step for line in before] == [10, 20, 30, 20]
    folder.truncate_after(20)
    after = folder.lines()
    assert [(line.step, line.kind) for line in after] == [(10, "train"), (20, "train")]
    assert after[1].time == before[1].time
    assert math.isnan(after[1].values["odd"])
    folder.append(30, "train", {"loss": 0.1})
    assert [line.step for line in folder.lines()] == [10, 20, 30]
    # Lines of an evaluation that was not committed.
    for step in (20, 30):
        folder.append(step, "val", {"x": 1.0})
    folder.truncate_after(30, 20)
    assert [line.step for line in folder.lines() if line.kind == "val"] == [20]


def logged(tmp_path: Path) -> tuple[RunFolder, list[bytes]]:
    folder = RunFolder(tmp_path)
    for step in (10, 20, 30, 40):
        folder.append(step, "train", {"loss": 1.0 / step})
    return folder, (tmp_path / "metrics.jsonl").read_bytes().splitlines(keepends=True)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda a, b, c, d: [a, b[:30], b"\n", c, d], "line 2: Expecting property"),
        (
            lambda a, b, c, d: [a, b.replace(b"0.05", b"0.07"), c, d],
            "line 2: it does not match its checksum",
        ),
        (lambda a, b, c, d: [a, b"\xff\n", c, d], "line 2: 'utf-8' codec"),
        (lambda a, b, c, d: [a, b'{"step": 20}\n', c, d], "line 2: kind: Field required"),
        (lambda a, b, c, d: [a, b, b, c, d], "line 3: step 20 comes after 20"),
        (lambda a, b, c, d: [c, d, a, b], "line 3: step 10 comes after 40"),
    ],
)
def test_damaged_lines_are_refused_and_a_run_that_resumes_leaves_them_out(
    tmp_path: Path, damage: Callable[..., list[bytes]], reason: str
) -> None:
    folder, lines = logged(tmp_path)
    whole = folder.lines()
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b"".join(damage(*lines)))
    damaged = path.read_bytes()
    with pytest.raises(InputError, match=r"metrics.jsonl is damaged \(line") as caught:
        folder.lines()
    assert reason in str(caught.value)
    assert folder.truncate_after(30).damaged[0].startswith(reason)
    kept = folder.lines()
    assert kept in (whole[:3], [whole[0], whole[2]])
    assert (tmp_path / "metrics.jsonl.damaged").read_bytes() == damaged
    assert folder.truncate_after(30).damaged == []


def test_lines_and_files_of_before_check_sums_are_read(tmp_path: Path) -> None:
    line = {"step": 10, "kind": "val", "time": 1.5, "values": {"mIoU": 0.25}}
    (tmp_path / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    (tmp_path / "result.json").write_text('{"dataset": "0123", "test": {"mIoU": null}}')
    (tmp_path / "provenance.json").write_text('[{"command": "a"}]')
    folder = RunFolder(tmp_path)
    assert folder.lines()[0].values == {"mIoU": 0.25}
    assert read_result(folder.path) == {"dataset": "0123", "test": {"mIoU": None}}
    folder.add_provenance({"command": "b"})
    assert [each["command"] for each in read_provenance(folder.path / "provenance.json")] == [
        "a",
        "b",
    ]
    (tmp_path / "result.json").write_text('{"datasft": "0123"}')
    with pytest.raises(InputError, match="unknown key 'datasft'"):
        read_result(folder.path)


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
    assert not second.is_locked()
    with second.lock():
        pass


def test_lock_is_freed_when_its_process_is_killed_though_a_forked_child_lives_on(
    tmp_path: Path,
) -> None:
    code = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from rgbt.files.atomic import holding\n"
        "with holding(Path(sys.argv[1])):\n"
        "    child = os.fork()\n"
        "    if child: print(child, flush=True)\n"
        "    time.sleep(60)\n"
    )
    path = tmp_path / "lock"
    parent = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    try:
        assert is_held(path)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        deadline = time.monotonic() + 20
        while is_held(path) and time.monotonic() < deadline:
            time.sleep(0.05)  # the child may not have reached its first instruction yet
        assert not is_held(path)
    finally:
        os.kill(child, signal.SIGKILL)
        parent.stdout.close()


def test_provenance_is_a_list_and_the_diff_a_file(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    assert read_provenance(folder.path / "provenance.json") == []
    folder.add_provenance({"command": "a", "diff": "--- x\n"})
    folder.add_provenance({"command": "b", "diff": ""})
    folder.add_provenance({"command": "c", "diff": "--- y\n"})
    assert [
        (entry["command"], entry["diff"])
        for entry in read_provenance(folder.path / "provenance.json")
    ] == [
        ("a", "diff.patch"),
        ("b", None),
        ("c", "diff_3.patch"),
    ]
    assert (tmp_path / "diff.patch").read_text() == "--- x\n"


def test_small_files_come_back(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "key")
    assert (read_description(folder.path), read_tables(folder.path)) == (None, None)
    description = Description("grbm", {"rgbt.seed": "0"}, {"seed": "0"})
    folder.describe(description)
    tables = ResultTables(
        split="test",
        step=5,
        region_names=("ring_1",),
        regions=RegionTable("grbm", (0.5,), 0.5, math.nan),
        classes=ClassTable(("car",), (0.5,), (0.5,), ((0.5,),), {"day": 0.25}),
    )
    folder.write_tables(tables)
    folder.write_config("seed: 0\n")
    assert read_description(folder.path) == description
    found = read_tables(folder.path)
    assert found is not None
    assert found.classes == tables.classes
    assert math.isnan(found.regions.variance)
    assert (folder.path / "config.yaml").read_text() == "seed: 0\n"
    assert counts_name("test") == "counts_test.npz"
    assert folder.figure_path("panel") == folder.path / "figures" / "panel.png"
    assert folder.figure_path("panel").parent.is_dir()
    assert [run.path for run in runs_in(tmp_path)] == [folder.path]


def test_damaged_file_and_missing_folder_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "result.json"
    for text, word in (("{", "is damaged"), ("[" * 100_000, "nested too deeply")):
        path.write_text(text)
        with pytest.raises(InputError, match=word):
            read_result(tmp_path)
    monkeypatch.setenv("RGBT_MAX_JSON_MB", "1")
    path.write_text('{"skipped": [' + '"a", ' * 300_000 + '"a"]}')
    with pytest.raises(InputError, match="set RGBT_MAX_JSON_MB=2"):
        read_result(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        runs_in(tmp_path / "missing")


def test_what_a_killed_process_left_half_written_is_removed(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    (tmp_path / "lock").write_text("process 4711 on node7")
    (tmp_path / "evaluations").mkdir()
    (tmp_path / "checkpoints" / "3").mkdir(parents=True)
    left = (
        *(".run.json.4711", "counts_val.npz.4711.partial", ".last.pt.partial"),
        *("evaluations/a.npz.4711.partial", "checkpoints/3/.best.pt.partial", ".best.pt.partial"),
        *(".last_previous.pt.partial", ".counts_val.npz.partial", ".old.json.98"),
    )
    # Of others, that may be at it now; and names that mean something else.
    kept = (".mlflow.json.99", "evaluations/b.npz.99.partial", "notes.4711", "run.json")
    for name in (*left, *kept):
        (tmp_path / name).touch()
    os.utime(tmp_path / ".old.json.98", (0, 0))
    with folder.lock():
        found = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert found == {*kept, "lock"}
    (tmp_path / f".run.json.{os.getpid()}").touch()
    folder.clean()
    assert not (tmp_path / f".run.json.{os.getpid()}").exists()
