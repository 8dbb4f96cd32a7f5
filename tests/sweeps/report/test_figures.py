"""Figures of studies of every shape: a picture, or a sentence why there is none."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import cv2
import numpy as np
import optuna
import pytest
from optuna.trial import TrialState

from sweeps import attributes
from sweeps.report.figures import StudyFigure, draw
from sweeps.report.study_data import importances, read


def new_study(*directions: str) -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.RandomSampler(seed=0)
    return optuna.create_study(study_name="s", directions=list(directions), sampler=sampler)


def filled(*directions: str, count: int = 24) -> optuna.Study:
    """Float, log, int and categorical parameters that not all trials have; pruned, failed."""
    study = new_study(*directions)
    for index in range(count):
        trial = study.ask()
        rate = trial.suggest_float("optimizer.lr", 1e-5, 1e-1, log=True)
        size = trial.suggest_int("masker.patch_size", 8, 64, step=8)
        if trial.suggest_categorical("masker", ["grbm", "none"]) == "grbm":
            trial.suggest_float("masker.sigma_div", 0.5, 8.0, log=True)
        if index % 6 == 1:
            study.tell(trial, state=TrialState.FAIL)
            continue
        value = -abs(math.log10(rate) + 3) - size / 100
        if len(directions) == 1:
            trial.report(value - 1, 10)
        if index % 6 == 2 and len(directions) == 1:
            study.tell(trial, state=TrialState.PRUNED)
            continue
        study.tell(trial, [value, float(size), 1.0, 2.0][: len(directions)])
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


ONE = ["history", "importances", "slices", "contour", "intermediate", "parallel"]


def test_draw_one_objective_all_figures(tmp_path: Path) -> None:
    import matplotlib
    from matplotlib import pyplot

    before = {key: value for key, value in matplotlib.rcParams.items() if key != "backend"}
    found = drawn(filled("maximize"), tmp_path)
    assert list(found) == ONE
    for name in ONE:
        assert found[name].path == tmp_path / f"{name}.png"
        assert is_picture(found[name].path), found[name]
    after = {key: value for key, value in matplotlib.rcParams.items() if key != "backend"}
    assert after == before
    assert pyplot.get_fignums() == []


@pytest.mark.slow
def test_draw_two_objectives_front_and_figures_each(tmp_path: Path) -> None:
    study = filled("maximize", "minimize")
    study.set_user_attr(attributes.METRICS, ["val/mIoU", "val/Var"])
    found = drawn(study, tmp_path)
    each = ("history", "importances", "slices", "contour")
    names = [f"{name}_{end}" for end in ("val_mIoU", "val_Var") for name in each]
    assert list(found) == [*names, "pareto", "parallel"]
    assert all(is_picture(picture.path) for picture in found.values())


@pytest.mark.parametrize(("kind", "names"), [("list", []), ("grid", [*ONE[1:4], "parallel"])])
def test_draw_kind_selects_figures(tmp_path: Path, kind: str, names: list[str]) -> None:
    study = filled("maximize", count=4)
    study.set_user_attr(attributes.KIND, kind)
    assert list(drawn(study, tmp_path)) == names


def test_draw_without_complete_trials_has_reasons(tmp_path: Path) -> None:
    stale = tmp_path / "history.png"
    stale.write_bytes(b"of a study of the same name that was deleted")
    study = new_study("maximize")
    trial = study.ask()
    trial.suggest_float("x", 0, 1)
    study.tell(trial, state=TrialState.FAIL)
    study.ask()
    found = drawn(study, tmp_path)
    assert list(found) == ONE
    assert all(picture.path is None and picture.reason for picture in found.values())
    assert not stale.exists()


def test_draw_constant_values_have_reasons(tmp_path: Path) -> None:
    study = new_study("maximize", "minimize", "minimize", "maximize")
    for index in range(12):
        trial = study.ask()
        trial.suggest_float("same", 1.0, 1.0)
        trial.suggest_categorical("only", ["one"])
        value = trial.suggest_float("a" if index % 2 else "b", 0, 1)
        study.tell(trial, [value, 3.0, value, value])
    found = drawn(study, tmp_path)
    without = {name for name, picture in found.items() if picture.path is None}
    contours = {f"contour_objective_{number}" for number in (1, 2, 3, 4)}
    assert without == {*contours, "importances_objective_2", "pareto"}
    assert "one value" in found["importances_objective_2"].reason


def test_of_objective_has_parameters_as_shown() -> None:
    study = new_study("maximize", "minimize")
    sizes = ["${px:64}", "${px:8}"]
    for size in sizes:
        study.enqueue_trial({"masker.patch_size": size})
        trial = study.ask()
        trial.suggest_categorical("masker.patch_size", sizes)
        trial.set_user_attr(attributes.PIXELS, 0.5)
        study.tell(trial, [1.0, len(size)])
    second = read(study).of_objective(1, with_others=True)
    assert second.direction.name == "MINIMIZE"
    assert [trial.value for trial in second.trials] == [8.0, 7.0]
    shown = [trial.params for trial in second.trials]
    assert shown == [{"masker.patch_size": size, "objective 1": 1.0} for size in ("32", "4")]
