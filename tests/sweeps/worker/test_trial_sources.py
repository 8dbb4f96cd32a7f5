"""Selection of the next trial: points of a list, and proposals of a sampler."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from optuna.distributions import CategoricalDistribution

from rgbt.runs.folder import MetricLine
from rgbt.runs.naming import VARIED
from rgbt.runs.result import RunResult
from sweeps import attributes as names
from sweeps.evaluation import ExtraEvaluation
from sweeps.point import COLOUR, Point, colour
from sweeps.settings import Objective
from sweeps.worker.planner import PlannedPoint
from sweeps.worker.run_store import RunStore
from sweeps.worker.trial_sources import (
    ClaimedTrial,
    ListSource,
    finished_runs,
    is_evaluated,
    reason_of,
)
from tests.sweeps.fakes import (
    DEAD,
    Desk,
    PickyPlanner,
    finish,
    list_desk,
    memory,
    plan_of,
    plans,
    quick,
    search_desk,
    until,
)

__all__ = ["quick"]


def taken(desk: Desk) -> ClaimedTrial:
    task = desk.driver.source.next()
    assert task is not None
    return task


def done(desk: Desk, task: ClaimedTrial, value: float = 25.0) -> None:
    """The task's runs are finished, and the study knows."""
    for run in task.plan.runs:
        finish(desk.runs.runs_dir / run.key)
    desk.store.complete(task.number, [value], {names.RESULTS: {"test/mIoU": value}})


def known(plan: PlannedPoint, runs: RunStore) -> tuple[RunResult, ...] | None:
    results = finished_runs(plan, runs)
    return results if results is not None and is_evaluated(plan, results) else None


def status(desk: Desk, index: int = 0) -> Any:
    source = desk.driver.source
    assert isinstance(source, ListSource)
    return source.status(desk.plans[index], desk.store.by_key())


def is_exhausted(desk: Desk, *, wait: bool = False) -> bool:
    return desk.driver.source.is_exhausted(wait=wait)


def test_list_source_claims_points_in_order(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, plans(2))
    known = {"x": CategoricalDistribution((0, 1))}
    source = ListSource(desk.plans, desk.store, desk.runs, desk.driver.settings, known)
    tasks = [source.next(), source.next()]
    assert [task.plan.point.label for task in tasks if task] == ["x=0", "x=1"]
    assert source.next() is None
    trial = desk.store.trials()[1]
    assert trial.params == {"x": 1}
    assert trial.user_attrs[names.LABEL] == "x=1"
    assert trial.user_attrs[names.OVERRIDES] == ["x=1"]
    assert trial.user_attrs[names.RUNS] == [desk.plans[1].runs[0].key]


def test_list_source_retries_are_shared_by_drivers(tmp_path: Path) -> None:
    storage = memory()
    a = list_desk(tmp_path, plans(1), storage=storage, retries=2)
    b = list_desk(tmp_path, plans(1), storage=storage, retries=2, owner=DEAD)
    for desk in (a, b, a):
        task = taken(desk)
        desk.store.fail(task.number, "a bad day", {})
    assert a.driver.source.next() is None
    assert b.driver.source.next() is None
    assert len(a.store.trials()) == 3


def test_a_point_whose_run_was_deleted_is_run_again(tmp_path: Path) -> None:
    storage = memory()
    before = list_desk(tmp_path, plans(1), storage=storage)
    done(before, taken(before))
    assert before.driver.source.next() is None
    (tmp_path / before.plans[0].key / "result.json").unlink()
    desk = list_desk(tmp_path, plans(1), storage=storage)
    assert status(desk).state == "waiting"
    assert taken(desk).number == 1


def test_finished_runs_require_all_runs_and_evaluations(tmp_path: Path) -> None:
    ring = ExtraEvaluation(regions="ring9")
    plan = plan_of(Point("p", (), seeds=(0, 1), evaluations=(ring,)))
    runs = list_desk(tmp_path, []).runs
    for run in plan.runs:
        assert known(plan, runs) is None
        finish(tmp_path / run.key)
    assert known(plan, runs) is None
    for run in plan.runs:
        (tmp_path / run.key / "evaluations").mkdir()
        found = runs.find(run.key, plan.fingerprints[run.key])
        assert found is not None
        shutil.copyfile(found.folder / "counts_test.npz", found.folder / ring.path)
    both = known(plan, runs)
    assert both is not None
    assert [found.key for found in both] == [run.key for run in plan.runs]
    finish(tmp_path / plan.runs[0].key, dataset="another")
    assert known(plan, runs) is None


def test_a_search_asks_the_sampler_and_notes_the_point(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, trials=2)
    task = taken(desk)
    (override,) = task.plan.point.overrides
    x = float(override.removeprefix("x="))
    assert 0 <= x <= 1
    trial = desk.store.trials()[0]
    assert trial.params == {"x": x}
    assert trial.user_attrs[names.KEY] == task.plan.key
    assert trial.user_attrs[names.OVERRIDES] == [override]
    assert trial.user_attrs[names.RUNS] == [task.plan.key]
    assert trial.user_attrs[names.LABEL] == task.plan.point.label == f"#0 x={x:.4g}"
    tags = {"rgbt.study/study": "0", VARIED: "x", COLOUR: colour("study", 0)}
    assert task.plan.point.tags == tags
    assert trial.user_attrs[names.PIXELS] == 1.0
    assert task.plan.point.seeds == ()


