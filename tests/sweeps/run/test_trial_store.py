"""Trials of a study: claims, trials that count, and the trials of a lost driver."""

from __future__ import annotations

from typing import Any

import pytest

from sweeps import attributes as names
from sweeps.space import build_sampler
from sweeps.run.storage import TrialStore
from tests.sweeps.fakes import memory, silence, store_on


@pytest.fixture
def store() -> TrialStore:
    return store_on(memory())


def claim(store: TrialStore, key: str = "k", **more: Any) -> int | None:
    return store.claim({names.KEY: key, names.LABEL: f"point {key}"}, **more)


def trial(store: TrialStore, number: int) -> Any:
    return store.study.get_trials(deepcopy=False)[number]


def states(store: TrialStore) -> list[str]:
    return [each.state.name for each in store.trials()]


def searching(storage: Any) -> TrialStore:
    """The store of a search; every driver has a study object and a sampler of its own."""
    sampler = build_sampler({"_target_": "optuna.samplers.RandomSampler"})
    return store_on(storage, None, "search", sampler=sampler)


def taken(store: TrialStore, total: int | None = None) -> tuple[int, float]:
    """Ask for a trial of one parameter, and note its point."""
    asked = store.ask(total)
    assert asked is not None
    x = asked.suggest_float("x", 0, 1)
    store.update_unfinished(asked.number, {names.KEY: f"x={x}", names.LABEL: f"#{asked.number}"})
    return asked.number, x


def test_claim_of_running_point_is_dropped(store: TrialStore) -> None:
    assert claim(store) == 0
    assert claim(store) is None
    assert claim(store, "other") == 2
    assert [each.number for each in store.trials()] == [0, 2]


def test_claim_of_finished_point_requires_replaced(store: TrialStore) -> None:
    claim(store)
    store.complete(0, [1.0], {})
    assert claim(store) is None
    assert claim(store, replaced=[0]) == 2


def test_ask_last_trial_goes_to_lower_number(monkeypatch: pytest.MonkeyPatch) -> None:
    storage = memory()
    mine, theirs = searching(storage), searching(storage)
    ask = mine.study.ask

    def both_saw_room(space: Any) -> Any:
        theirs.ask(1)
        return ask(space)

    monkeypatch.setattr(mine.study, "ask", both_saw_room)
    assert mine.ask(1) is None
    assert [each.number for each in mine.trials()] == [0]


def test_finish_twice_keeps_first_end(store: TrialStore) -> None:
    claim(store)
    with pytest.raises(ValueError, match="did not match the number of the objectives"):
        store.complete(0, [1.0, 2.0], {})
    store.complete(0, [1.0], {})
    store.send_heartbeats([0])
    store.fail(0, "too late", {})
    store.release(0)
    assert (states(store), trial(store, 0).values) == (["COMPLETE"], [1.0])
    assert names.REASON not in trial(store, 0).user_attrs


def test_heartbeats_keep_a_trial_of_a_list_from_staleness() -> None:
    storage = memory()
    store = store_on(storage)
    for key in "abc":
        claim(store, key)
    store.complete(0, [1.0], {})
    silence(storage)
    store.send_heartbeats([2])
    other = store_on(storage)
    other.fail_stale()
    assert states(other) == ["COMPLETE", "RUNNING"]
    assert claim(other, "b") == 3
    assert claim(other, "c") is None


def test_running_trial_that_never_had_a_beat_becomes_stale() -> None:
    """Its driver was killed between the trial and the first heartbeat."""
    storage = memory()
    store = searching(storage)
    store.study.ask()
    for expected in (["RUNNING"], []):
        store.fail_stale()
        assert states(store) == expected
        silence(storage)
    assert store.ask(1) is not None


def test_stale_trial_of_search_is_enqueued_with_its_point() -> None:
    storage = memory()
    _, x = taken(searching(storage), 1)
    silence(storage)
    mine = searching(storage)
    mine.fail_stale()
    assert states(mine) == ["WAITING"]
    again = mine.ask(1)
    assert again is not None
    assert again.suggest_float("x", 0, 1) == x
    assert again.user_attrs[names.KEY] == f"x={x}"
    mine.release(again.number)
    third = mine.ask(1)
    assert third is not None, "as often as it is lost"
    assert third.suggest_float("x", 0, 1) == x
    assert states(mine) == ["RUNNING"]


def test_release_without_point_or_after_its_failure_enqueues_nothing() -> None:
    store = searching(memory())
    store.ask(2)
    store.release(0)
    assert states(store) == []
    number, _ = taken(store)
    store.update_unfinished(number, {names.REASON: "killed while its failure was noted"})
    store.release(number)
    assert states(store) == ["FAIL"]


@pytest.mark.parametrize("end", ["runs", "is complete"])
def test_point_enqueued_twice_is_run_once(end: str) -> None:
    """Two drivers may fail the same stale trial."""
    storage = memory()
    number, _ = taken(searching(storage))
    a, b = searching(storage), searching(storage)
    lost = trial(a, number)
    a.release(number)
    b._storage.get_heartbeat_stale_trial_callback()(b.study, lost)
    again = a.ask(1)
    assert again is not None
    if end == "is complete":
        a.complete(again.number, [1.0], {})
    assert b.ask(1) is None
    assert states(b) == ["COMPLETE" if end == "is complete" else "RUNNING"]


def test_asking_at_once_for_duplicate_point_keeps_one() -> None:
    storage = memory()
    number, _ = taken(searching(storage))
    a, b = searching(storage), searching(storage)
    lost = trial(a, number)
    a.release(number)
    b._storage.get_heartbeat_stale_trial_callback()(b.study, lost)
    waiting = [each.number for each in a.trials()]
    pop, answers = a.study.ask, []

    def both_pop(space: Any) -> Any:
        mine = pop(space)
        answers.append(b.ask(1))
        return mine

    a.study.ask = both_pop  # type: ignore[method-assign]
    answers.append(a.ask(1))
    assert [answer is None for answer in answers] == [True, False], "the lower number wins"
    assert [each.number for each in a.trials()] == waiting[:1]


def test_release_keeps_point_that_another_driver_takes_first() -> None:
    storage = memory()
    number, x = taken(searching(storage), 1)
    slow, fast = searching(storage), searching(storage)
    finish, answers = slow._finish, []

    def ask_first(*arguments: Any) -> None:
        answers.append(fast.ask(1))
        finish(*arguments)

    slow._finish = ask_first  # type: ignore[method-assign]
    slow.release(number)
    (again,) = answers
    assert again is not None, "the point was lost"
    assert again.suggest_float("x", 0, 1) == x
    assert states(slow) == ["RUNNING"]
