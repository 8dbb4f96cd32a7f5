"""Lists of points: planned once while the first runs train, claimed in order, each run once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.files.plain_files import write_json
from rgbt.runs.naming import VARIED
from rgbt.runs.provenance import code
from rgbt.runs.result import RunResult
from rgbt.tracking.mlflow_store import NoTracking
from sweeps import attributes as names
from sweeps.point import Outcome, Point
from sweeps.run import driver as drivers
from sweeps.run.planner import PlannedPoint
from sweeps.run.point_list import (
    ListSource,
    PointList,
    estimated_seconds,
    finished_runs,
    is_evaluated,
    other_code_line,
    preview_points,
    run_points,
)
from sweeps.run.run_store import RunStore
from sweeps.run.running_trial import ClaimedTrial
from tests.sweeps.fakes import (
    Desk,
    FakeExecutor,
    FakePlanner,
    finish,
    list_desk,
    measure,
    memory,
    plan_of,
    points,
    quick,
    settings,
)

__all__ = ["quick"]


@pytest.fixture
def executor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick: None) -> FakeExecutor:
    """Runs the processes of `run_points`."""
    del quick
    made = FakeExecutor(tmp_path)
    monkeypatch.setattr(drivers, "LocalExecutor", lambda workers: made)
    return made


def a_list(runs: Path, *words: str, more: Any = None) -> PointList:
    planner: Any = FakePlanner()
    given = tuple(Point(word, (word,), tags={"t": "grid"}) for word in words)
    return PointList("s", "s", "grid", given, RunStore(runs, NoTracking()), planner, more)


def test_run_points_strict_with_wrong_point_starts_nothing(
    tmp_path: Path, executor: FakeExecutor
) -> None:
    with pytest.raises(InputError, match="wrong: wrong=1"):
        run_points(a_list(tmp_path, "x=0", "wrong"), settings(), strict=True)
    assert executor.calls == []
    assert list(tmp_path.iterdir()) == []


def test_wrong_points_fail_unless_all_are_wrong(tmp_path: Path, executor: FakeExecutor) -> None:
    with pytest.raises(InputError, match=r"^wrong=1 is no key"):
        preview_points(a_list(tmp_path, "wrong", "wrong"), settings())
    previews = preview_points(a_list(tmp_path, "wrong", "x=1"), settings())
    assert [outcome.state for outcome in previews] == ["failed", "waiting"]
    assert list(tmp_path.iterdir()) == []
    outcomes = run_points(a_list(tmp_path, "x=0", "wrong", "x=1"), settings())
    assert [each.state for each in outcomes] == ["finished", "failed", "finished"]
    assert len(executor.calls) == 2


@pytest.mark.parametrize(("trust", "is_refused"), [("", True), ("my_lab", False)])
def test_untrusted_class_is_refused_before_training(
    tmp_path: Path, trust: str, is_refused: bool
) -> None:
    class OwnLoss(FakePlanner):
        def plan(self, point: Point) -> PlannedPoint:
            planned = plan_of(point)
            loss = {"_target_": "my_lab.Loss"}
            runs: Any = [SimpleNamespace(**{**vars(planned.runs[0]), "plain": {"loss": loss}})]
            return replace(planned, runs=tuple(runs))

    (tmp_path / "my_lab.py").write_text("class Loss: ...\n")
    given = (Point("a", ("x=1",)), Point("b", ("x=2",), evaluations=(("modality=rgb",),)))
    wanted = replace(a_list(tmp_path), points=given, planner=OwnLoss())  # type: ignore[arg-type]
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(tmp_path))
        source = ListSource(wanted, settings(trust=trust))
    states = {each.point.label: each for each in source.outcomes(preview=True)}
    assert states["a"].state == "waiting", "nothing opens its run"
    assert ("my_lab.Loss" in states["b"].reason) == is_refused


def test_waits_for_the_second_trial_of_a_killed_driver(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, points(1))
    desk.run()
    assert desk.source.is_exhausted(wait=True)
    second = desk.store.claim(desk.plans[0].attributes, replaced=[0])
    assert second == 1, "as if it had been killed before it compared"
    assert not desk.source.is_exhausted(wait=True)
    assert desk.source.is_exhausted(wait=False)
    desk.store.release(second)
    assert desk.source.is_exhausted(wait=True)


def test_equal_points_are_one_run_and_share_their_tags(tmp_path: Path) -> None:
    class SameRun(FakePlanner):
        def plan(self, point: Point) -> PlannedPoint:
            return replace(plan_of(replace(point, overrides=("x=1",))), point=point)

    rows = tuple(Point(label, (f"x={label}",), tags={"table": label}) for label in ("1", "1.0"))
    wanted = replace(a_list(tmp_path), points=rows, planner=SameRun())  # type: ignore[arg-type]
    source = ListSource(wanted, settings())
    found = source.outcomes(preview=True)
    tags = {"table": "1 | 1.0", VARIED: "x"}
    assert [each.point.tags for each in found] == [tags, tags]


def taken(desk: Desk) -> ClaimedTrial:
    task: ClaimedTrial | None = desk.source.next()
    assert task is not None
    return task


def done(desk: Desk, task: ClaimedTrial) -> None:
    """The task's runs are finished, and the study knows."""
    for run in task.plan.runs:
        finish(desk.runs.runs_dir / run.key)
    desk.store.complete(task.number, [25.0], {names.RESULTS: {"test/mIoU": 25.0}})


