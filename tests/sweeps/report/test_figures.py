"""Figures of studies of every shape: a picture, or a sentence why there is none."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import optuna
import pytest
from matplotlib import pyplot
from optuna.trial import TrialState

from sweeps import attributes
from sweeps.report.figures import StudyFigure, draw
from sweeps.report.study_data import importances, read


def new_study(*directions: str) -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.RandomSampler(seed=0)
    return optuna.create_study(study_name="s", directions=list(directions), sampler=sampler)


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


@pytest.mark.slow
def test_draw_one_objective_all_figures(tmp_path: Path) -> None:
    """Float, log, int and categorical parameters that not all trials have; pruned, failed."""
    study = new_study("maximize")
    for index in range(24):
        trial = study.ask()
        rate = trial.suggest_float("optimizer.lr", 1e-5, 1e-1, log=True)
        size = trial.suggest_int("masker.patch_size", 8, 64, step=8)
        if trial.suggest_categorical("masker", ["grbm", "none"]) == "grbm":
            trial.suggest_float("masker.sigma_div", 0.5, 8.0, log=True)
        trial.report(-1, 10)
        state = {1: TrialState.FAIL, 2: TrialState.PRUNED}.get(index % 6)
        study.tell(trial, None if state else math.log10(rate) - size / 100, state)
    before = {key: value for key, value in matplotlib.rcParams.items() if key != "backend"}
    found = drawn(study, tmp_path)
    assert list(found) == ONE
    for name in ONE:
        assert found[name].path == tmp_path / f"{name}.png"
        assert is_picture(found[name].path), found[name]
    after = {key: value for key, value in matplotlib.rcParams.items() if key != "backend"}
    assert after == before
    assert pyplot.get_fignums() == []


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
    study.set_user_attr(attributes.KIND, "grid")
    assert list(drawn(study, tmp_path)) == [*ONE[1:4], "parallel"]
    study.set_user_attr(attributes.KIND, "list")
    assert drawn(study, tmp_path) == {}


@pytest.mark.slow
def test_draw_two_objectives_of_which_one_is_constant(tmp_path: Path) -> None:
    study = new_study("maximize", "minimize")
    study.set_user_attr(attributes.METRICS, ["val/mIoU", "val/Var"])
    for index in range(12):
        trial = study.ask()
        trial.suggest_categorical("same", ["${px:64}"])
        study.tell(trial, [trial.suggest_float("a" if index % 2 else "b", 0, 1), 3.0])
    found = drawn(study, tmp_path)
    each = ("history", "importances", "slices", "contour")
    names = [f"{name}_{end}" for end in ("val_mIoU", "val_Var") for name in each]
    assert list(found) == [*names, "pareto", "parallel"]
    without = [name for name, picture in found.items() if picture.path is None]
    assert without == ["contour_val_mIoU", "importances_val_Var", "contour_val_Var"]
    assert all(is_picture(found[name].path) for name in {*found} - {*without})
    second = read(study).of_objective(1, with_others=True)
    assert second.direction.name == "MINIMIZE"
    first = second.trials[0]
    assert first.value == 3.0
    assert first.params["same"] == "64px"
    assert "val/mIoU" in first.params