def test_a_search_is_over_when_its_trials_are_made(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, trials=1)
    assert not is_exhausted(desk)
    task = taken(desk)
    assert desk.driver.source.next() is None
    assert is_exhausted(desk)
    assert not is_exhausted(desk, wait=True)
    desk.store.release(task.number, "given back", requeue=True)
    assert not is_exhausted(desk), "somebody has to take it up"
    again = taken(desk)
    assert again.plan.key == task.plan.key
    done(desk, again)
    assert is_exhausted(desk, wait=True)
    assert not is_exhausted(search_desk(tmp_path, hours=1.0))


SMALL = {"x": {"type": "categorical", "choices": [7]}}


def test_sampler_source_drops_running_duplicate(tmp_path: Path, quick: None) -> None:
    desk = search_desk(tmp_path, space=SMALL, trials=2)
    task = taken(desk)
    assert desk.driver.source.next() is None
    assert len(desk.store.trials()) == 1, "a dropped one does not count"
    assert not is_exhausted(desk)
    done(desk, task)
    until(lambda: desk.driver.source.next() is None and is_exhausted(desk), "the second trial")
    assert desk.numbers("COMPLETE") == [0, desk.store.trials()[1].number]


def test_sampler_source_takes_requeued_point_before_old_trial_is_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = search_desk(tmp_path, trials=1)
    task = taken(desk)
    drop, again = desk.store.drop, []

    def take_first(*arguments: Any) -> None:
        again.append(desk.driver.source.next())
        drop(*arguments)

    monkeypatch.setattr(desk.store, "drop", take_first)
    desk.store.release(task.number, "its driver had ended", requeue=True)
    assert again[0] is not None, "the point was lost"
    assert again[0].plan.key == task.plan.key


def test_sampler_source_wrong_point_fails_and_is_reported(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, planner=PickyPlanner(), trials=1)
    assert desk.driver.source.next() is None
    (trial,) = desk.store.trials()
    assert trial.state.name == "FAIL"
    assert reason_of(trial) == "x does not fit."
    ((label, reason),) = desk.view.rejections
    assert label == trial.user_attrs[names.LABEL]
    assert reason == "x does not fit."
    assert is_exhausted(desk)


def line(step: int, **values: float) -> MetricLine:
    return MetricLine(step, "val", 0.0, values)


@pytest.mark.filterwarnings("error")
def test_evaluations_are_reported_once_each_in_percent(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, objectives=(Objective("val/mIoU", "maximize"),), trials=1)
    task = taken(desk)
    assert task.report is not None
    assert task.report(line(2, mIoU=0.5, Var=9.0)) == ""
    assert task.report(line(2, mIoU=0.75)) == "", "a run that resumed writes its lines again"
    assert task.report(line(4, mIoU=0.125)) == ""
    assert task.report(line(6, loss=1.0)) == ""
    assert task.report(line(8, mIoU=math.nan)) == ""
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


def in_turn(desk: Desk, points: list[PlannedPoint]) -> list[int]:
    """Let `more` of a desk add the next of `points` when all known ones are finished."""
    calls: list[int] = []
    source = desk.driver.source
    assert isinstance(source, ListSource)

    def more() -> list[PlannedPoint]:
        calls.append(len(source.plans))
        done = all(outcome.state == "finished" for outcome in source.statuses())
        return points[len(source.plans) : len(source.plans) + 1] if done else []

    source.more = more
    return calls


def test_list_source_adds_points_when_none_is_waiting(tmp_path: Path) -> None:
    every = plans(3)
    desk = list_desk(tmp_path, every[:2])
    calls = in_turn(desk, every)
    first, second = taken(desk), taken(desk)
    assert calls == [], "points are waiting"
    done(desk, first)
    assert desk.driver.source.next() is None
    done(desk, second)
    added = taken(desk)
    assert added.plan.point.label == "x=2"
    done(desk, added)
    assert desk.driver.source.next() is None
    assert is_exhausted(desk, wait=True)


def test_list_source_resumed_adds_all_finished_points_at_once(tmp_path: Path) -> None:
    every = plans(5)
    storage = memory()
    before = list_desk(tmp_path, every[:1], storage=storage)
    in_turn(before, every[:4])
    while task := before.driver.source.next():
        done(before, task)
    assert len(before.store.trials()) == 4
    again = list_desk(tmp_path, every[:1], storage=storage)
    in_turn(again, every)
    assert taken(again).plan.point.label == "x=4", "three points were added and finished before"


def test_list_source_points_that_two_drivers_add_are_run_once(tmp_path: Path) -> None:
    storage, every = memory(), plans(2)
    desks = [list_desk(tmp_path, every[:1], storage=storage, owner=owner) for owner in (None, DEAD)]
    first = taken(desks[0])
    for desk in desks:
        in_turn(desk, every)
    assert desks[1].driver.source.next() is None
    done(desks[0], first)
    added = taken(desks[0])
    assert desks[1].driver.source.next() is None, "the other driver runs the added point"
    assert not is_exhausted(desks[1], wait=True)
    done(desks[0], added)
    assert desks[1].driver.source.next() is None
    assert is_exhausted(desks[1], wait=True)
    assert len(desks[0].store.trials()) == 2
