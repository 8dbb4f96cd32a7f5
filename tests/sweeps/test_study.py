"""`rgbt study` on studies in a file, as a user calls it."""

from __future__ import annotations

from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from sweeps import attributes
from sweeps.report import study as study_report
from sweeps.report.study import study_folder
from sweeps.study import entry
from tests.commands import Call, assert_one_sentence

FILES = {"study.md", "trials.csv"}


def make_study(runs_dir: Path, name: str = "search/grbm", kind: str = "search") -> None:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    url = f"sqlite:///{runs_dir}/studies.db"
    study = optuna.create_study(study_name=name, storage=url, direction="maximize")
    study.set_user_attr(attributes.KIND, kind)
    study.set_user_attr(attributes.METRICS, ["val/mIoU"])
    study.set_user_attr(attributes.COMMAND, "python -m rgbt.run -m storage=postgresql://u:pw@h/db")
    for alpha in (0.25, 0.75, 0.5):
        trial = study.ask()
        trial.suggest_float("masker.alpha", 0, 1)
        trial.set_user_attr(attributes.LABEL, f"alpha={alpha}")
        trial.set_user_attr(attributes.RUNS, [f"key{trial.number}"])
        trial.set_user_attr(attributes.RESULTS, {"val/mIoU": 50 + alpha, "test/mIoU": 48 + alpha})
        study.tell(trial, 50 + alpha)
    failed = study.ask()
    failed.set_user_attr(attributes.REASON, "exit code 1: [Errno 28] disk full")
    study.tell(failed, state=TrialState.FAIL)
    study.ask()  # still running


@pytest.mark.parametrize("installed", [None, "optuna_dashboard"])
def test_study_of_search_is_shown_and_written(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, installed: str | None
) -> None:
    make_study(tmp_path)
    monkeypatch.setattr(study_report, "find_spec", lambda _: installed)
    code, out, err = call(entry, "name=search/grbm", f"runs_dir={tmp_path}")
    assert (code, err) == (0, "")
    folder = study_folder(tmp_path, "search/grbm")
    assert out.index("50.75") < out.index("50.50") < out.index("50.25")
    assert "[Errno 28] disk full" in out
    assert "Importances: they need 10 complete trials, and there are 3." in out
    assert (f"optuna-dashboard sqlite:///{tmp_path}/studies.db" in out) == bool(installed)
    assert {path.name for path in folder.iterdir()} == FILES
    text = (folder / "study.md").read_text()
    assert "postgresql://u:***@h/db" in text
    assert "| 50.75 |" in text


def test_study_unknown_or_missing_name_lists_studies(call: Call, tmp_path: Path) -> None:
    code, _, err = call(entry, "name=x", f"runs_dir={tmp_path}")
    assert code == 2
    assert_one_sentence(err, "there is no storage")
    assert list(tmp_path.iterdir()) == []
    make_study(tmp_path)
    for words in (["name=search/grb"], []):
        code, _, err = call(entry, *words, f"runs_dir={tmp_path}")
        assert code == 2
        assert_one_sentence(err, "search/grbm")


def test_study_folders_are_safe_and_differ() -> None:
    names = ["a/b", "a_b", "../../etc", "..", "a b", "x" * 300, "x" * 301]
    folders = {study_folder(Path("runs"), name) for name in names}
    assert len(folders) == len(names)
    assert all(folder.parent == Path("runs/studies") for folder in folders)
    assert all(folder.name.strip(".") and len(folder.name) < 100 for folder in folders)
