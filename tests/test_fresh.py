"""Results and the code that made them: the warnings, and fresh=true."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from rgbt import evaluate
from rgbt.metrics.counts import Counts
from rgbt.spec import source_code
from rgbt.tracking import other_code
from rgbt.tracking.provenance import code
from rgbt.tracking.run_files import read_description, read_provenance
from rgbt.tracking.run_folder import runs_in
from tests.commands import Call, Trained, only_run, short, train

MADE_BY_OTHER_CODE = "this result was made by other code (commit 0000000 of"


@pytest.fixture
def runs(trained: Trained, tmp_path: Path) -> Path:
    """A `runs_dir` with one finished run: crm, one step, on files equal to those of `data`."""
    done = trained("+experiment=crm", *short(1))
    shutil.copytree(done, tmp_path / "runs" / done.name)
    return tmp_path / "runs"


def pretend(folder: Path, **changes: Any) -> None:
    """The first process of the run ran other code."""
    first, *others = read_provenance(folder / "provenance.json")
    (folder / "provenance.json").write_text(json.dumps([{**first, **changes}, *others]))


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
    assert MADE_BY_OTHER_CODE in err
    assert "fresh=true trains the run again and keeps the old result" in err

    code, _, err = train(call, *words, "fresh=true")
    assert code == 0, err
    kept = runs / "replaced" / f"{folder.name}-1"
    assert f"open it with run={kept}" in err
    assert (kept / "best.pt").is_file()
    assert [run.path for run in runs_in(runs)] == [folder]
    assert (Counts.load(folder / "counts_test.npz").counts == before.counts).all()
    assert "fresh: false" in (folder / "config.yaml").read_text()
    known = read_description(folder)
    assert known is not None
    assert "fresh" not in known.params
    assert "fresh" not in known.tags["rgbt.group"]
    assert "other code" not in train(call, *words)[2]


def test_fresh_resumes_an_unfinished_run_and_names_its_code(
    call: Call, data: Path, runs: Path
) -> None:
    folder = only_run(runs)
    (folder / "result.json").unlink()
    pretend(folder, code="0" * 64)
    code, _, err = train(call, data, runs, "+experiment=crm", *short(1), "fresh=true")
    assert code == 0, err
    assert "warning: the first 1 steps were trained by other code" in err
    assert not (runs / "replaced").exists()
    assert read_provenance(folder / "provenance.json")[-1]["from_step"] == 1


def test_a_wrong_setting_with_fresh_moves_nothing(call: Call, data: Path, runs: Path) -> None:
    (data / "train.txt").unlink()
    code, _, err = train(call, data, runs, "+experiment=crm", *short(1), "fresh=true")
    assert code == 2, err
    assert only_run(runs).is_dir()
    assert not (runs / "replaced").exists()


def test_changed_tests_or_documents_are_no_other_code(
    call: Call, data: Path, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = {**code(), "git_commit": "0" * 40, "git_dirty": True, "diff": "+a sentence\n"}
    monkeypatch.setattr(other_code, "code", lambda: moved)
    assert "other code" not in train(call, data, runs, "+experiment=crm", *short(1))[2]


OWN_LOSS = """
from rgbt.losses.cross_entropy import CrossEntropy


class Scaled(CrossEntropy):
    def __call__(self, *inputs):
        return {name: FACTOR * loss for name, loss in super().__call__(*inputs).items()}
"""


def test_changed_user_loss_is_another_run(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "conf" / "loss").mkdir(parents=True)
    (tmp_path / "conf" / "loss" / "scaled.yaml").write_text(
        "_target_: my_scaled_loss.Scaled\nclass_weights: null\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    search = f"hydra.searchpath=[file://{tmp_path / 'conf'}]"
    own = ("loss=scaled", search, "masker.patch_size=null")
    words = (data, tmp_path / "runs", "+experiment=mfnet", *own, *short(1))

    def losses(factor: float) -> list[float]:
        """Of all runs, after the command was given with this code in a new process."""
        (tmp_path / "my_scaled_loss.py").write_text(f"FACTOR = {factor}\n{OWN_LOSS}")
        sys.modules.pop("my_scaled_loss", None)
        source_code._used_by.clear()
        code, _, err = train(call, *words)
        assert code == 0, err
        found = runs_in(tmp_path / "runs")
        return sorted(run.lines()[0].values["loss"] for run in found)

    (once,) = losses(1.0)
    assert losses(3.0) == pytest.approx([once, 3 * once])
    assert losses(1.0) == pytest.approx([once, 3 * once]), "the first run again"

    entry = evaluate.entry
    for run in runs_in(tmp_path / "runs"):
        code, _, err = call(entry, f"run={run.path}", "trust=my_scaled_loss")
        assert code == 0, err
        is_other = run.lines()[0].values["loss"] > 2 * once
        said = f"warning: my_scaled_loss changed after {run.path.name} was trained"
        assert (said in err) == is_other
