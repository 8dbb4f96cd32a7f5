"""Trials of a study: claims, valid trials, and the trials of a dead driver."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from optuna.distributions import IntDistribution

from sweeps import attributes as names
from sweeps.space.samplers import build_sampler
from sweeps.worker.storage import open_storage
from sweeps.worker.trial_store import STALE_S, Owner, TrialStore
from tests.sweeps.fakes import DEAD, GONE, memory, silent, store_on

HOST = os.uname().nodename


@pytest.fixture
def store() -> TrialStore:
    return store_on(memory())


def claim(store: TrialStore, key: str = "k", **more: Any) -> int | None:
    return store.claim({names.KEY: key, names.LABEL: f"point {key}"}, **more)


def trial(store: TrialStore, number: int) -> Any:
    return store.study.get_trials(deepcopy=False)[number]


def states(store: TrialStore) -> list[str]:
    return [each.state.name for each in store.trials()]


def searching(storage: Any, owner: Owner | None = None) -> TrialStore:
    """The store of a search; every driver has a study object and a sampler of its own."""
    return store_on(
        storage, owner, sampler=build_sampler({"_target_": "optuna.samplers.RandomSampler"})
    )


def taken(store: TrialStore, total: int | None = None) -> tuple[int, float]:
    """Ask for a trial of one parameter, and note its point."""
    asked = store.ask(total)
    assert asked is not None
    x = asked.suggest_float("x", 0, 1)
    store.set_attributes(asked.number, {names.KEY: f"x={x}", names.LABEL: f"#{asked.number}"})
    return asked.number, x


def stale_trials(store: TrialStore, *mine: int) -> list[int]:
    return [each.number for each in store.stale_trials(mine)]


def at_once(works: list[Callable[[], None]]) -> None:
    threads = [threading.Thread(target=work) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_claim_adds_running_trial_with_attributes(store: TrialStore) -> None:
    assert claim(store, params={"x": 3}, distributions={"x": IntDistribution(0, 9)}) == 0
    found = trial(store, 0)
    assert (found.state.name, found.params) == ("RUNNING", {"x": 3})
    assert found.user_attrs[names.KEY] == "k"
    assert found.user_attrs[names.LABEL] == "point k"
    assert found.user_attrs[names.OWNER] == str(Owner.this_process())
    assert abs(found.user_attrs[names.HEARTBEAT] - time.time()) < 60


def test_claim_of_running_point_is_dropped(store: TrialStore) -> None:
    assert claim(store) == 0
    assert claim(store) is None
    assert claim(store, "other") == 2
    assert [each.number for each in store.trials()] == [0, 2]
    assert "trial 0" in trial(store, 1).user_attrs[names.REASON]


@pytest.mark.parametrize("how", ["complete", "prune"])
def test_claim_of_finished_point_requires_replaced(store: TrialStore, how: str) -> None:
    claim(store)
    if how == "complete":
        store.complete(0, [1.0], {})
    else:
        store.prune(0, "hopeless", {})
    assert claim(store) is None
    assert claim(store, replaced=[0]) == 2


def opener(tmp_path: Path, kind: str) -> Callable[[], Any]:
    where = {"journal": str(tmp_path / "s.journal"), "sqlite": f"sqlite:///{tmp_path / 's.db'}"}
    return lambda: open_storage(where[kind], tmp_path)


@pytest.mark.parametrize(("kind", "keys"), [("journal", "abcdefgh"), ("sqlite", "abc")])
def test_claim_by_two_drivers_succeeds_once_per_point(tmp_path: Path, kind: str, keys: str) -> None:
    opened = opener(tmp_path, kind)
    stores = [store_on(opened()) for _ in range(2)]
    got: list[str] = []
    barrier = threading.Barrier(2)

    def work(store: TrialStore) -> None:
        for key in keys:
            barrier.wait()
            got.extend(key for _ in "k" if claim(store, key) is not None)

    at_once([lambda store=store: work(store) for store in stores])  # type: ignore[misc]
    assert sorted(got) == list(keys)
    assert states(stores[0]) == ["RUNNING"] * len(keys)


@pytest.mark.parametrize(("kind", "total"), [("journal", 20), ("sqlite", 7)])
def test_ask_by_three_drivers_respects_total(tmp_path: Path, kind: str, total: int) -> None:
    opened = opener(tmp_path, kind)
    stores = [searching(opened()) for _ in range(3)]
    drawn: list[float] = []

    def work(store: TrialStore) -> None:
        while len(store.trials()) < total:
            asked = store.ask(total)
            if asked is not None:
                drawn.append(asked.suggest_float("x", 0, 1))

    at_once([lambda store=store: work(store) for store in stores])  # type: ignore[misc]
    assert states(stores[0]) == ["RUNNING"] * total
    assert len(set(drawn)) == len(drawn) == total


def test_ask_last_trial_goes_to_lower_number(monkeypatch: pytest.MonkeyPatch) -> None:
    storage = memory()
    mine, theirs = searching(storage), searching(storage, DEAD)
    ask = mine.study.ask

    def both_saw_room() -> Any:
        theirs.ask(1)
        return ask()

    monkeypatch.setattr(mine.study, "ask", both_saw_room)
    assert mine.ask(1) is None
    assert [each.number for each in mine.trials()] == [0]


def test_heartbeat_renews_trial() -> None:
    storage = memory()
    store = store_on(storage, DEAD)
    claim(store)
    silent(storage, 0)
    store.send_heartbeat([0])
    assert stale_trials(store_on(storage)) == []


def test_finish_twice_keeps_first_end(store: TrialStore) -> None:
    claim(store)
    with pytest.raises(ValueError, match="did not match the number of the objectives"):
        store.complete(0, [1.0, 2.0], {})
    store.complete(0, [1.0], {})
    store.send_heartbeat([0])
    store.fail(0, "too late", {})
    store.release(0, "its driver was stopped", requeue=True)
    assert (states(store), trial(store, 0).values) == (["COMPLETE"], [1.0])
    assert names.REASON not in trial(store, 0).user_attrs


@pytest.mark.parametrize(
    ("owner", "seconds", "is_gone"),
    [(GONE, 0.0, True), (DEAD, STALE_S / 2, False), (DEAD, 2 * STALE_S, True)],
    ids=["a process that ended", "another host, heard of", "another host, silent"],
)
def test_stale_trials_depend_on_owner(owner: Owner, seconds: float, is_gone: bool) -> None:
    storage = memory()
    gone = store_on(storage, owner)
    for key in "abcd":
        claim(gone, key)
    for number in range(4):
        silent(storage, number, seconds)
    gone.complete(0, [1.0], {})
    gone.fail(1, "a bad day", {})
    gone.drop(2, "not needed")
    assert stale_trials(store_on(storage)) == ([3] if is_gone else [])


def test_stale_trials_include_own_lost_trial(store: TrialStore) -> None:
    claim(store, "a")
    claim(store, "b")
    assert stale_trials(store, 0, 1) == []
    assert stale_trials(store, 1) == [0]


def test_stale_trials_exclude_fresh_unowned_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    store = searching(memory())
    store.study.ask()
    assert stale_trials(store) == []
    later = time.time() + 2 * STALE_S
    monkeypatch.setattr(time, "time", lambda: later)
    assert stale_trials(store) == [0]


def test_release_requeues_search_trial_with_parameters() -> None:
    storage = memory()
    number, x = taken(searching(storage, GONE), 1)
    mine = searching(storage)
    mine.release(number, "its driver had ended", requeue=True)
    assert states(mine) == ["WAITING"]
    again = mine.ask(1)
    assert again is not None
    assert again.suggest_float("x", 0, 1) == x
    assert again.user_attrs[names.KEY] == f"x={x}"
    assert states(mine) == ["RUNNING"]
    assert trial(mine, again.number).user_attrs[names.OWNER] == str(Owner.this_process())


def test_release_trial_without_point_is_not_enqueued() -> None:
    storage = memory()
    searching(storage, GONE).ask(1)
    mine = searching(storage)
    mine.release(0, "its driver had ended", requeue=True)
    assert states(mine) == []
    assert mine.ask(1) is not None


def test_release_after_crash_enqueues_once() -> None:
    storage = memory()
    number, x = taken(searching(storage, GONE))
    a, b = searching(storage), searching(storage)
    a.study.enqueue_trial({"x": x}, user_attrs={names.KEY: f"x={x}"})
    assert stale_trials(b) == [number]
    b.release(number, "gone", requeue=True)
    assert states(b) == ["WAITING"]


def test_ask_drops_second_requeued_trial() -> None:
    """Two drivers may enqueue the trial of a dead one at the same time."""
    storage = memory()
    number, x = taken(searching(storage, GONE))
    store = searching(storage)
    store.release(number, "gone", requeue=True)
    store.study.enqueue_trial({"x": x}, user_attrs={names.KEY: f"x={x}"})
    assert store.ask(2) is not None
    assert store.ask(2) is None
    assert states(store) == ["RUNNING"]


def test_ask_at_once_for_a_point_requeued_twice_keeps_one(monkeypatch: pytest.MonkeyPatch) -> None:
    storage = memory()
    number, x = taken(searching(storage, GONE), 1)
    a, b = searching(storage), searching(storage)
    a.release(number, "gone", requeue=True)
    a.study.enqueue_trial({"x": x}, user_attrs={names.KEY: f"x={x}", names.REPLACES: number})
    by_key, drop = a.by_key, b.drop
    seen, answers = [], []

    def drop_after_a(*arguments: Any) -> None:
        seen.append(by_key())
        drop(*arguments)

    def look_after_b() -> Any:
        answers.append(b.ask(1))
        return seen.pop()

    monkeypatch.setattr(b, "drop", drop_after_a)
    monkeypatch.setattr(a, "by_key", look_after_b)
    answers.append(a.ask(1))
    assert [trial is None for trial in answers].count(False) == 1, "the point was lost"
    assert states(a) == ["RUNNING"]


def test_release_keeps_point_that_another_driver_takes_before_the_drop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    storage = memory()
    number, x = taken(searching(storage, GONE), 1)
    slow, fast = searching(storage), searching(storage)
    drop, answers = slow.drop, []

    def ask_first(*arguments: Any) -> None:
        answers.append(fast.ask(1))
        drop(*arguments)

    monkeypatch.setattr(slow, "drop", ask_first)
    slow.release(number, "its driver had ended", requeue=True)
    (again,) = answers
    assert again is not None, "the point was lost"
    assert again.suggest_float("x", 0, 1) == x
    assert states(slow) == ["RUNNING"]
    assert fast.ask(1) is None


@pytest.mark.parametrize("finished", [False, True], ids=["runs there", "is finished there"])
def test_release_of_resumed_trial_enqueues_nothing(finished: bool) -> None:
    storage = memory()
    number, _ = taken(searching(storage, GONE))
    a, b = searching(storage), searching(storage)
    (seen,) = stale_trials(b)
    a.release(number, "gone", requeue=True)
    again = a.ask(1)
    assert again is not None
    if finished:
        a.complete(again.number, [1.0], {})
    b.release(seen, "gone", requeue=True)
    assert states(b) == ["COMPLETE" if finished else "RUNNING"]


@pytest.fixture
def child() -> Iterator[subprocess.Popen[str]]:
    """Another process on this machine that prints its owner, and waits."""
    code = (
        "from sweeps.worker.trial_store import Owner;"
        "print(Owner.this_process(), flush=True); input()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    yield process
    process.kill()
    process.communicate()


def test_owner_local_process_alive_until_exit(child: subprocess.Popen[str]) -> None:
    assert child.stdout is not None
    owner = Owner.parse(child.stdout.readline().strip())
    assert (owner.host, owner.pid) == (HOST, child.pid)
    assert owner.is_alive(heartbeat=0.0)
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert Path(f"/proc/{child.pid}").exists(), "still a zombie"
    assert not owner.is_alive(heartbeat=time.time())


def test_owner_parse_reused_pid_and_other_host() -> None:
    me = Owner.this_process()
    assert Owner.parse(str(me)) == me
    assert Owner.parse("node:7:12:345") == Owner("node:7", 12, "345")
    assert not Owner(HOST, os.getpid(), "12").is_alive(heartbeat=time.time())
    other = Owner(f"not-{HOST}", os.getpid(), me.started)
    assert other.is_alive(time.time() - STALE_S / 2)
    assert not other.is_alive(time.time() - 2 * STALE_S)
