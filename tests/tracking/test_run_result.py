"""A finished run: what is read from its folder, and the messages for missing files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.tracking.run_files import Description, counts_name
from rgbt.tracking.run_folder import RunFolder
from rgbt.tracking.run_result import RunResult


def counts(dataset: str = "d", split: str = "test") -> Counts:
    return Counts(
        counts=np.ones((1, 1, 2, 2), np.int64),
        names=("a",),
        night=None,
        classes=("road", "car"),
        partition="ring1",
        dataset=dataset,
        split=split,
    )


@pytest.fixture
def run(tmp_path: Path) -> RunResult:
    folder = RunFolder(tmp_path / "abc")
    folder.describe(Description("a name", {"rgbt.group": "grbm", "rgbt.seed": "3"}, {"k": "v"}))
    folder.add_provenance({"git_commit": "0123456789abcdef", "git_dirty": True, "diff": ""})
    folder.add_provenance({"git_commit": "f" * 16, "diff": ""})
    counts().save(folder.path / counts_name("test"))
    scores = {"mIoU": 0.25, "Var": 2.5, "region/1": None}
    folder.finish({"name": "a name", "dataset": "d", "val": {"mIoU": 0.5}, "test": scores})
    return RunResult(folder.path)


def test_run_result_reads_what_the_run_wrote(run: RunResult) -> None:
    assert (run.key, run.run_id, run.dataset, run.is_finished) == ("abc", "", "d", True)
    assert (run.description.name, run.description.params) == ("a name", {"k": "v"})
    assert run.tags == {"rgbt.group": "grbm", "rgbt.seed": "3"}
    assert run.commit == "0123456789+"
    assert [each["git_commit"][0] for each in run.provenance] == ["0", "f"]


def test_scores_are_in_percent_without_missing_ones(run: RunResult) -> None:
    assert run.scores() == {"val/mIoU": 50.0, "test/mIoU": 25.0, "test/Var": 2.5}


def test_result_of_unfinished_run_is_refused(tmp_path: Path) -> None:
    run = RunResult(tmp_path / "none")
    assert not run.is_finished
    assert (run.tags, run.commit) == ({}, None)
    with pytest.raises(InputError, match=r"result\.json is missing or names no data set"):
        _ = run.dataset
    assert not run.folder.exists(), "reading makes no folder"


def test_counts_are_of_the_run_or_of_an_evaluation(run: RunResult) -> None:
    counts(split="val").save(run.folder / "more.npz")
    assert run.counts().split == "test"
    assert run.counts("more.npz").split == "val"
    with pytest.raises(InputError, match=r"none\.npz"):
        run.counts("none.npz")


def test_has_counts_wants_test_counts_of_this_training(run: RunResult) -> None:
    counts("other").save(run.folder / "other.npz")
    counts(split="val").save(run.folder / "val.npz")
    (run.folder / "damaged.npz").write_text("no archive")
    for name in ("none.npz", "other.npz", "val.npz", "damaged.npz"):
        assert not run.has_counts(name), name
    assert run.has_counts("counts_test.npz")
    assert run.has_counts("counts_test.npz", other_dataset=True)
    assert run.has_counts("other.npz", other_dataset=True)
    assert not run.has_counts("val.npz", other_dataset=True)
    (run.folder / "best.pt").touch()
    written = (run.folder / "best.pt").stat().st_mtime
    os.utime(run.folder / "counts_test.npz", (written - 9, written - 9))
    assert not run.has_counts("counts_test.npz")
