"""One running trial: its processes, adopted runs, failures, and the files it reads meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rgbt.files.atomic import holding
from rgbt.runs.folder import MetricLine, RunFolder
from rgbt.runs.result import RunResult
from rgbt.tracking.mlflow_store import NoTracking
from sweeps.evaluation import Words, counts_of
from sweeps.point import Point
from sweeps.run import running_trial as works
from sweeps.run.planner import PlannedPoint
from sweeps.run.run_store import RunStore
from sweeps.run.running_trial import (
    LOGS,
    ClaimedTrial,
    PruningCallback,
    RunningTrial,
    TrialError,
    TrialPruned,
    mean_scores,
)
from tests.sweeps.fakes import (
    Behaviour,
    Call,
    FakeExecutor,
    Process,
    fail,
    finish,
    hang,
    leave,
    measure,
    plan_of,
    scored,
    succeed,
    until,
)

POINT = Point("p", ("x=1",))
PLAN = plan_of(POINT)
KEY = PLAN.key
RGB, RING = ("modality=rgb",), ("modality=thermal", "regions=ring9")
ALIGNED, RELEASED, NEXT = ((f"frames={each}",) for each in ("aligned", "released", "next"))


class Bench:
    """A work with fake processes."""

    def __init__(
        self,
        runs_dir: Path,
        plan: PlannedPoint = PLAN,
        behaviour: Behaviour = succeed,
        report: PruningCallback | None = None,
        timeout_s: float = math.inf,
        trust: str = "",
    ) -> None:
        self.executor = FakeExecutor(runs_dir, behaviour)
        self.runs = RunStore(runs_dir, NoTracking())
        claimed = ClaimedTrial(plan, 0, report)
        self.work = RunningTrial(claimed, self.runs, self._start, timeout_s, trust)

    def _start(self, command: Any, log: Path) -> Any:
        return self.executor.start(command, {}, log)

    def run(self) -> tuple[RunResult, ...]:
        """Advance until it is done."""
        found: list[Any] = [None]

        def ended() -> bool:
            found[0] = self.work.advance()
            return found[0] is not None

        until(ended, "the work")
        results: tuple[RunResult, ...] = found[0]
        return results


def evaluated(**evaluation: Any) -> PlannedPoint:
    return plan_of(Point("p", ("dataset.root=/x",), **evaluation))


def test_running_trial_starts_follows_and_finds_run(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    assert bench.work.advance() is None
    assert (bench.work.status, bench.work.done_share) == ("training", 0)
    assert bench.work.advance() is None
    assert bench.work.score == 0.2
    assert bench.work.done_share == 0.5, "step 2 of 4"
    assert bench.run() == (RunResult(tmp_path / KEY),)
    (call,) = bench.executor.calls
    assert (call.module, call.words) == ("rgbt.run", ("x=1",))
    assert call.log == tmp_path / LOGS / f"{KEY}.log"
    assert bench.work.is_stopped()
    assert bench.work.done_share == 1.0


def test_running_trial_fresh_retrains_other_code_once(tmp_path: Path) -> None:
    finish(tmp_path / KEY).add_provenance({"code": "0" * 64, "diff": ""})
    assert Bench(tmp_path).run()[0].other_code, "without fresh it is taken"
    for calls in (1, 0):  # and given again, nothing is left to do
        bench = Bench(tmp_path)
        bench.runs.fresh = True
        (found,) = bench.run()
        assert len(bench.executor.calls) == calls
        assert (found.folder, found.other_code) == (tmp_path / KEY, None)
    assert [path.name for path in (tmp_path / "replaced").iterdir()] == [f"{KEY}-1"]


def test_running_trial_reports_first_seed_only(tmp_path: Path) -> None:
    plan = plan_of(Point("p", ("x=1",), seeds=(0, 1)))
    steps: list[int] = []
    bench = Bench(tmp_path, plan, report=lambda line: steps.append(line.step) or "")
    assert [one.key for one in bench.run()] == [run.key for run in plan.runs]
    assert bench.executor.started() == [("x=1", "seed=0"), ("x=1", "seed=1")]
    assert steps == [2, 4]


def test_mean_scores_averages_shared_scores(tmp_path: Path) -> None:
    finish(tmp_path / "a", val={"mIoU": 0.5}, test={"mIoU": 0.25, "Var": 9.0, "class/car": None})
    finish(tmp_path / "b", val={"mIoU": 0.25}, test={"mIoU": 0.75, "Var": 1.0, "class/car": 0.5})
    found = [RunResult(tmp_path / key) for key in "ab"]
    means = {"val/mIoU": 37.5, "test/mIoU": 50.0, "test/Var": 5.0}
    assert mean_scores(found) == mean_scores(found[::-1]) == means


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [
        (fail, "ValueError: a bad day"),
        (leave(-11), "stopped by SIGSEGV"),
        (leave(0), f"the run finished with another key than {KEY}: its configuration"),
    ],
    ids=["raises", "crashes", "another configuration"],
)
def test_running_trial_failure_has_reason(
    tmp_path: Path, behaviour: Behaviour, reason: str
) -> None:
    bench = Bench(tmp_path, PLAN, behaviour)
    with pytest.raises(TrialError, match=f"^{reason}"):
        bench.run()
    with pytest.raises(TrialError, match=f"^{reason}"):
        bench.work.advance()
    assert len(bench.executor.calls) == 1


def test_running_trial_adopts_run_of_other_process(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / KEY)
    scores: list[float] = []
    bench = Bench(tmp_path, report=lambda line: scores.append(line.values["mIoU"]) or "")
    with holding(run.path / "lock"):
        for _ in range(3):
            assert bench.work.advance() is None
        assert bench.work.status == "adopted"
        run.append(2, "val", {"mIoU": 0.3})
        assert bench.work.advance() is None
        assert scores == [0.3], "followed as if it were ours"
        finish(run.path)
    assert [found.key for found in bench.run()] == [KEY]
    assert bench.executor.calls == []


def test_running_trial_restarts_adopted_run_that_died(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    with holding(RunFolder(tmp_path / KEY).path / "lock"):
        assert bench.work.advance() is None
    bench.run()
    assert len(bench.executor.calls) == 1


def test_running_trial_adopts_run_taken_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two drivers start the same run at the same moment: the lock decides."""
    held: Callable[[Path], bool] = works.is_held
    looks: list[Path] = []
    with holding(RunFolder(tmp_path / KEY).path / "lock"):
        monkeypatch.setattr(
            works, "is_held", lambda path: bool(looks.append(path) or looks[1:] and held(path))
        )
        bench = Bench(tmp_path, PLAN, leave(2, "rgbt: it is being trained by process 1"))
        until(lambda: bench.work.advance() or bench.work.status == "adopted", "the adoption")
        finish(tmp_path / KEY)
    bench.run()
    assert len(bench.executor.calls) == 1