def test_list_source_claims_points_in_order(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, points(2))
    assert [taken(desk).plan.point.label for _ in range(2)] == ["x=0", "x=1"]
    assert desk.source.next() is None
    trial = desk.store.trials()[1]
    assert trial.user_attrs[names.LABEL] == "x=1"
    assert trial.user_attrs[names.OVERRIDES] == ["x=1"]
    assert trial.user_attrs[names.RUNS] == [desk.plans[1].runs[0].key]


def test_a_point_whose_run_was_deleted_is_run_again(tmp_path: Path) -> None:
    storage = memory()
    before = list_desk(tmp_path, points(1), storage=storage)
    done(before, taken(before))
    assert before.source.next() is None
    (tmp_path / before.plans[0].key / "result.json").unlink()
    desk = list_desk(tmp_path, points(1), storage=storage)
    assert desk.source.states() == ["waiting"]
    assert taken(desk).number == 1


def test_failed_point_that_was_run_by_hand_is_finished(tmp_path: Path) -> None:
    storage = memory()
    before = list_desk(tmp_path, points(1), storage=storage)
    before.store.fail(taken(before).number, "a bad day", {})
    assert before.source.states() == ["failed"]
    finish(tmp_path / before.plans[0].key)
    assert list_desk(tmp_path, points(1), storage=storage).source.states() == ["finished"]


def test_finished_runs_require_all_runs_and_evaluations(tmp_path: Path) -> None:
    ring, rgb = ("regions=ring9",), ("modality=rgb",)
    plan = plan_of(Point("p", (), seeds=(0, 1), evaluations=(ring, rgb)))
    runs = RunStore(tmp_path, NoTracking())
    for run in plan.runs:
        assert finished_runs(plan, runs) == ()
        finish(tmp_path / run.key)
    both = finished_runs(plan, runs)
    assert [found.key for found in both] == [run.key for run in plan.runs]
    for found in both:
        for words in (ring, rgb):
            assert not is_evaluated(plan, both)
            measure(found.folder, words)
    assert is_evaluated(plan, both)
    finish(tmp_path / plan.runs[0].key, dataset="another")
    assert finished_runs(plan, runs) == ()


def growing(last: int) -> Callable[[Sequence[Outcome]], list[Point]]:
    """Adds x=1, ... `last` to x=0, each when all others are finished."""

    def more(outcomes: Sequence[Outcome]) -> list[Point]:
        x = len(outcomes)
        is_done = all(outcome.state == "finished" for outcome in outcomes)
        return [Point(f"x={x}", (f"x={x}",))] if is_done and x <= last else []

    return more


def test_run_points_resumed_continues_behind_the_added_points(
    tmp_path: Path, executor: FakeExecutor
) -> None:
    outcomes = run_points(a_list(tmp_path, "x=0", more=growing(2)), settings())
    assert [outcome.point.label for outcome in outcomes] == [f"x={x}" for x in range(3)]
    again = run_points(a_list(tmp_path, "x=0", more=growing(4)), settings())
    assert [outcome.state for outcome in again] == ["finished"] * 5
    assert executor.started() == [(f"x={x}",) for x in range(5)], "nothing is run twice"


def test_estimated_seconds_is_median_of_untrained_over_workers(tmp_path: Path) -> None:
    known = []
    for seconds in (10, 20, 90):
        folder = finish(tmp_path / str(seconds)).path
        write_json(folder / "result.json", {"seconds_of_last_process": seconds})
        known.append(Outcome(Point("p", ()), "finished", results=(RunResult(folder),)))
    left: list[Any] = [Outcome(Point("q", ()), state) for state in ("waiting", "failed", "running")]
    assert [estimated_seconds([*known, *left], workers) for workers in (1, 2)] == [40.0, 20.0]
    assert estimated_seconds(left, 1) is None
    assert estimated_seconds([replace(known[0], state="waiting")], 1) == 0.0


def test_runs_of_other_code_are_counted_in_one_line(tmp_path: Path) -> None:
    for name, digest in (("a", "0" * 64), ("b", code()["code"])):
        finish(tmp_path / name).add_provenance({"code": digest, "diff": ""})
    old, new = (RunResult(tmp_path / name) for name in "ab")
    assert other_code_line([Outcome(Point("p", ()), "finished", results=(new,))]) == ""
    outcomes = [Outcome(Point("p", ()), "finished", results=(old, new))] * 2
    assert other_code_line(outcomes).startswith("1 of 2 runs")
