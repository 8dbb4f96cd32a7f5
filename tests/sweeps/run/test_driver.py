"""A driver: claims, processes, ends, retries, interruptions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import optuna
import pytest

from rgbt.runs.naming import TAGS
from sweeps import attributes as names
from sweeps.settings import Objective
from sweeps.run import driver as drivers
from tests.sweeps.fakes import (
    Call,
    Desk,
    FakeView,
    Process,
    fail,
    finish,
    hang,
    interrupt_when,
    leave,
    list_desk,
    memory,
    only,
    points,
    quick,
    scored,
    search_desk,
)

__all__ = ["quick"]
pytestmark = pytest.mark.usefixtures("quick")

UP = (Objective("val/mIoU", "maximize"),)


def trial(desk: Desk, number: int) -> Any:
    return desk.store.study.get_trials(deepcopy=False)[number]


def reason(desk: Desk, number: int) -> str:
    return str(trial(desk, number).user_attrs[names.REASON])


def test_driver_second_call_runs_nothing(tmp_path: Path) -> None:
    storage = memory()
    most: list[int] = []
    view = FakeView(lambda works: most.append(len(works)))
    desk = list_desk(tmp_path, points(4), storage=storage, workers=2, view=view).run()
    assert max(most) == 2, "no more processes than workers"
    assert sorted(desk.executor.started()) == [(f"x={x}",) for x in range(4)]
    assert desk.states() == {f"x={x}": ["COMPLETE"] for x in range(4)}
    assert trial(desk, 0).values == [25.0]
    assert trial(desk, 0).user_attrs[names.RESULTS]["test/Var"] == 9.0
    assert trial(desk, 0).user_attrs[names.SECONDS] >= 0
    assert [how for _, how, _ in desk.view.ends] == ["finished"] * 4
    again = list_desk(tmp_path, points(4), storage=storage).run()
    assert again.executor.calls == []
    assert len(again.store.trials()) == 4


def test_driver_finished_points_need_no_slot(tmp_path: Path) -> None:
    done: list[int] = []
    view = FakeView(lambda works: done.append(len(desk.numbers("COMPLETE"))))
    desk = list_desk(tmp_path, points(5), view=view, workers=2)
    for plan in desk.plans[1:]:
        finish(tmp_path / plan.key)
    desk.run()
    assert desk.executor.started() == [("x=0",)]
    assert done[0] == 4, "all four in the first round, while x=0 trains"


def test_driver_failed_points_keep_reason_until_retried(tmp_path: Path) -> None:
    storage = memory()
    behaviour = only("x=1", fail, only("x=2", leave(-9)))
    desk = list_desk(tmp_path, points(4), behaviour, storage=storage).run()
    ends = ["COMPLETE", "FAIL", "FAIL", "COMPLETE"]
    assert desk.states() == {f"x={x}": [end] for x, end in enumerate(ends)}
    assert reason(desk, 1) == "ValueError: a bad day"
    assert "SIGKILL" in reason(desk, 2)
    assert list_desk(tmp_path, points(4), storage=storage).run().executor.calls == []
    again = list_desk(tmp_path, points(4), fail, storage=storage, retry="failed").run()
    assert sorted(again.executor.started()) == [("x=1",), ("x=2",)], "forgiven once"
    assert again.states()["x=1"] == ["FAIL", "FAIL"]


@pytest.mark.parametrize("score", [None, float("inf")])
def test_driver_score_that_is_no_number_fails(tmp_path: Path, score: float | None) -> None:
    def no_score(call: Call) -> Process:
        yield
        finish(call.folder, test={"mIoU": score, "Var": 1.0})
        return 0

    desk = list_desk(tmp_path, points(1), no_score).run()
    assert desk.states() == {"x=0": ["FAIL"]}
    assert "no test/mIoU that is a number" in reason(desk, 0)


@pytest.mark.slow
def test_driver_timeout_starts_next_trial(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, points(2), only("x=0", hang), timeout_minutes=0.02).run()
    assert desk.states() == {"x=0": ["FAIL"], "x=1": ["COMPLETE"]}
    assert "timeout_minutes" in reason(desk, 0)
    assert desk.executor.calls[0].stops == 1


def test_driver_gives_processes_tags_gpu_and_trust(tmp_path: Path) -> None:
    ring = ("regions=ring9",)
    tagged = points(2, tags={"rgbt.table/one": "row"}, evaluations=(ring,))
    desk = list_desk(tmp_path, tagged, workers=2, gpus=(3, 5), trust="my_lab").run()
    trusting = ["trust=my_lab" in call.words for call in desk.executor.calls]
    assert trusting == [False, False, True, True]
    environments = [call.environment for call in desk.executor.calls[:2]]
    assert [env["CUDA_VISIBLE_DEVICES"] for env in environments] == ["3", "5"]
    # Threads are a setting of the run: two workers give the bits of one.
    assert not any("OMP_NUM_THREADS" in env for env in environments)
    assert json.loads(environments[0][TAGS])["rgbt.table/one"] == "row"


@pytest.mark.parametrize(("cores", "fitting"), [(6, None), (5, 2), (3, 1)])
def test_driver_more_threads_than_cores_are_reported_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: int, fitting: int | None
) -> None:
    """Three runs at a time, with two threads each; the second or the third one is too many."""
    monkeypatch.setattr(drivers, "usable_cores", lambda: cores)
    desk = list_desk(tmp_path, points(6), scored(0.5), workers=3).run()
    notes = [text for how, text in desk.view.said if how == "note"]
    assert len(notes) == (fitting is not None)
    for note in notes:
        assert f"with trainer.threads=2 share {cores} cores" in note
        assert f"more than workers={fitting} gain" in note


def test_driver_sends_heartbeats_of_running_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drivers, "HEARTBEAT_S", 0.0)
    desk = list_desk(tmp_path, points(1), scored(*[0.5] * 5))
    sent: list[int] = []
    monkeypatch.setattr(desk.store, "send_heartbeats", sent.extend)
    desk.run()
    assert sent.count(0) >= 5


def test_driver_with_wait_stays_for_other_drivers(tmp_path: Path) -> None:
    storage = memory()
    other = list_desk(tmp_path, points(2), storage=storage)
    task = other.source.next()
    rounds: list[int] = []

    def look(works: Any) -> None:
        rounds.append(len(works))
        if len(rounds) == 30:
            finish(tmp_path / other.plans[0].key)
            other.store.complete(task.number, [1.0], {})

    desk = list_desk(tmp_path, points(2), storage=storage, wait=True, view=FakeView(look)).run()
    assert len(rounds) >= 30
    assert desk.executor.started() == [("x=1",)]
    assert desk.states() == {"x=0": ["COMPLETE"], "x=1": ["COMPLETE"]}


def test_driver_ctrl_c_releases_trials(tmp_path: Path) -> None:
    storage = memory()
    view = interrupt_when(lambda works: len(works) == 2)
    desk = list_desk(tmp_path, points(3), hang, storage=storage, view=view, workers=2)
    with pytest.raises(KeyboardInterrupt):
        desk.run()
    assert [call.stops for call in desk.executor.calls] == [1, 1]
    assert all(job.poll() is not None for job in desk.executor.jobs)
    assert desk.store.trials() == []
    again = list_desk(tmp_path, points(3), storage=storage).run()
    assert again.states() == {f"x={x}": ["COMPLETE"] for x in range(3)}

    storage = memory()
    desk = search_desk(tmp_path, hang, storage=storage, view=interrupt_when(bool), trials=2)
    with pytest.raises(KeyboardInterrupt):
        desk.run()
    assert desk.numbers("WAITING") == [1]
    again = search_desk(tmp_path, storage=storage, trials=2).run()
    assert again.executor.started()[0] == desk.executor.started()[0]
    assert len(again.numbers("COMPLETE")) == len(again.store.trials()) == 2


def test_driver_process_that_cannot_start_costs_one_trial(tmp_path: Path) -> None:
    def full(call: Call) -> Process:
        raise OSError(28, "No space left on device")

    desk = list_desk(tmp_path, points(2), only("x=0", full)).run()
    assert desk.states() == {"x=0": ["FAIL"], "x=1": ["COMPLETE"]}


def test_driver_prunes_hopeless_trial(tmp_path: Path) -> None:
    good, bad = scored(0.5, 0.75, val=0.75), scored(0.5, 0.1, end=hang)

    def described(call: Call) -> Process:
        return (yield from (bad if len(desk.executor.calls) == 2 else good)(call))

    pruner = optuna.pruners.ThresholdPruner(lower=20.0)
    desk = search_desk(tmp_path, described, pruner=pruner, objectives=UP, trials=3)
    desk.run()
    assert [each.state.name for each in desk.store.trials()] == ["COMPLETE", "PRUNED", "COMPLETE"]
    assert trial(desk, 1).intermediate_values == {2: 50.0, 4: 10.0}
    assert reason(desk, 1) == "pruned at step 4"
    assert trial(desk, 0).values == [75.0]
    assert [call.stops for call in desk.executor.calls] == [0, 1, 0]
    assert ("pruned", "pruned at step 4") in [end[1:] for end in desk.view.ends]


def test_driver_replicates_average_and_report_first(tmp_path: Path) -> None:
    values = {"seed=0": 0.5, "seed=1": 0.25, "seed=2": 0.75}

    def by_seed(call: Call) -> Process:
        score = values[call.words[-1]]
        return (yield from scored(score, val=score)(call))

    desk = search_desk(tmp_path, by_seed, objectives=UP, trials=1, replicates=3).run()
    (one,) = desk.store.trials()
    assert one.values == [50.0]
    assert one.intermediate_values == {2: 50.0}
    assert [call.words[-1] for call in desk.executor.calls] == list(values)
    assert len(one.user_attrs[names.RUNS]) == 3


def test_driver_waits_for_unreachable_storage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drivers, "PAUSE_S", 0.0)
    desk = list_desk(tmp_path, points(2))
    complete = desk.store.complete
    tries: list[int] = []

    def away(*arguments: Any) -> None:
        tries.append(1)
        if len(tries) < 3:
            raise optuna.exceptions.StorageInternalError("no route to host")
        complete(*arguments)

    monkeypatch.setattr(desk.store, "complete", away)
    desk.run()
    assert desk.states() == {"x=0": ["COMPLETE"], "x=1": ["COMPLETE"]}
    assert len(desk.executor.calls) == 2
