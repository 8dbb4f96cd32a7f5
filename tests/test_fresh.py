"""Results and the code that made them: the warnings, and fresh=true."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from rgbt import evaluate
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import read_provenance, runs_in
from rgbt.runs.result import RunResult
from tests.commands import Call, Trained, only_run, short, train


@pytest.fixture
def runs(trained: Trained, tmp_path: Path) -> Path:
    """A `runs_dir` with one finished run: crm, one step, on files equal to those of `data`."""
    done = trained("+experiment=crm", *short(1))
    shutil.copytree(done, tmp_path / "runs" / done.name)
    return tmp_path / "runs"


def pretend(folder: Path, **changes: Any) -> None:
    """The first process of the run ran other code."""
    first, *others = read_provenance(folder / "provenance.json")
    write_json(folder / "provenance.json", {"processes": [{**first, **changes}, *others]})


@pytest.mark.slow
def test_fresh_retrains_runs_of_other_code_and_keeps_them(
    call: Call, data: Path, runs: Path
) -> None:
    words = (data, runs, "+experiment=crm", *short(1))
    folder = only_run(runs)
    assert "other code" not in train(call, *words)[2]
    pretend(folder, code="0" * 64, git_commit="0" * 40, git_dirty=False)
    before = Counts.load(folder / "counts_test.npz")
    _, _, err = train(call, *words)
    assert "this result was made by other code (commit 0000000000 of" in err

    code, _, err = train(call, *words, "fresh=true")
    assert code == 0, err
    kept = runs / "replaced" / f"{folder.name}-1"
    assert f"open it with run={kept}" in err
    assert RunResult(kept).counts().names == before.names
    code, out, err = call(evaluate.entry, f"run={kept}", "modality=thermal")
    assert code == 0, err
    assert str(kept / "evaluations" / "test_thermal.npz") in out
    assert [run.path for run in runs_in(runs)] == [folder]
    assert (Counts.load(folder / "counts_test.npz").counts == before.counts).all()
    assert "fresh: false" in (folder / "config.yaml").read_text()
    assert "other code" not in train(call, *words)[2]


def test_fresh_resumes_an_unfinished_run_and_names_its_code(
    call: Call, data: Path, runs: Path
) -> None:
    folder, listed = only_run(runs), (data / "train.txt").read_text()
    words = (data, runs, "+experiment=crm", *short(1), "fresh=true")
    (data / "train.txt").unlink()
    assert train(call, *words)[0] == 2
    assert only_run(runs) == folder, "a wrong setting moves nothing"
    (data / "train.txt").write_text(listed)
    (folder / "result.json").unlink()
    pretend(folder, code="0" * 64)
    code, _, err = train(call, *words)
    assert code == 0, err
    assert "warning: the first 1 steps were trained by other code" in err
    assert not (runs / "replaced").exists()
    assert read_provenance(folder / "provenance.json")[-1]["from_step"] == 1
