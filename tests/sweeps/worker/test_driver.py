"""Drivers: one, several at once, killed ones; nothing lost, nothing run twice."""

from __future__ import annotations

import json
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import optuna
import pytest

from rgbt.runs.folder import Description, RunFolder, read_description
from rgbt.runs.naming import TAGS
from rgbt.tracking.mlflow_store import NoTracking
from sweeps import attributes as names
from sweeps.settings import Objective
from sweeps.worker import driver as drivers
from sweeps.worker.storage import open_storage
from sweeps.worker.trial_store import Owner
from tests.sweeps.fakes import (
    DEAD,
    GONE,
    Call,
    Desk,
    FakeView,
    PickyPlanner,
    Process,
    fail,
    finish,
    first,
    hang,
    interrupt_when,
    leave,
    list_desk,
    memory,
    only,
    plans,
    quick,
    scored,
    search_desk,
    silent,
    succeed,
)

__all__ = ["quick"]
pytestmark = pytest.mark.usefixtures("quick")

UP = (Objective("val/mIoU", "maximize"),)
ALIVE = Owner("another-host", 7, "7")
"""A driver on another machine that was heard of a moment ago."""


def trial(desk: Desk, number: int) -> Any:
    return desk.store.study.get_trials(deepcopy=False)[number]


def reason(desk: Desk, number: int) -> str:
    return str(trial(desk, number).user_attrs[names.REASON])


def test_driver_second_call_runs_nothing(tmp_path: Path) -> None:
    storage = memory()
    most: list[int] = []
    view = FakeView(lambda works: most.append(len(works)))
    desk = list_desk(tmp_path, plans(4), storage=storage, workers=2, view=view).run()
    assert max(most) == 2, "no more processes than workers"
    assert sorted(desk.executor.started()) == [(f"x={x}",) for x in range(4)]
    assert desk.states() == {f"x={x}": ["COMPLETE"] for x in range(4)}
    assert trial(desk, 0).values == [25.0]
    assert trial(desk, 0).user_attrs[names.RESULTS]["test/Var"] == 9.0
    assert trial(desk, 0).user_attrs[names.SECONDS] >= 0
    assert [how for _, how, _ in desk.view.ends] == ["finished"] * 4
    again = list_desk(tmp_path, plans(4), storage=storage).run()
    assert again.executor.calls == []
    assert len(again.store.trials()) == 4


def test_driver_finished_points_need_no_slot(tmp_path: Path) -> None:
    points = plans(5)
    for plan in points[1:]:
        finish(tmp_path / plan.key)
    done: list[int] = []
    view = FakeView(lambda works: done.append(len(desk.numbers("COMPLETE"))))
    desk = list_desk(tmp_path, points, view=view, workers=2)
    desk.run()
    assert desk.executor.started() == [("x=0",)]
    assert done[0] == 4, "all four in the first round, while x=0 trains"


def test_driver_failed_points_keep_reason_until_retried(tmp_path: Path) -> None:
    storage = memory()
    behaviour = only("x=1", fail, only("x=2", leave(-9)))
    desk = list_desk(tmp_path, plans(4), behaviour, storage=storage).run()
    ends = ["COMPLETE", "FAIL", "FAIL", "COMPLETE"]
    assert desk.states() == {f"x={x}": [end] for x, end in enumerate(ends)}
    assert reason(desk, 1) == "ValueError: a bad day"
    assert "SIGKILL" in reason(desk, 2)
    assert list_desk(tmp_path, plans(4), storage=storage).run().executor.calls == []
    again = list_desk(tmp_path, plans(4), fail, storage=storage, retry="failed").run()
    assert sorted(again.executor.started()) == [("x=1",), ("x=2",)], "forgiven once"
    assert again.states()["x=1"] == ["FAIL", "FAIL"]


def test_driver_retries_point_in_same_call(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, plans(2), only("x=1", first(fail, succeed)), retries=1).run()
    assert desk.states() == {"x=0": ["COMPLETE"], "x=1": ["FAIL", "COMPLETE"]}
    desk = list_desk(tmp_path / "2", plans(1), fail, retries=1).run()
    assert desk.states() == {"x=0": ["FAIL", "FAIL"]}
    desk = search_desk(tmp_path / "3", first(fail, succeed), trials=1, retries=1).run()
    assert (len(desk.executor.calls), len(desk.numbers("COMPLETE"))) == (2, 1)


