"""One point at work: its processes, what is adopted, why it fails."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rgbt.tracking.mlflow_store import NoTracking
from rgbt.tracking.run_files import read_description
from rgbt.tracking.run_folder import RunFolder
from rgbt.tracking.run_result import RunResult
from sweeps.evaluation import ExtraEvaluation
from sweeps.point import Point
from sweeps.worker import running_trial as works
from sweeps.worker.planner import PlannedPoint
from sweeps.worker.run_store import RunStore
from sweeps.worker.running_trial import (
    LOGS,
    ExecutionContext,
    PruningCallback,
    RunningTrial,
    TrialError,
    TrialPruned,
    mean_scores,
)
from tests.sweeps.fakes import (
    DEADLINE_S,
    Behaviour,
    Call,
    FakeExecutor,
    Process,
    counts,
    endless,
    fail,
    finish,
    first,
    hang,
    held_by_another,
    leave,
    let_go,
    only,
    plan_of,
    succeed,
    until,
)


class Bench:
    """A work with fake processes."""

    def __init__(
        self,
        runs_dir: Path,
        plan: PlannedPoint,
        behaviour: Behaviour = succeed,
        *,
        report: PruningCallback | None = None,
        timeout_s: float | None = None,
    ) -> None:
        self.executor = FakeExecutor(runs_dir, behaviour)
        self.runs = RunStore(runs_dir, NoTracking())
        context = ExecutionContext(self.runs, self._start, timeout_s)
        self.work = RunningTrial(plan, 0, context, report)

    def _start(self, command: Any, log: Path) -> Any:
        return self.executor.start(command, {}, log)

    def run(self) -> tuple[RunResult, ...]:
        """Advance until it is done."""
        found: list[tuple[RunResult, ...]] = []

        def ended() -> bool:
            one = self.work.advance()
            found.extend([] if one is None else [one])
            return one is not None

        until(ended, "the work")
        return found[0]


def point(**more: Any) -> Point:
    return Point("p", ("x=1",), **more)


def single() -> tuple[PlannedPoint, str]:
    plan = plan_of(point())
    return plan, plan.key


def made_by_other_code(run: RunFolder) -> None:
    run.add_provenance({"code": "0" * 64, "diff": ""})


def test_a_run_is_started_followed_and_found(tmp_path: Path) -> None:
    plan, key = single()
    bench = Bench(tmp_path, plan)
    assert bench.work.advance() is None
    assert bench.work.status == "training"
    assert bench.work.done_share == 0
    assert bench.work.advance() is None
    assert bench.work.score == 0.2
    assert bench.work.done_share == 0.5, "step 2 of 4"
    (found,) = bench.run()
    assert found == RunResult(tmp_path / key)
    (call,) = bench.executor.calls
    assert (call.module, call.words) == ("rgbt.run", ("x=1",))
    assert call.log == tmp_path / LOGS / f"{key}.log"
    assert bench.work.is_stopped()


def test_all_is_done_of_a_point_that_is_finished(tmp_path: Path) -> None:
    bench = Bench(tmp_path, single()[0])
    bench.run()
    assert bench.work.done_share == 1.0


def test_running_trial_finished_run_gets_tags_only(tmp_path: Path) -> None:
    plan = plan_of(point(tags={"rgbt.table/one": "row"}))
    finish(tmp_path / plan.key)
    bench = Bench(tmp_path, plan)
    assert bench.work.advance() is not None, "at once"
    assert bench.executor.calls == []
    description = read_description(tmp_path / plan.key)
    assert description is not None
    assert description.tags["rgbt.table/one"] == "row"


def test_running_trial_fresh_retrains_other_code_once(tmp_path: Path) -> None:
    plan, key = single()
    made_by_other_code(finish(tmp_path / key))
    assert Bench(tmp_path, plan).run()[0].other_code, "without fresh it is taken"

    for calls in (1, 0):  # and given again, nothing is left to do
        bench = Bench(tmp_path, plan)
        bench.runs.fresh = True
        (found,) = bench.run()
        assert len(bench.executor.calls) == calls
        assert (found.folder, found.other_code) == (tmp_path / key, None)
    assert [path.name for path in (tmp_path / "replaced").iterdir()] == [f"{key}-1"]


def test_running_trial_reports_first_seed_only(tmp_path: Path) -> None:
    plan = plan_of(point(seeds=(0, 1)))
    steps: list[int] = []

    def report(line: Any) -> str:
        steps.append(line.step)
        return ""

    bench = Bench(tmp_path, plan, report=report)
    found = bench.run()
    assert [one.key for one in found] == [run.key for run in plan.runs]
    assert bench.executor.started() == [("x=1", "seed=0"), ("x=1", "seed=1")]
    assert steps == [2, 4]


def test_mean_scores_averages_shared_scores(tmp_path: Path) -> None:
    finish(tmp_path / "a", val={"mIoU": 0.5}, test={"mIoU": 0.25, "Var": 9.0, "class/car": None})
    finish(tmp_path / "b", val={"mIoU": 0.25}, test={"mIoU": 0.75, "Var": 1.0, "class/car": 0.5})
    found = [RunResult(tmp_path / key) for key in "ab"]
    assert mean_scores(found) == {"val/mIoU": 37.5, "test/mIoU": 50.0, "test/Var": 5.0}


def say(text: str, code: int) -> Behaviour:
    def process(call: Call) -> Process:
        yield
        call.say(text)
        return code

    return process


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [
        (fail, "ValueError: a bad day"),
        (say("rgbt: masker.sigma_div must be positive, got -1.", 2), "masker.sigma_div must be"),
        (leave(3), "it ended with exit code 3 and no output"),
        (leave(-9), "stopped by SIGKILL (the system kills what takes too much memory)"),
        (leave(-11), "stopped by SIGSEGV"),
        (leave(0), "the run ended, but not as"),
    ],
    ids=["raises", "our sentence", "silent", "killed", "crashes", "another configuration"],
)
def test_a_failure_says_why(tmp_path: Path, behaviour: Behaviour, reason: str) -> None:
    bench = Bench(tmp_path, single()[0], behaviour)
    with pytest.raises(TrialError, match="^" + reason.replace("(", r"\(").replace(")", r"\)")):
        bench.run()
    with pytest.raises(TrialError):  # asked again it says the same
        bench.work.advance()
    assert len(bench.executor.calls) == 1


def test_the_reason_is_not_taken_from_an_earlier_process(tmp_path: Path) -> None:
    plan, key = single()
    log = tmp_path / LOGS / f"{key}.log"
    log.parent.mkdir()
    log.write_text("rgbt: an old mistake\n")
    with pytest.raises(TrialError, match="exit code 3"):
        Bench(tmp_path, plan, leave(3)).run()
    assert log.read_text().startswith("rgbt: an old mistake\n")


def test_a_configuration_that_changed_meanwhile_is_told(tmp_path: Path) -> None:
    def other_key(call: Call) -> Process:
        yield
        finish(tmp_path / "another-key")
        return 0

    plan, key = single()
    with pytest.raises(TrialError, match=f"not as {key}: its configuration, .* was changed"):
        Bench(tmp_path, plan, other_key).run()


def test_a_finished_run_on_other_files_fails(tmp_path: Path) -> None:
    plan, key = single()
    finish(tmp_path / key, dataset="another")
    bench = Bench(tmp_path, plan)
    with pytest.raises(TrialError, match="other files of the data set"):
        bench.run()
    assert bench.executor.calls == []


def test_running_trial_adopts_run_of_other_process(tmp_path: Path) -> None:
    plan, key = single()
    run = RunFolder(tmp_path / key)
    scores: list[float] = []

    def report(line: Any) -> str:
        scores.append(line.values["mIoU"])
        return ""

    bench = Bench(tmp_path, plan, report=report)
    with held_by_another(run.path) as process:
        for _ in range(3):
            assert bench.work.advance() is None
        assert bench.work.status == "adopted"
        run.append(2, "val", {"mIoU": 0.3})
        assert bench.work.advance() is None
        assert scores == [0.3], "followed as if it were ours"
        finish(run.path)
        let_go(process)
        (found,) = bench.run()
    assert found.key == key
    assert bench.executor.calls == []


def test_an_adopted_run_that_dies_is_continued(tmp_path: Path) -> None:
    plan, key = single()
    bench = Bench(tmp_path, plan)
    with held_by_another(tmp_path / key) as process:
        assert bench.work.advance() is None
        process.kill()
        process.wait()
        bench.run()
    assert len(bench.executor.calls) == 1


def test_an_orphan_whose_process_is_gone_is_started_again(tmp_path: Path) -> None:
    plan, key = single()
    with held_by_another(tmp_path / key) as process:
        process.kill()
        process.wait()
    assert (tmp_path / key / "lock").exists()
    bench = Bench(tmp_path, plan)
    bench.run()
    assert len(bench.executor.calls) == 1


def test_running_trial_adopts_run_taken_meanwhile(tmp_path: Path) -> None:
    """Two drivers start the same run at the same moment: the lock decides."""
    plan, key = single()
    with held_by_another(tmp_path / key) as other:
        held: Callable[[Path], bool] = works.is_held
        looks: list[Path] = []

        def not_yet(path: Path) -> bool:
            looks.append(path)
            return len(looks) > 1 and held(path)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(works, "is_held", not_yet)
            bench = Bench(tmp_path, plan, say("rgbt: it is being trained by process 1", 2))
            until(lambda: bench.work.advance() or bench.work.status == "adopted", "the adoption")
            finish(tmp_path / key)
            let_go(other)
            bench.run()
    assert len(bench.executor.calls) == 1


def test_running_trial_result_wins_over_exit_code(
    tmp_path: Path,
) -> None:
    def refused(call: Call) -> Process:
        yield
        finish(call.folder)
        call.say("rgbt: it is being trained by process 1")
        return 2

    (found,) = Bench(tmp_path, single()[0], refused).run()
    assert found.result["test"] == {"mIoU": 0.25, "Var": 9.0}


def test_running_trial_timeout_stops_and_fails(tmp_path: Path) -> None:
    plan, _ = single()
    bench = Bench(tmp_path, plan, hang, timeout_s=0.03)
    with pytest.raises(TrialError, match=r"stopped after 0.0005 minutes \(timeout_minutes\)"):
        bench.run()
    assert bench.executor.calls[0].stops == 1
    assert bench.work.is_stopped()


def test_running_trial_timeout_stops_adopted_run(tmp_path: Path) -> None:
    plan, key = single()
    bench = Bench(tmp_path, plan, timeout_s=0.03)
    with held_by_another(tmp_path / key) as process:
        with pytest.raises(TrialError, match="timeout_minutes"):
            bench.run()
        assert process.wait(DEADLINE_S) == -15
    assert bench.executor.calls == []


def test_a_hopeless_run_is_stopped_and_told_where(tmp_path: Path) -> None:
    def report(line: Any) -> str:
        return f"pruned at step {line.step}" if line.values["mIoU"] > 0.1 else ""

    bench = Bench(tmp_path, single()[0], endless, report=report)
    with pytest.raises(TrialPruned, match="pruned at step 2"):
        bench.run()
    assert bench.executor.calls[0].stops == 1
    with pytest.raises(TrialPruned, match="pruned at step 2"):
        bench.work.advance()


def test_running_trial_finished_at_pruning_line_is_complete(tmp_path: Path) -> None:
    def at_once(call: Call) -> Process:
        RunFolder(call.folder).append(4, "val", {"mIoU": 0.5})
        finish(call.folder)
        return 0
        yield

    bench = Bench(tmp_path, single()[0], at_once, report=lambda line: "pruned")
    assert len(bench.run()) == 1


def test_running_trial_second_stop_has_no_effect(tmp_path: Path) -> None:
    bench = Bench(tmp_path, single()[0], hang)
    bench.work.stop()
    assert bench.work.is_stopped(), "nothing was started yet"
    bench.work.advance()
    assert not bench.work.is_stopped()
    bench.work.stop()
    assert bench.work.is_stopped()
    bench.work.stop()
    assert bench.executor.calls[0].stops == 1


RING = ExtraEvaluation("thermal", "ring9")


def evaluating(call: Call) -> Process:
    if call.module != "rgbt.evaluate":
        return (yield from succeed(call))
    yield
    out = Path(call.value("out"))
    out.parent.mkdir(exist_ok=True)
    counts(right=7).save(out)
    return 0


def test_further_evaluations_follow_the_run(tmp_path: Path) -> None:
    plan = plan_of(point(evaluations=(ExtraEvaluation(), RING)))
    bench = Bench(tmp_path, plan, evaluating)
    (found,) = bench.run()
    modules = [(call.module, call.words[1:3]) for call in bench.executor.calls]
    assert modules == [
        ("rgbt.run", ()),
        ("rgbt.evaluate", ("modality=default", "regions=as trained")),
        ("rgbt.evaluate", ("modality=thermal", "regions=ring9")),
    ]
    assert bench.executor.calls[1].value("run") == str(found.folder)
    assert found.counts(RING.path).counts[0, 0, 0, 0] == 7
    assert Bench(tmp_path, plan).work.advance() is not None, "all there: nothing is started"


ALIGNED, RELEASED, NEXT = (
    ExtraEvaluation(frames="aligned"),
    ExtraEvaluation(frames="released"),
    ExtraEvaluation(frames="next"),
)
OF_FRAMES = {"virtual": (ALIGNED, RELEASED), "next": (NEXT,)}


def measuring(call: Call) -> Process:
    """``rgbt.consistency``: both protocols of virtual views in one go."""
    if call.module != "rgbt.consistency":
        return (yield from succeed(call))
    yield
    for evaluation in OF_FRAMES[call.value("frames")]:
        out = Path(call.value("run")) / evaluation.path
        out.parent.mkdir(exist_ok=True)
        counts(right=5).save(out)
    return 0


def test_both_protocols_of_virtual_views_are_one_call(tmp_path: Path) -> None:
    plan = plan_of(Point("p", ("dataset.root=/x",), evaluations=(RELEASED, ALIGNED, NEXT)))
    bench = Bench(tmp_path, plan, measuring)
    (found,) = bench.run()
    place = (f"run={found.folder}", f"runs_dir={tmp_path}")
    assert [(call.module, call.words) for call in bench.executor.calls[1:]] == [
        ("rgbt.consistency", (place[0], "frames=virtual", place[1], "dataset.root=/x")),
        ("rgbt.consistency", (place[0], "frames=next", place[1], "dataset.root=/x")),
    ]
    for evaluation in (ALIGNED, RELEASED, NEXT):
        assert found.counts(evaluation.path).counts[0, 0, 0, 0] == 5
    assert Bench(tmp_path, plan, fail).work.advance() is not None, "all there: nothing is started"


def test_running_trial_own_consistency_is_not_repeated(
    tmp_path: Path,
) -> None:
    def at_its_end(call: Call) -> Process:
        """As `rgbt.training.train`: after the best checkpoint, before counts and result."""
        RunFolder(call.folder)
        (call.folder / "best.pt").touch()
        for evaluation in (ALIGNED, RELEASED):
            (call.folder / "evaluations").mkdir(exist_ok=True)
            counts(right=6).save(call.folder / evaluation.path)
        yield
        finish(call.folder)
        return 0

    plan = plan_of(point(evaluations=(RELEASED, ALIGNED)))
    bench = Bench(tmp_path, plan, at_its_end)
    (found,) = bench.run()
    assert [call.module for call in bench.executor.calls] == ["rgbt.run"]
    assert found.counts(ALIGNED.path).counts[0, 0, 0, 0] == 6


def test_a_consistency_that_cannot_be_measured_fails_the_point(tmp_path: Path) -> None:
    plan = plan_of(point(evaluations=(ALIGNED,)))
    finish(tmp_path / plan.runs[0].key)
    refused = say("rgbt: 'fx' and 'width' are intrinsics of another image size.", 2)
    with pytest.raises(TrialError, match="of another image size"):
        Bench(tmp_path, plan, refused).run()


def test_running_trial_failed_evaluation_fails_trial(tmp_path: Path) -> None:
    plan = plan_of(point(evaluations=(RING,)))
    finish(tmp_path / plan.runs[0].key)
    with pytest.raises(TrialError, match="a bad day"):
        Bench(tmp_path, plan, fail).run()
    with pytest.raises(TrialError, match="exit code 0"):
        Bench(tmp_path, plan, leave(0)).run()


def test_running_trial_remote_run_cannot_be_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of(point(evaluations=(RING,)))
    finish(tmp_path / "copy")
    bench = Bench(tmp_path, plan)
    monkeypatch.setattr(bench.runs, "find", lambda key, dataset: RunResult(tmp_path / "copy", "7"))
    with pytest.raises(TrialError, match="made on another machine: .*thermal, ring9"):
        bench.run()
    assert bench.executor.calls == []


def test_running_trial_failed_seed_keeps_finished_seeds(tmp_path: Path) -> None:
    plan = plan_of(point(seeds=(0, 1)))
    bench = Bench(tmp_path, plan, only("seed=1", first(fail, succeed)))
    with pytest.raises(TrialError, match="a bad day"):
        bench.run()
    again = Bench(tmp_path, plan)
    again.run()
    assert again.executor.started() == [("x=1", "seed=1")]


def test_running_trial_unsent_report_is_retried(tmp_path: Path) -> None:
    told: list[int] = []

    def report(line: Any) -> str:
        told.append(line.step)
        if len(told) == 1:
            raise ConnectionError("the storage is away for a moment")
        return ""

    bench = Bench(tmp_path, single()[0], report=report)
    bench.work.advance()
    with pytest.raises(ConnectionError):
        bench.work.advance()
    assert len(bench.run()) == 1
