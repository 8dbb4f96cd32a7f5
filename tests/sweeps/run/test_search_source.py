"""Proposals of a sampler as trials, what is reported of them, and a search that goes on."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.trial import TrialState, create_trial

from rgbt.runs.folder import MetricLine
from rgbt.runs.naming import VARIED
from rgbt.runs.result import RunResult
from sweeps import attributes as names
from sweeps.point import Outcome, Point
from sweeps.run.search_source import checked
from sweeps.settings import Objective
from sweeps.space import build_sampler
from tests.sweeps.fakes import (
    Call,
    FakePlanner,
    ListDesk,
    Process,
    SearchDesk,
    fail,
    finish,
    interrupt_when,
    lasting,
    nth,
    scored,
    succeed,
)

UP = (Objective("val/mIoU", "maximize"),)


def test_the_sampler_is_asked_and_the_point_noted(tmp_path: Path) -> None:
    desk = SearchDesk(tmp_path, trials=2)
    plan = desk.next()
    point = plan.point
    (override,) = point.overrides
    x = float(override.removeprefix("x="))
    assert 0 <= x <= 1
    (trial,) = desk.trials
    assert trial.params == {"x": x}
    assert trial.user_attrs == {
        names.RUNS: [plan.key],
        names.LABEL: f"#0 x {x:.3g}",
        names.PIXELS: 1.0,
    }
    assert point.tags == {"rgbt.study/study": "0", VARIED: "x"}
    assert (point.label, point.seeds) == (f"#0 x {x:.3g}", ())


def test_a_search_ends_with_its_trials(tmp_path: Path) -> None:
    desk = SearchDesk(tmp_path, nth(succeed, fail, succeed), trials=3, slots=2).run()
    assert sorted(desk.states()) == ["COMPLETE", "COMPLETE", "FAIL"]
    assert desk.source.counts() == {"finished": 2, "failed": 1, "waiting": 0}
    assert desk.view.counts[0] == {"running": 2, "waiting": 1}
    assert "waiting" not in SearchDesk(tmp_path, hours=1.0).source.counts()
    more = SearchDesk(tmp_path, trials=4, storage=desk.storage)
    assert more.source.counts()["waiting"] == 1
    assert [len(more.run().trials), len(more.executor.calls)] == [4, 1]


def test_a_wrong_point_fails_and_is_said(tmp_path: Path) -> None:
    class Picky(FakePlanner):
        def plan(self, point: Point) -> Any:
            return super().plan(Point("", ("wrong",)))

    desk = SearchDesk(tmp_path, planner=Picky(), trials=1).run()
    (trial,) = desk.trials
    assert trial.state.name == "FAIL"
    assert trial.user_attrs[names.REASON] == "wrong=1 is no key."
    assert desk.view.said == [("failed", f"{trial.user_attrs[names.LABEL]}: wrong=1 is no key.")]


def line(step: int, **values: float) -> MetricLine:
    return MetricLine(step, "val", 0.0, values)


@pytest.mark.filterwarnings("error:.*already")
def test_validations_are_reported_once_each_in_percent(tmp_path: Path) -> None:
    desk = SearchDesk(tmp_path, objectives=UP, trials=1)
    plan = desk.next()
    for validation in (line(2, mIoU=0.5, Var=9.0), line(4, mIoU=0.125), line(6, loss=1.0)):
        assert desk.source.report(plan, validation) == ""
    again = SearchDesk(tmp_path, objectives=UP, trials=1, storage=desk.storage)
    plan = again.next()
    for validation in (line(2, mIoU=0.25), line(4, mIoU=0.25), line(8, mIoU=math.nan)):
        assert again.source.report(plan, validation) == ""
    (trial,) = desk.trials
    assert {k: v for k, v in trial.intermediate_values.items() if k < 8} == {2: 50.0, 4: 12.5}
    assert math.isnan(trial.intermediate_values[8])


def test_var_is_no_percentage_and_two_objectives_are_not_reported(tmp_path: Path) -> None:
    var = Objective("val/Var", "minimize")
    for objectives, reported in (((var,), {2: 9.0}), ((*UP, var), {})):
        desk = SearchDesk(tmp_path, objectives=objectives, trials=1)
        assert desk.source.report(desk.next(), line(2, mIoU=0.5, Var=9.0)) == ""
        assert desk.trials[0].intermediate_values == reported


def test_a_stored_parameter_outside_the_space_is_not_composed(tmp_path: Path) -> None:
    desk = SearchDesk(tmp_path, trials=1)
    kinds = {
        "x": FloatDistribution(0, 1),
        "hydra.searchpath": CategoricalDistribution(["[pkg://evil]"]),
    }
    stored = {"x": 0.5, "hydra.searchpath": "[pkg://evil]"}
    waiting = create_trial(state=TrialState.WAITING, params=stored, distributions=kinds)
    desk.study.add_trial(waiting)
    point = desk.next().point
    assert (point.overrides, dict(point.params)) == (("x=0.5",), {"x": 0.5})


@pytest.mark.parametrize("is_lasting", [False, True])
def test_trials_of_a_killed_driver_go_on(tmp_path: Path, is_lasting: bool) -> None:
    executor = lasting(scored(0.4, 0.5, val=0.5), 2)
    executor.is_lasting = is_lasting
    pruner = optuna.pruners.MedianPruner()
    both: dict[str, Any] = {"objectives": UP, "trials": 3}
    view = interrupt_when(lambda running: any(point.step for point in running))
    desk = SearchDesk(tmp_path, executor=executor, view=view, pruner=pruner, **both)
    with pytest.raises(KeyboardInterrupt):
        desk.run()
    before = [trial.params for trial in desk.trials]
    assert [trial.last_step for trial in desk.trials] == [2, 2]
    again = SearchDesk(tmp_path, executor=executor, storage=desk.storage, pruner=pruner, **both)
    assert again.run().states() == ["COMPLETE"] * 3
    assert [trial.params for trial in again.trials[:2]] == before
    assert [set(trial.intermediate_values) for trial in again.trials] == [{2, 4}] * 3
    assert len({call.words for call in executor.calls}) == 3
    assert len(executor.jobs) == (3 if is_lasting else 5)


def test_a_trial_whose_driver_was_killed_while_it_asked_gets_its_parameters(
    tmp_path: Path,
) -> None:
    space = {key: {"type": "float", "low": 0, "high": 1} for key in "xy"}
    whole = SearchDesk(tmp_path, space=space, trials=1)
    wanted = whole.next().point.overrides
    for known in ((), ("x",)):
        desk = SearchDesk(tmp_path, space=space, trials=1)
        desk.study.sampler = build_sampler(desk.settings.sampler, 0)
        desk.study.ask({key: FloatDistribution(0, 1) for key in known})
        again = SearchDesk(tmp_path, space=space, trials=1, storage=desk.storage)
        found = again.next().point.overrides
        assert [word[:2] for word in found] == ["x=", "y="]
        assert found[0] == wanted[0]
        assert len(again.trials) == 1


def test_a_run_that_ended_without_a_driver_is_said_as_it_counts(tmp_path: Path) -> None:
    desk = SearchDesk(tmp_path, trials=1)
    finish(tmp_path / desk.next().key, test={"mIoU": None})
    again = SearchDesk(tmp_path, trials=1, storage=desk.storage).run()
    assert (again.states(), again.executor.submits) == (["FAIL"], [])
    assert [state for state, _ in again.view.said] == ["failed"]


@pytest.mark.parametrize("score", [None, math.inf, 0.5])
def test_a_score_that_is_no_number_fails(tmp_path: Path, score: float | None) -> None:
    finish(tmp_path / "a", test={"mIoU": score, "Var": 1.0})
    outcome = Outcome(Point("p", ()), "finished", results=(RunResult(tmp_path / "a"),))
    counted = checked(outcome, (Objective("test/mIoU", "maximize"),))
    assert counted.state == ("finished" if score == 0.5 else "failed")
    assert ("no test/mIoU that is a number" in counted.reason) == (score != 0.5)


def test_a_new_trial_is_run_whatever_failed_before(tmp_path: Path) -> None:
    """Another search, or an earlier trial with these values; what was wrong may be repaired."""
    first = SearchDesk(tmp_path, fail, trials=1).run()
    again = SearchDesk(tmp_path, trials=1).run()
    assert (first.states(), again.states()) == (["FAIL"], ["COMPLETE"])
    assert first.trials[0].params == again.trials[0].params


def test_a_trial_that_failed_without_a_driver_is_not_run_again(tmp_path: Path) -> None:
    desk = SearchDesk(tmp_path, trials=1)
    ListDesk(tmp_path, [desk.next().point], fail).run()
    again = SearchDesk(tmp_path, trials=1, storage=desk.storage).run()
    assert (again.states(), again.executor.submits) == (["FAIL"], [])
    assert again.trials[0].user_attrs[names.REASON] == "ValueError: a bad day"


SPACE = {
    "x": {"type": "float", "low": 0.5, "high": 32, "log": True},
    "y": {"type": "int", "low": 1, "high": 9},
    "z": {"type": "categorical", "choices": ["a", "b"]},
}


def test_a_search_of_one_worker_is_known_by_its_seed(tmp_path: Path) -> None:
    """Values of an earlier version, which had another driver."""

    def behave(call: Call) -> Process:
        x, y, z = float(call.value("x")), int(call.value("y")), call.value("z")
        score = math.exp(-abs(math.log(x) - 1) - abs(y - 4) / 5 - (z == "a") / 4)
        shares = (0.3, 0.5, 0.7, 0.8, 0.9, 1.0)
        return (yield from scored(*(score * share for share in shares), val=score)(call))

    sampler = {"_target_": "optuna.samplers.TPESampler", "seed": 0}
    wanted = {"sampler": sampler, "objectives": UP, "trials": 20}
    desk = SearchDesk(tmp_path, behave, space=SPACE, **wanted).run()
    assert (
        RECORDED.items()
        <= {
            trial.number: (round(trial.params["x"], 4), trial.params["y"], trial.params["z"])
            for trial in desk.trials
        }.items()
    )


RECORDED = {0: (2.3731, 6, "b"), 12: (1.7039, 5, "b"), 19: (0.6025, 6, "b")}


def test_a_search_by_hours_ends_when_all_points_are_tried(tmp_path: Path) -> None:
    space = {
        "x": {"type": "categorical", "choices": [1, 2]},
        "y": {"type": "int", "low": 1, "high": 2},
    }
    desk = SearchDesk(tmp_path, space=space, hours=1.0).run()
    assert {(trial.params["x"], trial.params["y"]) for trial in desk.trials} == {
        *((1, 1), (1, 2), (2, 1), (2, 2)),
    }
    assert len(desk.executor.calls) == 4
