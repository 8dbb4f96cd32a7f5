"""A finished run that is set aside: kept whole, opened by its folder, no second seed."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.tracking.mlflow_store import NoTracking
from rgbt.tracking.replaced_runs import replace_finished, runs_dir_of, set_aside, shown_description
from rgbt.tracking.run_files import Description, read_description, read_result
from rgbt.tracking.run_folder import RunFolder, find_run, runs_in
from rgbt.tracking.sync import Options, folders_of

TAGS = {"rgbt.key": "abc", "rgbt.group": "grbm", "rgbt.seed": "0"}


def begun(tmp_path: Path) -> RunFolder:
    folder = RunFolder(tmp_path / "abc")
    folder.describe(Description("grbm seed=0", TAGS, {}))
    folder.write_config("seed: 0\n")
    return folder


def finished(tmp_path: Path) -> RunFolder:
    folder = begun(tmp_path)
    folder.finish({"key": "abc"})
    return folder


def test_set_aside_keeps_every_finished_run(tmp_path: Path) -> None:
    kept = [set_aside(finished(tmp_path)), set_aside(finished(tmp_path))]
    assert [each.path for each in kept if each] == [
        tmp_path / "replaced" / "abc-1",
        tmp_path / "replaced" / "abc-2",
    ]
    assert not (tmp_path / "abc").exists()
    assert read_result(kept[0].path) == {"key": "abc"}
    assert find_run("replaced/abc-1", tmp_path) == kept[0].path
    (kept[1].path / "mlflow.json").write_text('{"run_id": "f00"}')
    assert find_run("f00", tmp_path) == kept[1].path


def test_set_aside_leaves_an_unfinished_run_and_one_that_trains(tmp_path: Path) -> None:
    assert set_aside(begun(tmp_path)) is None
    folder = finished(tmp_path)
    with folder.lock(), pytest.raises(InputError, match="is being trained"):
        set_aside(folder)
    assert read_result(folder.path) == {"key": "abc"}


def test_a_replaced_run_is_no_run_of_the_folder_but_is_sent(tmp_path: Path) -> None:
    replace_finished(finished(tmp_path), NoTracking())
    present = finished(tmp_path)
    assert [run.path for run in runs_in(tmp_path)] == [present.path]
    sent = folders_of(Options(runs_dir=tmp_path))
    assert [run.path for run in sent] == [present.path, tmp_path / "replaced" / "abc-1"]
    assert {runs_dir_of(run) for run in sent} == {tmp_path}


def test_a_replaced_run_is_shown_outside_of_its_group(tmp_path: Path) -> None:
    replace_finished(finished(tmp_path), NoTracking())
    shown = shown_description(RunFolder(tmp_path / "replaced" / "abc-1"))
    assert shown is not None
    assert shown.name == "grbm seed=0 (replaced)"
    assert shown.tags == {
        "rgbt.key": "replaced/abc-1",
        "rgbt.group": "grbm (replaced)",
        "rgbt.seed": "0",
        "rgbt.replaced": "true",
    }
    present = finished(tmp_path)
    assert shown_description(present) == read_description(present.path)