def test_running_trial_timeout_stops_own_run_only(tmp_path: Path) -> None:
    bench = Bench(tmp_path, PLAN, hang, timeout_s=0.03)
    with pytest.raises(TrialError, match="timeout_minutes"):
        bench.run()
    assert bench.executor.calls[0].stops == 1
    assert bench.work.is_stopped()
    bench = Bench(tmp_path, timeout_s=0.03)
    with (
        holding(RunFolder(tmp_path / KEY).path / "lock"),
        pytest.raises(TrialError, match="timeout_minutes"),
    ):
        bench.run()
    assert bench.executor.calls == []


def test_running_trial_pruned_names_step(tmp_path: Path) -> None:
    def report(line: Any) -> str:
        return f"pruned at step {line.step}" if line.values["mIoU"] > 0.1 else ""

    bench = Bench(tmp_path, PLAN, scored(0.2, end=hang), report)
    with pytest.raises(TrialPruned, match="pruned at step 2"):
        bench.run()
    assert bench.executor.calls[0].stops == 1
    with pytest.raises(TrialPruned, match="pruned at step 2"):
        bench.work.advance()


def evaluating(call: Call) -> Process:
    """``rgbt.evaluate``, and ``rgbt.consistency`` with both protocols of virtual views in one."""
    if call.module == "rgbt.run":
        return (yield from succeed(call))
    yield
    others = ("run=", "trust=", "dataset.root=")
    made: list[Words] = [tuple(word for word in call.words if not word.startswith(others))]
    if call.module == "rgbt.consistency":
        made = [NEXT] if call.value("frames") == "next" else [ALIGNED, RELEASED]
    for words in made:
        measure(Path(call.value("run")), words)
    return 0