@pytest.mark.parametrize("score", [None, float("inf")])
def test_driver_score_that_is_no_number_fails(tmp_path: Path, score: float | None) -> None:
    def no_score(call: Call) -> Process:
        yield
        finish(call.folder, test={"mIoU": score, "Var": 1.0})
        return 0

    desk = list_desk(tmp_path, plans(1), no_score).run()
    assert desk.states() == {"x=0": ["FAIL"]}
    assert "no test/mIoU that is a number" in reason(desk, 0)


@pytest.mark.parametrize("most", [1, 2, 9])
def test_driver_stops_at_max_failures(tmp_path: Path, most: int) -> None:
    desk = list_desk(tmp_path, plans(3), fail, max_failures=most).run()
    assert len(desk.executor.calls) == min(most, 3)
    rejecting = search_desk(tmp_path, planner=PickyPlanner(), trials=3, max_failures=most).run()
    assert len(rejecting.view.rejections) == min(most, 3)


def test_driver_timeout_starts_next_trial(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, plans(2), only("x=0", hang), timeout_minutes=0.02).run()
    assert desk.states() == {"x=0": ["FAIL"], "x=1": ["COMPLETE"]}
    assert "timeout_minutes" in reason(desk, 0)
    assert desk.executor.calls[0].stops == 1


def test_driver_spent_hours_start_no_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    clock = type("Clock", (), {"monotonic": lambda: now[0], "sleep": lambda s: None})
    monkeypatch.setattr(drivers, "time", clock)

    def pass_time(seconds: float) -> None:
        now[0] += seconds

    def late(call: Call) -> Process:
        pass_time(1800.1)
        return (yield from succeed(call))

    view = FakeView(lambda works: pass_time(0.01))
    desk = search_desk(tmp_path, late, hours=1.0, view=view)
    desk.driver._began = desk.driver._last_heartbeat = 0.0
    desk.run()
    assert len(desk.executor.calls) == 2
    assert desk.numbers("COMPLETE") == [0, 1]


def test_driver_gives_processes_tags_and_gpu(tmp_path: Path) -> None:
    points = plans(2, tags={"rgbt.table/one": "row"})
    desk = list_desk(tmp_path, points, workers=2, gpus=(3, 5)).run()
    environments = [call.environment for call in desk.executor.calls]
    assert [env["CUDA_VISIBLE_DEVICES"] for env in environments] == ["3", "5"]
    # Threads are a setting of the run: two workers give the bits of one.
    assert not any("OMP_NUM_THREADS" in env for env in environments)
    assert json.loads(environments[0][TAGS]) == {"rgbt.table/one": "row"}


def test_driver_gives_processes_several_gpus(tmp_path: Path) -> None:
    desk = list_desk(tmp_path, plans(2), workers=2, gpus=((0, 1), (2, 3))).run()
    shown = [call.environment["CUDA_VISIBLE_DEVICES"] for call in desk.executor.calls]
    assert shown == ["0,1", "2,3"]


def together(desks: list[Desk]) -> None:
    """Run all drivers at the same time; what one raises is raised."""
    errors: list[BaseException] = []

    def run(desk: Desk) -> None:
        try:
            desk.run()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(desk,)) for desk in desks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def owners(count: int) -> list[Owner]:
    return [Owner("host", number, str(number)) for number in range(count)]


