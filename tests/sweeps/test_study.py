"""`rgbt study` on studies in a journal file, as a user calls it."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import optuna
import pytest
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from sweeps import attributes
from sweeps.study import entry, study_folder
from tests.commands import Call, assert_one_sentence


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What was told to the tracker, which is not asked."""
    calls: list[dict[str, Any]] = []

    def record(tracking: object, **told: Any) -> list[tuple[str, str]]:
        calls.append({"tracking": tracking, **told})
        return [("this run", "http://127.0.0.1:5000/#/run")]

    monkeypatch.setitem(sys.modules, "sweeps.report.records", SimpleNamespace(record=record))
    return calls


def make_study(runs_dir: Path, name: str = "search/grbm", kind: str = "search") -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    runs_dir.mkdir(exist_ok=True)
    storage = JournalStorage(JournalFileBackend(str(runs_dir / "studies.journal")))
    study = optuna.create_study(study_name=name, storage=storage, direction="maximize")
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
    return study


def test_report_of_a_running_study(
    call: Call, tmp_path: Path, recorded: list[dict[str, Any]]
) -> None:
    runs = tmp_path / "runs"
    make_study(runs)
    code, out, err = call(entry, "name=search/grbm", f"runs_dir={runs}", "tracking=none")
    assert (code, err) == (0, "")
    folder = study_folder(runs, "search/grbm")
    assert "Best trials: highest val/mIoU" in out
    assert out.index("50.75") < out.index("50.50") < out.index("50.25")
    assert "48.75" in out
    assert "[Errno 28] disk full" in out
    assert "Importances: they need 10 complete trials, and there are 3." not in out
    assert "No figure importances: they need 10 complete trials, and there are 3." in out
    assert f"dashboard  optuna-dashboard {runs}/studies.journal" in out
    assert str(folder / "study.md") in out
    assert "http://127.0.0.1:5000/#/run" in out
    files = {path.name for path in folder.iterdir()}
    assert files == {"study.md", "trials.csv", "history.png", "parallel.png", "slices.png"}
    text = (folder / "study.md").read_text()
    assert "![Objectives by trial](history.png)" in text
    assert "postgresql://u:***@h/db" in text
    assert "pw" not in text.replace("pwd", "")


def test_the_study_is_recorded_with_its_files_and_numbers(
    call: Call, tmp_path: Path, recorded: list[dict[str, Any]]
) -> None:
    from rgbt.tracking.mlflow_store import MlflowTracking

    runs, out = tmp_path / "runs", tmp_path / "report"
    make_study(runs)
    uri = "tracking.uri=http://127.0.0.1:1"
    assert call(entry, "name=search/grbm", f"runs_dir={runs}", f"out={out}", uri)[0] == 0
    (told,) = recorded
    assert isinstance(told["tracking"], MlflowTracking)
    assert told["tracking"].uri == "http://127.0.0.1:1"
    assert (told["name"], told["kind"]) == ("study search/grbm", "study")
    names = ["study.md", "trials.csv", "history.png", "parallel.png", "slices.png"]
    assert told["files"] == [out / name for name in names]
    assert told["metrics"] == {
        "trials/complete": 3,
        "trials/pruned": 0,
        "trials/failed": 1,
        "trials/running": 1,
        "trials/waiting": 0,
        "best/val/mIoU": 50.75,
    }
    assert told["tags"]["rgbt.study"] == "search/grbm"
    assert "| 50.75 |" in told["note"]
    assert "![" not in told["note"]


def test_a_table_study_has_points_and_no_figures(
    call: Call, tmp_path: Path, recorded: list[dict[str, Any]]
) -> None:
    make_study(tmp_path, "spatialseg/table3", "list")
    code, out, _ = call(entry, "name=spatialseg/table3", f"runs_dir={tmp_path}", "tracking=none")
    assert code == 0
    assert out.index("alpha=0.25") < out.index("alpha=0.75") < out.index("alpha=0.5")
    assert "No figure" not in out
    folder = study_folder(tmp_path, "spatialseg/table3")
    assert {path.name for path in folder.iterdir()} == {"study.md", "trials.csv"}


def test_an_unknown_or_missing_name_lists_the_studies(call: Call, tmp_path: Path) -> None:
    make_study(tmp_path)
    code, _, err = call(entry, "name=search/grb", f"runs_dir={tmp_path}")
    assert code == 2
    assert_one_sentence(err, "there is no study 'search/grb'; did you mean 'search/grbm'?")
    code, _, err = call(entry, f"runs_dir={tmp_path}")
    assert code == 2
    assert_one_sentence(err, "choose a study with name=...; the storage has: search/grbm.")


@pytest.mark.parametrize("storage", ["", "storage={}/other.journal", "storage=sqlite:///{}/a.db"])
def test_a_missing_storage_is_not_made(call: Call, tmp_path: Path, storage: str) -> None:
    given = [storage.format(tmp_path)] if storage else []
    code, _, err = call(entry, "name=x", f"runs_dir={tmp_path}", *given)
    assert code == 2
    assert_one_sentence(err, "there is no storage")
    assert list(tmp_path.iterdir()) == []


def test_folders_of_studies_are_safe_and_differ() -> None:
    runs = Path("runs")
    assert study_folder(runs, "grbm") == Path("runs/studies/grbm")
    names = ["a/b", "a_b", "../../etc", "..", "a b", "x" * 300, "x" * 301]
    folders = {study_folder(runs, name) for name in names}
    assert len(folders) == len(names)
    for folder in folders:
        assert folder.parent == Path("runs/studies")
        assert folder.name not in ("", ".", "..")
        assert len(folder.name) < 100
