"""Figures of studies of every shape: a picture, or a sentence why there is none."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import optuna
import pytest
from optuna.trial import TrialState

from sweeps import attributes
from sweeps.report.drawing import history, intermediate, pareto
from sweeps.report.figures import StudyFigure, by_optuna, draw
from sweeps.report.study_data import Importances, StudyData, importances, read

NONE = "no trial is complete yet."


def new_study(*directions: str) -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.RandomSampler(seed=0)
    return optuna.create_study(study_name="s", directions=list(directions), sampler=sampler)


def filled(*directions: str, count: int = 24) -> optuna.Study:
    """Float, log, int, categorical and conditional parameters; failed, dropped, pruned trials."""
    study = new_study(*directions)
    for index in range(count):
        trial = study.ask()
        rate = trial.suggest_float("optimizer.lr", 1e-5, 1e-1, log=True)
        size = trial.suggest_int("masker.patch_size", 8, 64, step=8)
        if trial.suggest_categorical("masker", ["grbm", "none"]) == "grbm":
            trial.suggest_float("masker.sigma_div", 0.5, 8.0, log=True)
        if index % 6 == 1:
            trial.set_user_attr(attributes.DROPPED, index == 1)
            study.tell(trial, state=TrialState.FAIL)
            continue
        value = -abs(math.log10(rate) + 3) - size / 100
        if len(directions) == 1:
            trial.report(value - 1, 10)
        if index % 6 == 2 and len(directions) == 1:
            study.tell(trial, state=TrialState.PRUNED)
            continue
        study.tell(trial, [value, float(size)][: len(directions)])
    return study


def drawn(study: optuna.Study, folder: Path) -> dict[str, StudyFigure]:
    """Pictures by name; a warning is an error, as it would land in the user's terminal."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = read(study)
        return {picture.name: picture for picture in draw(data, importances(data), folder)}


def is_picture(path: Path | None) -> bool:
    image = cv2.imread(str(path))
    return image is not None and min(image.shape[:2]) > 150 and np.unique(image).size > 10


@pytest.mark.slow
def test_one_objective_draws_all_figures(tmp_path: Path) -> None:
    found = drawn(filled("maximize"), tmp_path)
    names = ["history", "intermediate", "importances", "parallel", "slices", "contour"]
    assert list(found) == names
    for name in names:
        assert found[name].path == tmp_path / f"{name}.png"
        assert is_picture(found[name].path), found[name]


@pytest.mark.slow
def test_two_objectives_have_a_front_and_slices_each(tmp_path: Path) -> None:
    study = filled("maximize", "minimize")
    study.set_user_attr(attributes.METRICS, ["val/mIoU", "val/Var"])
    found = drawn(study, tmp_path)
    without = {name: picture.reason for name, picture in found.items() if picture.path is None}
    reason = "trials with several objectives report no values during training."
    assert without == {"intermediate": reason}
    for name in ("pareto", "slices_val_mIoU", "slices_val_Var", "contour_val_Var"):
        assert is_picture(found[name].path)


def test_optuna_figure_keeps_global_style() -> None:
    import matplotlib
    from matplotlib import pyplot

    before = {key: value for key, value in matplotlib.rcParams.items() if key != "backend"}
    names = ["optimizer.lr", "masker.patch_size"]
    axis = by_optuna(read(filled("maximize")), "plot_contour", 0, params=names).axes[0]
    scales = {axis.get_xlabel(): axis.get_xscale(), axis.get_ylabel(): axis.get_yscale()}
    assert scales == {"optimizer.lr": "log", "masker.patch_size": "linear"}
    after = {key: value for key, value in matplotlib.rcParams.items() if key != "backend"}
    assert after == before
    assert pyplot.get_fignums() == []


def test_empty_study_has_a_reason(tmp_path: Path) -> None:
    stale = tmp_path / "history.png"
    stale.write_bytes(b"of a study of the same name that was deleted")
    found = drawn(new_study("maximize"), tmp_path)
    assert [picture.path for picture in found.values()] == [None] * 6
    assert found["history"].reason == found["slices"].reason == NONE
    assert not stale.exists()


def test_only_failed_and_running_trials_have_a_reason(tmp_path: Path) -> None:
    study = new_study("maximize")
    for _ in range(3):
        trial = study.ask()
        trial.suggest_float("x", 0, 1)
        study.tell(trial, state=TrialState.FAIL)
    study.ask()
    found = drawn(study, tmp_path)
    assert found["parallel"].reason == NONE
    assert found["importances"].reason == "they need 10 complete trials, and there are 0."


def test_one_trial_is_drawn_where_one_suffices(tmp_path: Path) -> None:
    study = new_study("maximize")
    trial = study.ask()
    trial.suggest_float("x", 1e-3, 1, log=True)
    trial.suggest_int("n", 1, 5)
    study.tell(trial, 1.0)
    found = drawn(study, tmp_path)
    ends = {name: picture.path is not None for name, picture in found.items()}
    assert [name for name, ok in ends.items() if ok] == ["history", "parallel", "slices"]


