"""What is worked on next: points of a list, and points that a sampler chooses."""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from optuna.distributions import CategoricalDistribution
from optuna.trial import TrialState

from rgbt.metrics.counts import Counts
from rgbt.spec.naming import VARIED
from rgbt.tracking.run_folder import MetricLine
from rgbt.tracking.run_result import RunResult
from sweeps import attributes as names
from sweeps.evaluation import ExtraEvaluation
from sweeps.point import COLOUR, Point, colour
from sweeps.settings import Objective
from sweeps.worker.list_source import ListSource, finished_runs, is_evaluated, reason_of
from sweeps.worker.planner import PlannedPoint
from sweeps.worker.run_store import RunStore
from sweeps.worker.sampler_source import short_override
from sweeps.worker.trial_source import ClaimedTrial
from sweeps.worker.trial_store import TrialClaim
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
    store_on,
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
    source = ListSource(
        desk.plans,
        desk.store,
        desk.runs,
        desk.driver.settings,
        {"x": CategoricalDistribution((0, 1))},
    )
    tasks = [source.next(), source.next()]
    assert [task.plan.point.label for task in tasks if task] == ["x=0", "x=1"]
    assert source.next() is None
    trial = desk.store.trials()[1]
    assert trial.params == {"x": 1}
    assert trial.user_attrs[names.LABEL] == "x=1"
    assert trial.user_attrs[names.OVERRIDES] == ["x=1"]
    assert trial.user_attrs[names.RUNS] == [desk.plans[1].runs[0].key]


def test_list_source_exhausted_depends_on_wait(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, plans(1))
    assert not is_exhausted(desk)
    task = taken(desk)
    assert status(desk).state == "running"
    assert is_exhausted(desk)
    assert not is_exhausted(desk, wait=True)
    done(desk, task)
    assert is_exhausted(desk, wait=True)
    assert status(desk).state == "finished"
    assert status(desk).results[0].key == desk.plans[0].key


def test_list_source_duplicate_point_is_one_trial(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, [*plans(1), *plans(1)])
    taken(desk)
    assert desk.driver.source.next() is None


def test_list_source_failed_point_waits_for_retry(tmp_path: Path) -> None:
    storage = memory()
    first = list_desk(tmp_path, plans(1), storage=storage)
    first.store.fail(taken(first).number, "a bad day", {})
    assert status(first).state == "failed"
    assert status(first).reason == "a bad day"
    assert first.driver.source.next() is None

    plain = list_desk(tmp_path, plans(1), storage=storage)
    assert plain.driver.source.next() is None
    again = list_desk(tmp_path, plans(1), storage=storage, retry="failed")
    assert status(again).state == "waiting"
    again.store.fail(taken(again).number, "another bad day", {})
    assert status(again).reason == "another bad day"
    assert again.driver.source.next() is None, "forgiven once, not for ever"


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


def test_other_points_in_the_study_are_left_alone(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, plans(1))
    desk.store.claim(TrialClaim("of another list", {}))
    taken(desk)
    assert desk.driver.source.next() is None
    assert is_exhausted(desk)


def test_list_source_failed_point_finished_by_hand(tmp_path: Path) -> None:
    storage = memory()
    before = list_desk(tmp_path, plans(1), storage=storage)
    before.store.fail(taken(before).number, "a bad day", {})
    finish(tmp_path / before.plans[0].key)
    desk = list_desk(tmp_path, plans(1), storage=storage)
    assert status(desk).state in ("finished", "waiting")


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
        found = runs.find(run.key, run.dataset)
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


def test_replicates_are_seeds_of_one_trial(tmp_path: Path) -> None:
    plan = taken(search_desk(tmp_path, trials=1, replicates=3)).plan
    assert plan.point.seeds == (0, 1, 2)
    assert len({run.key for run in plan.runs}) == 3


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


def test_sampler_source_copies_finished_duplicate(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, space=SMALL, trials=2)
    done(desk, taken(desk), 31.0)
    assert desk.driver.source.next() is None
    first, second = desk.store.trials()
    assert second.state.name == "COMPLETE"
    assert second.values == first.values == [31.0]
    assert second.user_attrs[names.RESULTS] == {"test/mIoU": 31.0}
    assert second.user_attrs[names.REASON] == "the same point as trial 0"
    assert is_exhausted(desk)


def test_sampler_source_drops_running_duplicate(tmp_path: Path, quick: None) -> None:
    desk = search_desk(tmp_path, space=SMALL, trials=2)
    task = taken(desk)
    assert desk.driver.source.next() is None
    assert len(desk.store.trials()) == 1, "a dropped one does not count"
    assert not is_exhausted(desk)
    done(desk, task)
    until(lambda: desk.driver.source.next() is None and is_exhausted(desk), "the second trial")
    assert desk.numbers("COMPLETE") == [0, desk.store.trials()[1].number]


def test_sampler_source_may_repeat_failed_point(tmp_path: Path) -> None:
    desk = search_desk(tmp_path, space=SMALL, trials=2)
    desk.store.fail(taken(desk).number, "a bad day", {})
    assert taken(desk).number == 1


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


def test_a_hopeless_trial_is_told_by_the_pruner(tmp_path: Path) -> None:
    import optuna

    pruner = optuna.pruners.ThresholdPruner(lower=20.0)
    objectives = (Objective("val/mIoU", "maximize"),)
    desk = search_desk(tmp_path, pruner=pruner, objectives=objectives, trials=1)
    report = taken(desk).report
    assert report is not None
    assert report(line(2, mIoU=0.5)) == ""
    assert report(line(4, mIoU=0.1)) == "pruned at step 4"


@pytest.mark.parametrize(
    ("override", "shown"),
    [
        ("masker.sigma_div=4.123456", "sigma_div=4.123"),
        ("+loss=cross_entropy", "loss=cross_entropy"),
        ("a.b.c=[1,2]", "c=[1,2]"),
        ("lr=0.00001", "lr=1e-05"),
    ],
)
def test_overrides_are_short_for_people(override: str, shown: str) -> None:
    assert short_override(override) == shown


def test_reason_of_trial_without_reason() -> None:
    store = store_on(memory())
    number = store.claim(TrialClaim("k", {}))
    assert number == 0
    store.study.tell(0, state=TrialState.FAIL)
    assert reason_of(store.trials()[0]) == "no reason was noted"


def test_has_counts_ignores_outdated_evaluation(tmp_path: Path) -> None:
    ring = ExtraEvaluation(regions="ring9")
    plan = plan_of(Point("p", (), evaluations=(ring,)))
    runs = list_desk(tmp_path, []).runs
    (run,) = plan.runs
    finish(tmp_path / run.key)
    found = runs.find(run.key, run.dataset)
    assert found is not None
    file = found.folder / ring.path
    file.parent.mkdir()
    shutil.copyfile(found.folder / "counts_test.npz", file)
    assert found.has_counts(ring.path)
    os.utime(file, (0, 0))
    assert found.has_counts(ring.path), "of a run made elsewhere there is no checkpoint"
    (found.folder / "best.pt").touch()  # the run was trained again since
    assert not found.has_counts(ring.path)
    assert known(plan, runs) is None
    replace(Counts.load(found.folder / "counts_test.npz"), dataset="other").save(file)
    assert not found.has_counts(ring.path)
    replace(Counts.load(found.folder / "counts_test.npz"), split="val").save(file)
    assert not found.has_counts(ring.path)
    file.write_bytes(b"half")
    assert not found.has_counts(ring.path)
