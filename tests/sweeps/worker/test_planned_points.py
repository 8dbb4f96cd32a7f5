"""Points are planned once, while the first runs train; a wrong one is refused."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.tracking.mlflow_store import NoTracking
from sweeps import attributes as names
from sweeps.point import Point
from sweeps.worker import driver as drivers
from sweeps.worker import point_list, trial_sources
from sweeps.worker.planned_points import PlannedPoints
from sweeps.worker.planner import PlannedPoint
from sweeps.worker.point_list import PointList, run_points
from sweeps.worker.run_store import RunStore
from sweeps.worker.storage import find_study
from sweeps.worker.trial_store import counted_trials
from tests.sweeps.fakes import FakeExecutor, hang, key_of, plan_of, quick, settings

__all__ = ["quick"]


class CountingPlanner:
    """Counts how often each point is planned; points with "wrong" do not fit."""

    def __init__(self, executor: FakeExecutor | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self.started: dict[str, int] = {}
        self._executor = executor

    def plan(self, point: Point) -> PlannedPoint:
        self.counts[point.label] += 1
        self.started[point.label] = len(self._executor.calls) if self._executor else 0
        if "wrong" in point.overrides:
            raise InputError("wrong=1 is no key.")
        return plan_of(point)


@pytest.fixture
def executor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick: None) -> FakeExecutor:
    """One point is planned before the first run starts, and one between two polls."""
    del quick
    made = FakeExecutor(tmp_path)
    monkeypatch.setattr(drivers, "LocalExecutor", lambda workers: made)
    monkeypatch.setattr(point_list, "PLANNED_FIRST_S", 1e-9)
    monkeypatch.setattr(trial_sources, "PLAN_S", 0.0)
    return made


def grid(runs: Path, *words: str) -> PointList:
    points = tuple(Point(word, (word,), tags={"t": "grid"}) for word in words)
    return PointList("s", "s", "grid", points, RunStore(runs, NoTracking()))


def test_run_points_plans_each_point_once_while_runs_train(
    tmp_path: Path, executor: FakeExecutor
) -> None:
    planner = CountingPlanner(executor)
    words = [f"x={x}" for x in range(6)]
    outcomes = run_points(grid(tmp_path, *words), settings(), planner, strict=True)  # type: ignore[arg-type]
    assert [(each.point.label, each.state) for each in outcomes] == [(w, "finished") for w in words]
    assert planner.counts == dict.fromkeys(words, 1)
    assert executor.started() == [(word,) for word in words], "the order of the points"
    assert planner.started["x=0"] == 0
    assert planner.started["x=5"] > 0, "a run had started when the last point was planned"


def test_run_points_later_wrong_point_stops_the_runs_and_keeps_them(
    tmp_path: Path, executor: FakeExecutor
) -> None:
    executor.behaviour = hang
    planner = CountingPlanner(executor)
    wrong = grid(tmp_path, "x=0", "x=1", "wrong", "x=2")
    with pytest.raises(InputError, match=r"^wrong: wrong=1 is no key\.$"):
        run_points(wrong, settings(), planner, strict=True)  # type: ignore[arg-type]
    assert planner.started["wrong"] == 1, "the first run had started"
    assert [call.stops for call in executor.calls] == [1]
    study = find_study("s", None, tmp_path)
    assert study is not None
    assert counted_trials(study) == [], "nothing failed: the point is waiting again"
    assert all(names.DROPPED in trial.user_attrs for trial in study.get_trials())
    executor.behaviour = FakeExecutor(tmp_path).behaviour
    right = grid(tmp_path, "x=0", "x=1", "x=2")
    again = run_points(right, settings(), CountingPlanner(), strict=True)  # type: ignore[arg-type]
    assert [each.state for each in again] == ["finished"] * 3
    assert executor.calls[1].folder == executor.calls[0].folder, "the stopped run resumed"


def test_run_points_wrong_among_the_first_starts_nothing(
    tmp_path: Path, executor: FakeExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(point_list, "PLANNED_FIRST_S", 60.0)
    words = grid(tmp_path, "x=0", "wrong")
    with pytest.raises(InputError, match="wrong: wrong=1"):
        run_points(words, settings(), CountingPlanner(), strict=True)  # type: ignore[arg-type]
    assert executor.calls == []
    assert list(tmp_path.iterdir()) == []


def test_run_points_without_strict_runs_the_other_points(
    tmp_path: Path, executor: FakeExecutor
) -> None:
    words = grid(tmp_path, "x=0", "wrong", "x=1")
    outcomes = run_points(words, settings(), CountingPlanner())  # type: ignore[arg-type]
    assert [each.state for each in outcomes] == ["finished", "failed", "finished"]
    assert len(executor.calls) == 2


def test_driver_plans_instead_of_waiting(
    tmp_path: Path, executor: FakeExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = CountingPlanner(executor)

    def sleep(seconds: float) -> None:
        assert len(planner.counts) == 3, f"waited {seconds} s while points were not planned"

    monkeypatch.setattr(drivers.time, "sleep", sleep)
    words = grid(tmp_path, "x=0", "x=1", "x=2")
    run_points(words, settings(), planner, strict=True)  # type: ignore[arg-type]
    assert len(planner.counts) == 3


def test_planned_points_equal_runs_are_one(tmp_path: Path) -> None:
    class SameRun(CountingPlanner):
        def plan(self, point: Point) -> PlannedPoint:
            return plan_of(Point(point.label, ("x=1",)))

    points = [Point(label, (f"x={label}",)) for label in ("1", "1.0")]
    planned = PlannedPoints("s", points, SameRun(), strict=True)  # type: ignore[arg-type]
    assert (planned.num_runs, planned.num_left) == (0, 2)
    planned.plan(0.0)
    assert (planned.num_runs, planned.num_left) == (1, 1)
    planned.plan()
    assert (planned.num_runs, planned.num_left) == (1, 0)
    assert {plan.key for plan in planned.plans.values()} == {key_of(("x=1",))}


def test_planned_points_are_shown_where_stderr_is_no_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sweeps.worker import planned_points, progress

    monkeypatch.setattr(progress, "SAY_S", -1.0)
    monkeypatch.setattr(planned_points, "SHOWN_S", 0.0)
    points = [Point(f"x={x}", (f"x={x}",)) for x in range(3)]
    PlannedPoints("s", points, CountingPlanner()).plan_and_show("grid")  # type: ignore[arg-type]
    said = capsys.readouterr().err.splitlines()
    assert [line.split(maxsplit=1)[1] for line in said] == [
        f"planned  {count} of 3 points" for count in (1, 2, 3)
    ]
