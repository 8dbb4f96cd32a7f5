"""Points known in advance: their estimated time, and the tags of a shared run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.runs.naming import VARIED
from rgbt.runs.provenance import code
from rgbt.runs.result import RunResult
from sweeps.point import COLOUR, Outcome, Point, colour
from sweeps.worker import driver as drivers
from sweeps.worker import point_list
from sweeps.worker.planner import PlannedPoint
from sweeps.worker.point_list import (
    PointList,
    estimated_seconds,
    other_code_line,
    preview_points,
    run_points,
)
from sweeps.worker.run_store import RunStore
from tests.sweeps.fakes import (
    FakeExecutor,
    FakePlanner,
    fail,
    finish,
    only,
    plan_of,
    quick,
    settings,
)

__all__ = ["quick"]


def made(folder: Path, seconds: float) -> Outcome:
    run = finish(folder)
    (folder / "result.json").write_text(f'{{"seconds_of_last_process": {seconds}}}')
    return Outcome(Point("p", ()), "finished", results=(RunResult(run.path),))


def test_estimated_seconds_is_median_over_workers(tmp_path: Path) -> None:
    known = [made(tmp_path / str(seconds), seconds) for seconds in (10, 20, 90)]
    left = [Outcome(Point("q", ()), state) for state in ("waiting", "failed", "running")]
    assert estimated_seconds([*known, *left], 1) == 40.0  # type: ignore[list-item]
    assert estimated_seconds([*known, *left], 2) == 20.0  # type: ignore[list-item]
    assert estimated_seconds(left, 1) is None


class OneKey:
    """Plans every point as the same run."""

    def __init__(self, base: object) -> None:
        del base

    def plan(self, point: Point) -> PlannedPoint:
        if "wrong" in point.overrides:
            raise InputError("wrong=1 is no key.")
        return replace(plan_of(replace(point, overrides=("x=1",))), point=point)


def wanted(tmp_path: Path, *points: Point) -> PointList:
    from rgbt.tracking.mlflow_store import NoTracking

    return PointList("s", "s", "list", points, RunStore(tmp_path, NoTracking()))


def test_points_that_are_one_run_share_their_tags(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(point_list, "Planner", OneKey)
    rows = [Point(label, (f"x={label}",), tags={"table": label}) for label in ("1", "1.0")]
    prepared = point_list._planned(wanted(tmp_path, *rows), None)
    prepared.plan()
    first, second = (plan.point.tags for plan in prepared.plans.values())
    assert first == second == {"table": "1 | 1.0", VARIED: "x", COLOUR: colour("s", 0)}


def test_colours_of_a_grid_are_distinct() -> None:
    colours = [colour("s", index) for index in range(20)]
    assert all(re.fullmatch("#[0-9a-f]{6}", each) for each in colours)
    assert len(set(colours)) == 20
    channels = np.array([[int(each[n : n + 2], 16) for n in (1, 3, 5)] for each in colours[:9]])
    apart = np.abs(channels[:, None] - channels[None]).sum(-1) + 999 * np.eye(9, dtype=int)
    assert apart.min() > 40


def test_runs_of_other_code_are_counted_in_one_line(tmp_path: Path) -> None:
    found = []
    for name, digest in (("a", "0" * 64), ("b", code()["code"]), ("c", "1" * 64)):
        run = finish(tmp_path / name)
        run.add_provenance({"code": digest, "diff": ""})
        found.append(RunResult(run.path))
    outcomes = [Outcome(Point("p", ()), "finished", results=tuple(found[:2]))] * 2
    assert other_code_line(outcomes[:0]) == ""
    assert other_code_line([Outcome(Point("p", ()), "finished", results=(found[1],))]) == ""
    outcomes.append(Outcome(Point("q", ()), "finished", results=(found[2],)))
    assert other_code_line(outcomes) == (
        "2 of 3 runs were made by other code; fresh=true retrains them and keeps the old runs."
    )


def test_point_list_all_points_wrong_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(point_list, "Planner", OneKey)
    wrong, good = Point("a", ("wrong",)), Point("b", ("x=1",))
    with pytest.raises(InputError, match="wrong=1 is no key"):
        preview_points(wanted(tmp_path, wrong, wrong), settings())
    states = [
        outcome.state for outcome in preview_points(wanted(tmp_path, wrong, good), settings())
    ]
    assert states == ["failed", "waiting"]
    assert list(tmp_path.iterdir()) == []


def test_estimated_seconds_ignores_trained_points(tmp_path: Path) -> None:
    trained = replace(made(tmp_path / "a", 40), state="waiting")
    waiting = Outcome(Point("q", ()), "waiting")
    assert [each.is_trained for each in (trained, waiting)] == [True, False]
    assert estimated_seconds([trained, waiting], 1) == 40.0
    assert estimated_seconds([trained], 1) == 0.0


@pytest.fixture
def executor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick: None) -> FakeExecutor:
    """Runs the processes of `run_points`."""
    del quick
    made = FakeExecutor(tmp_path)
    monkeypatch.setattr(drivers, "LocalExecutor", lambda workers: made)
    monkeypatch.setattr(point_list, "Planner", lambda base: FakePlanner())
    return made


def growing(tmp_path: Path, last: int) -> PointList:
    """A list of x=0, to which x=1, ... `last` are added, each when all others are finished."""

    def more(outcomes: Sequence[Outcome]) -> list[Point]:
        x = len(outcomes)
        done = all(outcome.state == "finished" for outcome in outcomes)
        return [Point(f"x={x}", (f"x={x}",))] if done and x <= last else []

    return replace(wanted(tmp_path, Point("x=0", ("x=0",))), more=more)


def test_run_points_runs_added_points_and_returns_their_outcomes(
    tmp_path: Path, executor: FakeExecutor
) -> None:
    outcomes = run_points(growing(tmp_path, 3), settings())
    assert [outcome.point.label for outcome in outcomes] == [f"x={x}" for x in range(4)]
    assert {outcome.state for outcome in outcomes} == {"finished"}
    assert executor.started() == [(f"x={x}",) for x in range(4)]


def test_run_points_resumed_continues_behind_the_added_points(
    tmp_path: Path, executor: FakeExecutor
) -> None:
    run_points(growing(tmp_path, 2), settings())
    again = run_points(growing(tmp_path, 4), settings())
    assert [outcome.state for outcome in again] == ["finished"] * 5
    assert executor.started()[3:] == [("x=3",), ("x=4",)], "nothing is run twice"


def test_run_points_failed_added_point_ends_the_list(
    tmp_path: Path, executor: FakeExecutor
) -> None:
    executor.behaviour = only("x=1", fail)
    outcomes = run_points(growing(tmp_path, 3), settings())
    assert [outcome.state for outcome in outcomes] == ["finished", "failed"]
    assert outcomes[1].reason == "ValueError: a bad day"
