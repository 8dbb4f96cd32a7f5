"""Proposals of a sampler as trials, and what is reported of them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from rgbt.runs.folder import MetricLine
from rgbt.runs.naming import VARIED
from sweeps import attributes as names
from sweeps.settings import Objective
from sweeps.run.running_trial import ClaimedTrial
from tests.sweeps.fakes import Desk, PickyPlanner, search_desk


def taken(desk: Desk) -> ClaimedTrial:
    task: ClaimedTrial | None = desk.source.next()
    assert task is not None
    return task


def test_a_search_asks_the_sampler_and_notes_the_point(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, trials=2)
    task = taken(desk)
    (override,) = task.plan.point.overrides
    x = float(override.removeprefix("x="))
    assert 0 <= x <= 1
    trial = desk.store.trials()[0]
    assert trial.params == {"x": x}
    assert trial.user_attrs == {
        names.KEY: task.plan.key,
        names.OVERRIDES: [override],
        names.RUNS: [task.plan.key],
        names.LABEL: f"#0 x={x:.4g}",
        names.PIXELS: 1.0,
    }
    tags = {"rgbt.study/study": "0", VARIED: "x"}
    assert task.plan.point.tags == tags
    assert (task.plan.point.label, task.plan.point.seeds) == (f"#0 x={x:.4g}", ())


def test_a_search_is_over_when_its_trials_are_made(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, trials=1)
    assert not desk.source.is_exhausted(wait=False)
    task = taken(desk)
    assert desk.source.next() is None
    assert desk.source.is_exhausted(wait=False)
    assert not desk.source.is_exhausted(wait=True)
    desk.store.release(task.number)
    assert not desk.source.is_exhausted(wait=False), "somebody has to take it up"
    again = taken(desk)
    assert again.plan.key == task.plan.key
    desk.store.complete(again.number, [1.0], {})
    assert desk.source.is_exhausted(wait=True)
    assert not search_desk(tmp_path, hours=1.0).source.is_exhausted(wait=False)


def test_sampler_source_wrong_point_fails_and_is_reported(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, planner=PickyPlanner(), trials=1)
    assert desk.source.next() is None
    (trial,) = desk.store.trials()
    assert trial.state.name == "FAIL"
    assert trial.user_attrs[names.REASON] == "x does not fit."
    assert desk.view.said == [("failed", f"{trial.user_attrs[names.LABEL]}: x does not fit.")]
    assert desk.source.is_exhausted(wait=False)


def line(step: int, **values: float) -> MetricLine:
    return MetricLine(step, "val", 0.0, values)


@pytest.mark.filterwarnings("error")
def test_evaluations_are_reported_once_each_in_percent(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, objectives=(Objective("val/mIoU", "maximize"),), trials=1)
    report = taken(desk).report
    assert report is not None
    assert report(line(2, mIoU=0.5, Var=9.0)) == ""
    assert report(line(4, mIoU=0.125)) == ""
    assert report(line(6, loss=1.0)) == ""
    assert report(line(8, mIoU=math.nan)) == ""
    reported = desk.store.trials()[0].intermediate_values
    assert {step: value for step, value in reported.items() if step < 8} == {2: 50.0, 4: 12.5}
    assert math.isnan(reported.get(8, math.nan))


def test_pruning_callback_keeps_var_and_skips_two_objectives(tmp_path: Path) -> None:
    var = Objective("val/Var", "minimize")
    desk = search_desk(tmp_path, objectives=(var,), trials=1)
    report = taken(desk).report
    assert report is not None
    report(line(2, mIoU=0.5, Var=9.0))
    assert desk.store.trials()[0].intermediate_values == {2: 9.0}
    both = search_desk(tmp_path, objectives=(Objective("val/mIoU", "maximize"), var), trials=1)
    assert taken(both).report is None


def test_a_stored_parameter_outside_the_space_is_not_composed(tmp_path: Path) -> None:
    from optuna.distributions import CategoricalDistribution, FloatDistribution
    from optuna.trial import TrialState, create_trial

    desk = search_desk(tmp_path, trials=1)
    stored = {"x": 0.5, "hydra.searchpath": "[pkg://evil]"}
    kinds = {
        "x": FloatDistribution(0, 1),
        "hydra.searchpath": CategoricalDistribution(["[pkg://evil]"]),
    }
    waiting = create_trial(state=TrialState.WAITING, params=stored, distributions=kinds)
    desk.store.study.add_trial(waiting)
    point = taken(desk).plan.point
    assert (point.overrides, dict(point.params)) == (("x=0.5",), {"x": 0.5})