def test_running_trial_evaluates_finished_run(tmp_path: Path) -> None:
    plan = evaluated(evaluations=(RGB, RING, RELEASED, ALIGNED, NEXT))
    bench = Bench(tmp_path, plan, evaluating, trust="my_lab")
    (found,) = bench.run()
    run, own, root = f"run={found.folder}", "trust=my_lab", "dataset.root=/x"
    assert [(call.module, *call.words) for call in bench.executor.calls[1:]] == [
        ("rgbt.evaluate", run, "modality=rgb", own, root),
        ("rgbt.evaluate", run, "modality=thermal", "regions=ring9", own, root),
        ("rgbt.consistency", run, "frames=virtual", own, root),
        ("rgbt.consistency", run, "frames=next", own, root),
    ]
    for words in plan.point.evaluations:
        assert counts_of(found, words).counts[0, 0, 0, 0] == 2
    assert found.counts().counts[0, 0, 0, 0] == 3
    assert Bench(tmp_path, plan, fail).work.advance() is not None, "all there: nothing is started"


def test_running_trial_failed_evaluation_fails_trial(tmp_path: Path) -> None:
    plan = evaluated(evaluations=(RING,))
    finish(tmp_path / plan.runs[0].key)
    for behaviour, reason in (
        (fail, "a bad day"),
        (leave(0), f"it wrote no counts of {' '.join(RING)}"),
    ):
        with pytest.raises(TrialError, match=reason):
            Bench(tmp_path, plan, behaviour).run()


def test_running_trial_unsent_report_is_retried(tmp_path: Path) -> None:
    told: list[int] = []

    def report(line: Any) -> str:
        told.append(line.step)
        if len(told) == 1:
            raise ConnectionError("the storage is away for a moment")
        return ""

    bench = Bench(tmp_path, report=report)
    bench.work.advance()
    with pytest.raises(ConnectionError):
        bench.work.advance()
    assert len(bench.run()) == 1
    assert told == [2, 2, 4]


def test_running_trial_reports_whole_lines_once(tmp_path: Path) -> None:
    steps: list[int] = []
    bench = Bench(tmp_path, PLAN, hang, lambda line: steps.append(line.step) or "")
    assert bench.work.advance() is None
    run = RunFolder(tmp_path / KEY)
    run.append(1, "train", {"loss": 2.0})
    run.append(2, "val", {"mIoU": 0.5, "class/car": math.nan})
    text = MetricLine(3, "val", 0.0, {"mIoU": 0.6}).text()
    with (run.path / "metrics.jsonl").open("ab") as file:
        for part, seen, score in ((text[:20], [2], 0.5), (text[20:], [2, 3], 0.6)):
            file.write(part)
            file.flush()
            assert bench.work.advance() is None
            assert (steps, bench.work.score) == (seen, score)
    run.truncate_after(2)  # a run that resumes writes its lines again
    run.append(3, "val", {"mIoU": 0.1})
    run.append(4, "val", {"mIoU": 0.2})
    assert bench.work.advance() is None
    assert (steps, bench.work.done_share) == ([2, 3, 4], 1.0)