def test_two_drivers_on_one_journal_run_points_once(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    desks = [
        list_desk(runs, plans(12), storage=open_storage(None, runs), owner=me, workers=2, wait=True)
        for me in owners(2)
    ]
    together(desks)
    started = Counter(words for desk in desks for words in desk.executor.started())
    assert started == {(f"x={x}",): 1 for x in range(12)}
    assert all(desk.executor.calls for desk in desks), "the work was shared"
    for desk in desks:
        assert desk.states() == {f"x={x}": ["COMPLETE"] for x in range(12)}


def test_three_drivers_share_twenty_search_trials(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    desks = [
        search_desk(runs, storage=open_storage(None, runs), owner=me, trials=20) for me in owners(3)
    ]
    together(desks)
    trials = desks[0].store.trials()
    assert [each.state.name for each in trials] == ["COMPLETE"] * 20
    assert len({each.params["x"] for each in trials}) == 20
    assert sum(len(desk.executor.calls) for desk in desks) == 20


def killed(desk: Desk) -> Desk:
    """A driver whose process goes away at its first work, without a word."""
    desk.view.update = interrupt_when(bool).update
    desk.driver._release_all = lambda: None  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        desk.run()
    return desk


@pytest.mark.parametrize(
    ("owner", "seconds", "taken_over"),
    [(GONE, 0.0, True), (DEAD, 9999.0, True), (DEAD, 1.0, False)],
    ids=["its process is gone", "silent on another machine", "heard of on another machine"],
)
def test_driver_resumes_trials_of_dead_driver(
    tmp_path: Path, owner: Owner, seconds: float, taken_over: bool
) -> None:
    storage = memory()
    killed(list_desk(tmp_path, plans(2), hang, storage=storage, owner=owner))
    silent(storage, 0, seconds)
    desk = list_desk(tmp_path, plans(2), storage=storage).run()
    assert desk.executor.started() == ([("x=0",)] if taken_over else []) + [("x=1",)]
    assert desk.states()["x=0"] == (["COMPLETE"] if taken_over else ["RUNNING"])

    storage = memory()
    before = killed(search_desk(tmp_path, hang, storage=storage, owner=owner, trials=3))
    silent(storage, 0, seconds)
    lost = trial(before, 0).params
    desk = search_desk(tmp_path, storage=storage, trials=3).run()
    assert len(desk.store.trials()) == 3
    assert (before.executor.started()[0] in desk.executor.started()) == taken_over
    done = [each.params for each in desk.store.trials() if each.state.name == "COMPLETE"]
    assert done.count(lost) == taken_over


def test_driver_with_wait_stays_for_other_drivers(tmp_path: Path) -> None:
    storage = memory()
    points = plans(2)
    other = list_desk(tmp_path, points, storage=storage, owner=ALIVE)
    task = other.driver.source.next()
    assert task is not None
    rounds: list[int] = []

    def look(works: Any) -> None:
        rounds.append(len(works))
        if len(rounds) == 30:
            finish(tmp_path / points[0].key)
            other.store.complete(task.number, [1.0], {})

    desk = list_desk(tmp_path, points, storage=storage, wait=True, view=FakeView(look)).run()
    assert len(rounds) >= 30
    assert desk.executor.started() == [("x=1",)]
    assert desk.states() == {"x=0": ["COMPLETE"], "x=1": ["COMPLETE"]}


def test_driver_sends_heartbeats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drivers, "HEARTBEAT_S", 0.0)
    beats: list[list[int]] = []
    desk = list_desk(tmp_path, plans(1))
    monkeypatch.setattr(desk.store, "send_heartbeat", lambda numbers: beats.append(list(numbers)))
    desk.run()
    assert [0] in beats


def test_driver_ctrl_c_releases_trials(tmp_path: Path) -> None:
    storage = memory()
    view = interrupt_when(lambda works: len(works) == 2)
    desk = list_desk(tmp_path, plans(3), hang, storage=storage, view=view, workers=2)
    with pytest.raises(KeyboardInterrupt):
        desk.run()
    assert [call.stops for call in desk.executor.calls] == [1, 1]
    assert all(job.poll() is not None for job in desk.executor.jobs)
    assert desk.store.trials() == []
    again = list_desk(tmp_path, plans(3), storage=storage).run()
    assert again.states() == {f"x={x}": ["COMPLETE"] for x in range(3)}

    storage = memory()
    desk = search_desk(tmp_path, hang, storage=storage, view=interrupt_when(bool), trials=2)
    with pytest.raises(KeyboardInterrupt):
        desk.run()
    assert desk.numbers("WAITING") == [1]
    again = search_desk(tmp_path, storage=storage, trials=2).run()
    assert again.executor.started()[0] == desk.executor.started()[0]
    assert len(again.numbers("COMPLETE")) == len(again.store.trials()) == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_driver_process_that_cannot_start_costs_one_trial(
    tmp_path: Path, error: BaseException
) -> None:
    desk = list_desk(tmp_path, plans(2))
    start = desk.executor.start

    def refuse(command: Any, environment: Any, log: Path) -> Any:
        if "x=0" in command:
            raise error
        return start(command, environment, log)

    desk.executor.start = refuse  # type: ignore[method-assign]
    if isinstance(error, KeyboardInterrupt):
        with pytest.raises(KeyboardInterrupt):
            desk.run()
        assert desk.store.trials() == []
    else:
        assert desk.run().states() == {"x=0": ["FAIL"], "x=1": ["COMPLETE"]}


def test_driver_prunes_hopeless_trial(tmp_path: Path) -> None:
    good, bad = scored(0.5, 0.75, val=0.75), scored(0.5, 0.1, end=hang)

    def described(call: Call) -> Process:
        NoTracking().start(RunFolder(call.folder), Description("fake", {"rgbt.key": "k"}, {}))
        return (yield from (bad if len(desk.executor.calls) == 2 else good)(call))

    pruner = optuna.pruners.ThresholdPruner(lower=20.0)
    desk = search_desk(tmp_path, described, pruner=pruner, objectives=UP, trials=3)
    desk.run()
    assert [each.state.name for each in desk.store.trials()] == ["COMPLETE", "PRUNED", "COMPLETE"]
    assert trial(desk, 1).intermediate_values == {2: 50.0, 4: 10.0}
    assert reason(desk, 1) == "pruned at step 4"
    assert trial(desk, 0).values == [75.0]
    assert [call.stops for call in desk.executor.calls] == [0, 1, 0]
    description = read_description(desk.executor.calls[1].folder)
    assert description is not None
    assert description.tags["rgbt.stopped"] == "pruned at step 4"
    assert ("pruned", "pruned at step 4") in [end[1:] for end in desk.view.ends]
    assert desk.driver.failures == 0


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


def test_driver_reports_two_objectives_in_order(tmp_path: Path) -> None:
    both = (Objective("test/Var", "minimize"), Objective("test/mIoU", "maximize"))
    desk = search_desk(tmp_path, objectives=both, trials=2).run()
    assert [each.values for each in desk.store.trials()] == [[9.0, 25.0]] * 2


def test_driver_finished_runs_are_reused_by_search(tmp_path: Path) -> None:
    space = {"x": {"type": "categorical", "choices": [1, 2]}}
    desk = search_desk(tmp_path, space=space, trials=8, workers=2).run()
    trials = desk.store.trials()
    assert [each.state.name for each in trials] == ["COMPLETE"] * 8
    assert len(desk.executor.calls) == len({each.params["x"] for each in trials}) == 2
    other = search_desk(tmp_path, space=space, trials=8).run()  # another storage, the same seed
    assert other.executor.calls == []
    assert len(other.numbers("COMPLETE")) == 8


def test_driver_resumed_search_asks_same_points(tmp_path: Path) -> None:
    whole = search_desk(tmp_path / "a", trials=6).run()
    storage = memory()
    search_desk(tmp_path / "b", storage=storage, trials=2).run()
    rest = search_desk(tmp_path / "b", storage=storage, trials=6).run()
    assert len(rest.executor.calls) == 4
    parameters = [each.params for each in rest.store.trials()]
    assert parameters == [each.params for each in whole.store.trials()]


def test_driver_survives_trial_taken_by_other(tmp_path: Path) -> None:
    """This machine slept; the other driver took the trial for an orphan's."""
    storage = memory()
    other = list_desk(tmp_path / "a", plans(1), storage=storage, owner=ALIVE)

    def finished(call: Call) -> Process:
        other.store.complete(0, [99.0], {})
        return (yield from succeed(call))

    desk = list_desk(tmp_path / "a", plans(1), finished, storage=storage).run()
    assert trial(desk, 0).values == [99.0]

    storage = memory()
    searcher = search_desk(tmp_path / "b", storage=storage, owner=ALIVE, objectives=UP)

    def released(call: Call) -> Process:
        if len(desk.executor.calls) == 1:
            searcher.store.release(0, "its driver had ended", requeue=False)
        return (yield from succeed(call))

    desk = search_desk(tmp_path / "b", released, storage=storage, trials=1, objectives=UP)
    assert len(desk.run().numbers("COMPLETE")) == 1


def test_driver_waits_for_unreachable_storage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drivers, "PAUSE_S", 0.0)
    desk = list_desk(tmp_path, plans(2))
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
