"""A running point: how its job ends, and the files that are read meanwhile; averaged scores."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.runs.folder import MetricLine, RunFolder
from rgbt.runs.result import RunResult
from rgbt.tracking.tracker import Tracking
from sweeps.plan.planner import PlannedPoint
from sweeps.point import Outcome, Point
from sweeps.run import running_point
from sweeps.run.point_state import work_of
from sweeps.run.run_store import RunStore
from sweeps.run.running_point import RunningPoint
from tests.sweeps.fakes import (
    Behaviour,
    FakeExecutor,
    fail,
    finish,
    hang,
    leave,
    nth,
    plan_of,
    scored,
    succeed,
)

PLAN = plan_of(Point("p", ("x=1",)))


class Bench:
    """A point and its job; `steps` are those of the validations that are reported."""

    def __init__(self, runs_dir: Path, behaviour: Behaviour = succeed, plan: Any = PLAN) -> None:
        self.executor, self.runs = FakeExecutor(behaviour), RunStore(runs_dir, Tracking())
        work = work_of(plan, self.runs, "")
        (job,) = self.executor.submit([work])
        self.point, self.steps = RunningPoint(plan, job, work.log, 0), list[int]()

    def report(self, plan: PlannedPoint, line: MetricLine) -> str:
        self.steps.append(line.step)
        return ""

    def advance(self) -> Outcome | None:
        return self.point.advance(self.executor, self.runs, self.report)

    def run(self) -> Outcome:
        while (outcome := self.advance()) is None:
            pass
        return outcome


def test_a_point_is_followed_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = [100.0]
    monkeypatch.setattr(running_point, "time", SimpleNamespace(monotonic=lambda: seconds[0]))
    bench = Bench(tmp_path, scored(0.1, 0.2, 0.4))
    bench.executor.is_full = True
    assert bench.advance() is None
    assert not bench.point.is_started
    bench.executor.is_full = False
    seconds[0] = 105.0  # it waits for so long
    seen = []
    for _ in range(3):
        assert bench.advance() is None
        seen.append((bench.point.is_started, bench.point.step, bench.point.seconds_left))
        seconds[0] += 10
    assert str(seen) == "[(True, 0, nan), (True, 2, nan), (True, 4, 0.0)]"
    assert bench.point.score == 0.2
    end = bench.run()
    assert (end.state, end.reason, end.job_s) == ("finished", "", 30.0)
    assert end.keys == (PLAN.key,)
    assert end.results == (RunResult(tmp_path / PLAN.key),)


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [
        (fail, "ValueError: a bad day"),
        (leave(-11), "stopped by SIGSEGV"),
        (leave(0), f"the run finished with another key than {PLAN.key}: its configuration"),
    ],
    ids=["raises", "crashes", "another configuration"],
)
def test_a_failure_has_a_reason(tmp_path: Path, behaviour: Behaviour, reason: str) -> None:
    end = Bench(tmp_path, behaviour).run()
    assert end.state == "failed"
    assert end.reason.startswith(reason)


@pytest.mark.parametrize(
    ("word", "reason"),
    [("ended", "its job was lost; see {}"), ("out of memory", "job 0: out of memory")],
)
def test_a_lost_job_has_a_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, word: str, reason: str
) -> None:
    bench = Bench(tmp_path)
    monkeypatch.setattr(bench.executor, "state", lambda _: word)
    assert bench.run().reason == reason.format(bench.point.log)


def test_scores_are_averaged_where_all_runs_have_them(tmp_path: Path) -> None:
    finish(tmp_path / "a", val={"mIoU": 0.5}, test={"mIoU": 0.25, "Var": 9.0, "class/car": None})
    finish(tmp_path / "b", val={"mIoU": 0.25}, test={"mIoU": 0.75, "Var": 1.0, "class/car": 0.5})
    found = tuple(RunResult(tmp_path / key) for key in "ab")
    means = {"val/mIoU": 37.5, "test/mIoU": 50.0, "test/Var": 5.0}
    for results in (found, found[::-1]):
        assert Outcome(Point("p", ()), "finished", results=results).scores() == means


def test_validations_of_the_first_seed_are_reported(tmp_path: Path) -> None:
    plan = plan_of(Point("p", ("x=1",), seeds=(0, 1)))
    bench = Bench(tmp_path, nth(scored(0.2, 0.4), scored(0.2, 0.4, 0.5)), plan)
    assert [result.key for result in bench.run().results] == [run.key for run in plan.runs]
    assert bench.steps == [2, 4]


def test_a_report_that_was_not_stored_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(plan: PlannedPoint, line: MetricLine) -> str:
        bench.steps.append(line.step)
        raise ConnectionError("the storage is away for a moment")

    bench = Bench(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(bench, "report", away)
        with pytest.raises(ConnectionError):
            bench.run()
    assert bench.run().state == "finished"
    assert bench.steps == [2, 2, 4]


def test_whole_lines_are_reported_once(tmp_path: Path) -> None:
    bench = Bench(tmp_path, hang)
    assert bench.advance() is None
    run = RunFolder(tmp_path / PLAN.key)
    run.append(1, "train", {"loss": 2.0})
    run.append(2, "val", {"mIoU": 0.5, "class/car": math.nan})
    text = MetricLine(3, "val", 0.0, {"mIoU": 0.6}).text()
    with (run.path / "metrics.jsonl").open("ab") as file:
        for part, seen, score in ((text[:20], [2], 0.5), (text[20:], [2, 3], 0.6)):
            file.write(part)
            file.flush()
            assert bench.advance() is None
            assert (bench.steps, bench.point.score) == (seen, score)
    run.truncate_after(2)  # a run that resumes writes its lines again
    run.append(3, "val", {"mIoU": 0.1})
    run.append(4, "val", {"mIoU": 0.2})
    assert bench.advance() is None
    assert (bench.steps, bench.point.step) == ([2, 3, 4], 4)