def test_constant_parameter_and_constant_objective(tmp_path: Path) -> None:
    study = new_study("maximize")
    for _ in range(12):
        trial = study.ask()
        trial.suggest_float("same", 1.0, 1.0)
        trial.suggest_categorical("only", ["one"])
        study.tell(trial, 3.0)
    found = drawn(study, tmp_path)
    assert is_picture(found["parallel"].path)
    assert is_picture(found["slices"].path)
    assert found["importances"].reason == "no parameter took two values."
    assert found["contour"].reason.endswith("no parameter took two values.")


def test_contour_of_unrelated_parameters_has_a_reason(tmp_path: Path) -> None:
    study = new_study("maximize")
    for index in range(20):
        trial = study.ask()
        value = trial.suggest_float("a" if index % 2 else "b", 0, 1)
        study.tell(trial, value)
    reason = drawn(study, tmp_path)["contour"].reason
    assert reason in (f"only 0 complete trials have both {x} and {y}." for x, y in ("ab", "ba"))


def test_contour_uses_two_most_important_parameters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def fake(data: StudyData, function: str, index: int, **options: Any) -> Any:
        if function == "plot_contour":
            asked.append((index, options["params"]))
        return history(data)

    monkeypatch.setattr("sweeps.report.figures.by_optuna", fake)
    shares = {"optimizer.lr": (0.6, 0.1), "masker.patch_size": (0.3, 0.4), "masker": (0.1, 0.5)}
    draw(read(filled("maximize", "minimize")), Importances(shares, ""), tmp_path)
    assert asked == [
        (0, ["optimizer.lr", "masker.patch_size"]),
        (1, ["masker", "masker.patch_size"]),
    ]


def test_a_list_has_no_figures(tmp_path: Path) -> None:
    study = filled("maximize")
    study.set_user_attr(attributes.KIND, "list")
    assert drawn(study, tmp_path) == {}


@pytest.mark.slow
def test_draw_of_grid_omits_search_figures(tmp_path: Path) -> None:
    study = filled("maximize")
    study.set_user_attr(attributes.KIND, "grid")
    assert list(drawn(study, tmp_path)) == ["importances", "parallel", "slices", "contour"]


def test_history_marks_best_pruned_and_failed() -> None:
    study = new_study("minimize")
    for value in (5.0, 7.0, None, 4.0, 6.0):
        trial = study.ask()
        state = TrialState.FAIL if value is None else TrialState.COMPLETE
        study.tell(trial, value, state=state)
    lines = {line.get_label(): line for line in history(read(study)).axes[0].lines}
    assert list(lines["best so far"].get_ydata()) == [5.0, 5.0, 4.0, 4.0]
    assert list(lines["best so far"].get_xdata()) == [0, 1, 3, 4]
    assert list(lines["failed"].get_xdata()) == [2]


def test_pareto_marks_the_front() -> None:
    study = new_study("maximize", "minimize")
    for values in ((50.0, 9.0), (55.0, 8.0), (60.0, 12.0), (54.0, 10.0), (40.0, 2.0)):
        study.tell(study.ask(), values)
    lines = {line.get_label(): line for line in pareto(read(study)).axes[0].lines}
    assert list(lines["Pareto front"].get_xdata()) == [40.0, 55.0, 60.0]
    assert sorted(lines["complete"].get_xdata()) == [50.0, 54.0]


def test_intermediate_distinguishes_trial_states() -> None:
    axis = intermediate(read(filled("maximize"))).axes[0]
    assert [line.get_label() for line in axis.lines if line.get_label()[0] != "_"] == [
        "complete",
        "pruned",
    ]


def test_slices_have_one_panel_per_parameter() -> None:
    axes = by_optuna(read(filled("maximize")), "plot_slice", 0).axes
    panels = {axis.get_xlabel(): axis for axis in axes}
    assert panels["optimizer.lr"].get_xscale() == "log"
    assert panels["masker.patch_size"].get_xscale() == "linear"
    assert axes[0].get_ylabel() == "objective 1 (higher is better)"


def test_parallel_coordinates_have_all_objectives_and_conditional_parameters() -> None:
    data = read(filled("maximize", "minimize"))
    axis = by_optuna(data, "plot_parallel_coordinate", 0).axes[0]
    names = [label.get_text() for label in axis.get_xticklabels()]
    assert sorted(names[1:]) == [
        "masker",
        "masker.patch_size",
        "masker.sigma_div",
        "objective 2",
        "optimizer.lr",
    ]


def test_study_of_one_objective_has_shown_parameters() -> None:
    study = new_study("maximize", "minimize")
    sizes = ["${px:64}", "${px:8}"]
    for size in sizes:
        study.enqueue_trial({"masker.patch_size": size})
        trial = study.ask()
        trial.suggest_categorical("masker.patch_size", sizes)
        trial.set_user_attr(attributes.PIXELS, 0.5)
        study.tell(trial, [1.0, len(size)])
    second = read(study).of_objective(1)
    assert second.direction.name == "MINIMIZE"
    assert [trial.value for trial in second.trials] == [8.0, 7.0]
    assert [trial.params for trial in second.trials] == [
        {"masker.patch_size": "32"},
        {"masker.patch_size": "4"},
    ]
