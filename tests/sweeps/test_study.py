"""`rgbt study`: results of a study as tables and files, with values by hand."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.trial import TrialState, create_trial

from sweeps import attributes, study
from sweeps.run.optuna_study import driving, storage_url, study_folder
from sweeps.study import entry, importances, trials_frame
from tests.commands import Call, assert_one_sentence

ALPHA = FloatDistribution(0, 1)
SIZES = CategoricalDistribution(("${px:64}", "${px:8}"))
DIRECTIONS = {"val/mIoU": "maximize", "val/Var": "minimize", "up": "maximize", "down": "minimize"}


def new_study(*metrics: str, **where: Any) -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    directions = [DIRECTIONS[metric] for metric in metrics]
    made = optuna.create_study(**{"study_name": "s", "directions": directions, **where})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # experimental
        made.set_metric_names(list(metrics))
    return made


def add(
    to: optuna.Study,
    values: Sequence[float] | None = None,
    *,
    state: str = "COMPLETE",
    params: Mapping[str, Any] = {},  # noqa: B006 - nobody changes it
    reported: Mapping[int, float] = {},  # noqa: B006
    **attrs: Any,
) -> None:
    """A text among `params` is one of the choices `SIZES`, a number lies in 0..1."""
    trial = create_trial(
        state=TrialState[state],
        values=values,
        params=dict(params),
        distributions={k: SIZES if isinstance(v, str) else ALPHA for k, v in params.items()},
        intermediate_values=dict(reported),
        user_attrs={f"rgbt.{name}": value for name, value in attrs.items()},
    )
    to.add_trial(trial)


def test_trials_grid_sorts_by_objective_direction() -> None:
    made = new_study("val/Var")
    results = {"val/Var": 8.0, "test/Var": 9.5, "val/mIoU": 50.0, "test/mIoU": 48.25}
    first = {"masker.alpha": 0.123456, "optimizer.lr": 0.5, "head.lr": 1.0}
    add(made, [8.0], params=first, results=results, seconds=61.6, runs=["a1"])
    for value in (*range(12, 22), 4.0):
        add(made, [float(value)], params={"masker.alpha": 0.25})
    grid = study.trials_grid(made, trials_frame(made))
    assert grid.title == "Best trials: lowest val/Var"
    assert grid.header == (
        *("trial", "alpha", "optimizer.lr", "head.lr", "val/Var", "test/Var", "val/mIoU"),
        *("test/mIoU", "seconds", "runs"),
    )
    assert [row[0] for row in grid.rows] == ["11", "0", *map(str, range(1, 9))]
    scores = ("8.00", "9.50", "50.00", "48.25", "62", "a1")
    assert grid.rows[1] == ("0", "0.1235", "0.5", "1", *scores)
    assert grid.rows[0][2:] == ("-", "-", "4.00", "-", "-", "-", "-", "-")


def test_pareto_front_of_five_points() -> None:
    # mIoU up, Var down. (50, 9) is beaten by (55, 8); (54, 10) by (55, 8): three remain.
    made = new_study("val/mIoU", "val/Var")
    add(made, state="FAIL", reason="so that numbers are not places in a list")
    size = {"params": {"size": "${px:64}"}, "pixels": 0.5}
    for values in ((50.0, 9.0), (55.0, 8.0), (60.0, 12.0), (54.0, 10.0), (40.0, 2.0)):
        add(made, values, **size)
    grid = study.trials_grid(made, trials_frame(made))
    assert [row[0] for row in grid.rows] == ["3", "2", "5"]
    values = [("32", "60.00", "12.00"), ("32", "55.00", "8.00"), ("32", "40.00", "2.00")]
    assert [row[1:4] for row in grid.rows] == values


def test_tables_count_the_states_and_the_csv_has_all_trials(tmp_path: Path) -> None:
    made = new_study("val/mIoU")
    add(made, [100 / 3], params={"a.x": 0.1}, results={"test/mIoU": 31.0}, seconds=2.5, runs=["r"])
    reported = {10: 1.0, 20: 2.0}
    add(made, state="PRUNED", params={"a.x": 0.2}, reported=reported, reason="at 20, low")
    add(made, state="RUNNING")
    add(made, state="FAIL", label="x", reason="by\nsignal | 9", runs=["r1", "r2"])
    counts, best, failed = study.tables(made, trials_frame(made))
    assert counts.rows == (("4", "1", "1", "1", "1", "0"),)
    assert [row[0] for row in best.rows] == ["0"]
    assert failed.rows == (("by signal | 9", "3", "x", "r1 r2"),)
    study.publish_study(made, tmp_path, "")
    first, second, *_ = csv.DictReader((tmp_path / "trials.csv").open())
    assert float(first["val/mIoU"]) == 100 / 3
    assert list(first.values())[5:] == ["31.0", "2.5", "", "r", ""]
    assert list(second.values())[3:] == ["0.2", "", "", "", "20", "", "at 20, low"]
    assert (second["state"], second["label"]) == ("pruned", "#1")


def test_importances_name_the_deciding_parameter() -> None:
    """`big` decides the first objective, `small` the second; `same` never changes."""
    made = new_study("up", "down")
    for index in range(40):
        big, small = index / 40, (index * 7 % 40) / 40
        params = {"small": small, "big": big, "same": 0.5}
        add(made, [10 * big + 0.01 * small, 5 * small + 0.001 * big], params=params)
    grid, _ = importances(made, trials_frame(made))
    assert grid is not None
    (first, *of_big), (second, *of_small) = grid.rows
    assert (first, second) == ("big", "small")
    assert (float(of_big[0]) > 80, float(of_small[1]) > 80) == (True, True)
    assert [float(a) + float(b) for a, b in zip(of_big, of_small, strict=True)] == [
        pytest.approx(100, abs=0.02)
    ] * 2


def test_importances_missing_have_a_reason() -> None:
    made = new_study("up")
    for index in range(10):
        reason = f"they need 10 complete trials, and there are {index}."
        assert importances(made, trials_frame(made)) == (None, reason)
        add(made, [float(index)], params={"x": 0.5})
    reason = "no parameter, or no objective, took two values."
    assert importances(made, trials_frame(made)) == (None, reason)


@pytest.mark.parametrize("installed", [None, "optuna_dashboard"])
def test_study_of_search_is_shown_and_written(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, installed: str | None
) -> None:
    monkeypatch.setattr(study, "find_spec", lambda _: installed)
    folder = study_folder(tmp_path, "search/grbm")
    folder.mkdir(parents=True)
    url = storage_url(None, tmp_path, "search/grbm")
    made = new_study("val/mIoU", study_name="search/grbm", storage=url)
    made.set_user_attr(attributes.COMMAND, "python -m rgbt.run -m storage=postgresql://u:pw@h/db")
    for alpha in (0.25, 0.75, 0.5):
        add(made, [50 + alpha], params={"masker.alpha": alpha}, runs=["key"])
    add(made, state="FAIL", reason="exit code 1: [Errno 28] disk full")
    made.ask()  # still running
    with driving(tmp_path, "search/grbm"):
        code, out, err = call(entry, "name=search/grbm", f"runs_dir={tmp_path}")
    assert (code, err) == (0, "")
    assert out.index("50.75") < out.index("50.50") < out.index("50.25")
    assert "[Errno 28] disk full" in out
    assert "Importances: they need 10 complete trials, and there are 3." in out
    assert (f"optuna-dashboard {url}" in out) == bool(installed)
    found = {path.name for path in folder.iterdir()}
    assert found == {"study.md", "trials.csv", "optuna.db", "lock"}
    text = (folder / "study.md").read_text()
    assert "postgresql://u:***@h/db" in text
    assert "| 50.75 |" in text


def test_study_unknown_or_missing_name_lists_studies(call: Call, tmp_path: Path) -> None:
    code, _, err = call(entry, "name=x", f"runs_dir={tmp_path}")
    assert code == 2
    assert_one_sentence(err, "studies")
    assert list(tmp_path.iterdir()) == []
    url = f"sqlite:///{tmp_path}/all.db"
    study_folder(tmp_path, "search/grbm").mkdir(parents=True)
    own = storage_url(None, tmp_path, "search/grbm")
    for storage, words in ((own, []), (url, [f"storage={url}"])):
        new_study("up", study_name="search/grbm", storage=storage)
        for name in (["name=search/grb"], []):
            code, _, err = call(entry, *name, *words, f"runs_dir={tmp_path}")
            assert code == 2
            assert_one_sentence(err, "search/grbm")


def test_study_folders_are_safe_and_differ() -> None:
    names = ["a/b", "a_b", "../../etc", "..", "a b", "x" * 300, "x" * 301]
    folders = {study_folder(Path("runs"), name) for name in names}
    assert len(folders) == len(names)
    assert all(folder.parent == Path("runs/studies") for folder in folders)
    assert all(folder.name.strip(".") and len(folder.name) < 100 for folder in folders)
