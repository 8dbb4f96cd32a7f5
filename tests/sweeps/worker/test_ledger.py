"""Trials of a study: who claims what, what counts, and what becomes of a dead driver's trials."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
import pytest
from optuna.distributions import IntDistribution

from sweeps import attributes as names
from sweeps.space.samplers import build_sampler
from sweeps.worker.owner import STALE_S, Owner
from sweeps.worker.storage import open_storage
from sweeps.worker.trial_store import Claim, Ledger
from tests.sweeps.fakes import DEAD, GONE, ledger_on, memory, silent


@pytest.fixture
def ledger() -> Ledger:
    return ledger_on(memory())


def claim(ledger: Ledger, key: str = "k", **more: Any) -> int | None:
    return ledger.claim(Claim(key, {names.LABEL: f"point {key}"}, **more))


def trial(ledger: Ledger, number: int) -> Any:
    return ledger.study.get_trials(deepcopy=False)[number]


def states(ledger: Ledger) -> list[str]:
    return [each.state.name for each in ledger.trials()]


def searching(storage: Any, me: Owner | None = None) -> Ledger:
    """A ledger of a search; every driver has a study object and a sampler of its own."""
    return ledger_on(storage, me, sampler=build_sampler("random", 0, {}, 1))


def taken(ledger: Ledger, total: int | None = None) -> tuple[int, float]:
    """Ask for a trial of one parameter, and note its point."""
    asked = ledger.ask(total)
    assert asked is not None
    x = asked.suggest_float("x", 0, 1)
    ledger.note(asked.number, {names.KEY: f"x={x}", names.LABEL: f"#{asked.number}"})
    return asked.number, x


def orphans(ledger: Ledger, *mine: int) -> list[int]:
    return [each.number for each in ledger.orphans(mine)]


def test_a_claim_is_a_running_trial_with_all_that_is_known_of_the_point(ledger: Ledger) -> None:
    number = claim(ledger, params={"x": 3}, distributions={"x": IntDistribution(0, 9)})
    assert number == 0
    found = trial(ledger, 0)
    assert found.state.name == "RUNNING"
    assert found.params == {"x": 3}
    assert found.user_attrs[names.KEY] == "k"
    assert found.user_attrs[names.LABEL] == "point k"
    assert found.user_attrs[names.OWNER] == str(Owner.me())
    assert abs(found.user_attrs[names.BEAT] - time.time()) < 60


def test_a_point_that_runs_is_not_claimed_again_and_the_attempt_does_not_count(
    ledger: Ledger,
) -> None:
    assert claim(ledger) == 0
    assert claim(ledger) is None
    assert claim(ledger, "other") == 2
    assert [each.number for each in ledger.trials()] == [0, 2]
    assert "trial 0" in trial(ledger, 1).user_attrs[names.REASON]


@pytest.mark.parametrize("how", ["complete", "prune"])
def test_a_point_that_is_done_is_not_claimed_again_unless_that_is_past(
    ledger: Ledger, how: str
) -> None:
    claim(ledger)
    if how == "complete":
        ledger.complete(0, [1.0], {})
    else:
        ledger.prune(0, "hopeless", {})
    assert claim(ledger) is None
    assert claim(ledger, past=[0]) == 2


def test_a_failed_trial_does_not_keep_its_point(ledger: Ledger) -> None:
    claim(ledger)
    ledger.fail(0, "a bad day", {names.SECONDS: 3})
    assert claim(ledger) == 1
    assert trial(ledger, 0).user_attrs[names.REASON] == "a bad day"
    assert trial(ledger, 0).user_attrs[names.SECONDS] == 3


def opener(tmp_path: Path, kind: str) -> Callable[[], Any]:
    where = {"journal": str(tmp_path / "s.journal"), "sqlite": f"sqlite:///{tmp_path / 's.db'}"}
    return lambda: open_storage(where[kind], tmp_path)


@pytest.mark.parametrize(("kind", "keys"), [("journal", "abcdefgh"), ("sqlite", "abc")])
def test_of_two_drivers_that_claim_the_same_points_at_once_one_gets_each(
    tmp_path: Path, kind: str, keys: str
) -> None:
    opened = opener(tmp_path, kind)
    ledgers = [ledger_on(opened()) for _ in range(2)]
    got: list[list[str]] = [[], []]
    at_once = threading.Barrier(2)

    def work(index: int) -> None:
        for key in keys:
            at_once.wait()
            if claim(ledgers[index], key) is not None:
                got[index].append(key)

    threads = [threading.Thread(target=work, args=(index,)) for index in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(got[0] + got[1]) == list(keys)
    assert states(ledgers[0]) == ["RUNNING"] * len(keys)


@pytest.mark.parametrize(("kind", "total"), [("journal", 20), ("sqlite", 7)])
def test_three_drivers_that_ask_at_once_make_as_many_trials_as_were_wanted(
    tmp_path: Path, kind: str, total: int
) -> None:
    opened = opener(tmp_path, kind)
    ledgers = [searching(opened()) for _ in range(3)]
    drawn: list[float] = []

    def work(ledger: Ledger) -> None:
        while len(ledger.trials()) < total:
            asked = ledger.ask(total)
            if asked is not None:
                drawn.append(asked.suggest_float("x", 0, 1))

    threads = [threading.Thread(target=work, args=(ledger,)) for ledger in ledgers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert states(ledgers[0]) == ["RUNNING"] * total, "none was told: running ones count"
    assert len(set(drawn)) == len(drawn) == total


def test_running_trials_of_other_drivers_count_in_the_total() -> None:
    storage = memory()
    mine, theirs = searching(storage), searching(storage, DEAD)
    taken(theirs)
    taken(mine)
    assert mine.ask(2) is None
    assert theirs.ask(2) is None
    assert len(mine.study.trials) == 2, "none was made to be dropped"
    assert mine.ask(3) is not None


def test_of_two_that_ask_for_the_last_trial_the_earlier_number_keeps_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    storage = memory()
    mine, theirs = searching(storage), searching(storage, DEAD)
    ask = mine.study.ask

    def both_saw_room() -> Any:
        theirs.ask(1)
        return ask()

    monkeypatch.setattr(mine.study, "ask", both_saw_room)
    assert mine.ask(1) is None
    assert [each.number for each in mine.trials()] == [0]


def test_the_last_sign_of_a_driver_is_renewed() -> None:
    storage = memory()
    ledger = ledger_on(storage, DEAD)
    claim(ledger)
    silent(storage, 0)
    ledger.beat([0])
    assert orphans(ledger_on(storage)) == []


def test_a_sign_for_a_trial_that_another_driver_finished_does_no_harm(ledger: Ledger) -> None:
    claim(ledger)
    ledger.complete(0, [1.0], {})
    ledger.beat([0])
    ledger.fail(0, "too late", {})
    ledger.complete(0, [2.0], {})
    assert trial(ledger, 0).state.name == "COMPLETE"
    assert trial(ledger, 0).values == [1.0]
    assert names.REASON not in trial(ledger, 0).user_attrs


def test_what_the_storage_refuses_of_an_unfinished_trial_is_not_hidden(ledger: Ledger) -> None:
    claim(ledger)
    with pytest.raises(ValueError, match="did not match the number of the objectives"):
        ledger.complete(0, [1.0, 2.0], {})


@pytest.mark.parametrize(
    ("owner", "seconds", "is_gone"),
    [
        (GONE, 0.0, True),
        (DEAD, STALE_S / 2, False),
        (DEAD, 2 * STALE_S, True),
    ],
    ids=["a process that ended", "another host, heard of", "another host, silent"],
)
def test_trials_of_a_driver_that_is_gone_are_orphans(
    owner: Owner, seconds: float, is_gone: bool
) -> None:
    storage = memory()
    claim(ledger_on(storage, owner))
    silent(storage, 0, seconds)
    assert orphans(ledger_on(storage)) == ([0] if is_gone else [])


def test_a_trial_of_its_own_that_a_driver_does_not_work_on_is_an_orphan(ledger: Ledger) -> None:
    claim(ledger, "a")
    claim(ledger, "b")
    assert orphans(ledger, 0, 1) == []
    assert orphans(ledger, 1) == [0]


def test_finished_and_dropped_trials_are_no_orphans() -> None:
    storage = memory()
    gone = ledger_on(storage, GONE)
    for key in "abcd":
        claim(gone, key)
    gone.complete(0, [1.0], {})
    gone.fail(1, "a bad day", {})
    gone.drop(2, "not needed")
    assert orphans(ledger_on(storage)) == [3]


def test_a_search_trial_asked_for_a_moment_ago_is_no_orphan_though_nobody_signed_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ledger = searching(memory())
    ledger.study.ask()
    assert orphans(ledger) == []
    later = time.time() + 2 * STALE_S
    monkeypatch.setattr(time, "time", lambda: later)
    assert orphans(ledger) == [0]


def test_a_released_point_of_a_list_can_be_claimed_again(ledger: Ledger) -> None:
    claim(ledger)
    ledger.release(0, "its driver was gone", again=False)
    assert ledger.trials() == []
    assert claim(ledger) == 1


def test_a_released_search_trial_comes_back_with_its_parameters() -> None:
    storage = memory()
    number, x = taken(searching(storage, GONE), 1)
    mine = searching(storage)
    mine.release(number, "its driver was gone", again=True)
    assert states(mine) == ["WAITING"]
    again = mine.ask(1)
    assert again is not None
    assert again.suggest_float("x", 0, 1) == x
    assert again.user_attrs[names.KEY] == f"x={x}"
    assert states(mine) == ["RUNNING"]
    assert trial(mine, again.number).user_attrs[names.OWNER] == str(Owner.me())


def test_a_search_trial_without_a_point_yet_is_dropped_and_another_one_asked_for() -> None:
    storage = memory()
    gone = searching(storage, GONE)
    gone.ask(1)
    mine = searching(storage)
    mine.release(0, "its driver was gone", again=True)
    assert states(mine) == []
    assert mine.ask(1) is not None


def test_two_drivers_that_release_an_orphan_one_after_the_other_queue_it_once() -> None:
    storage = memory()
    number, _ = taken(searching(storage, GONE))
    a, b = searching(storage), searching(storage)
    a.release(number, "gone", again=True)
    b.release(number, "gone", again=True)
    assert states(a) == ["WAITING"]


def test_a_crash_between_queueing_an_orphan_and_dropping_it_queues_it_once() -> None:
    storage = memory()
    number, x = taken(searching(storage, GONE))
    a, b = searching(storage), searching(storage)
    a.study.enqueue_trial({"x": x}, user_attrs={names.KEY: f"x={x}"})
    assert orphans(b) == [number]
    b.release(number, "gone", again=True)
    assert states(b) == ["WAITING"]


@pytest.mark.parametrize("finished", [False, True], ids=["runs there", "is finished there"])
def test_an_orphan_that_another_driver_released_and_took_up_is_not_queued_again(
    finished: bool,
) -> None:
    storage = memory()
    number, _ = taken(searching(storage, GONE))
    a, b = searching(storage), searching(storage)
    (seen,) = orphans(b)
    a.release(number, "gone", again=True)
    again = a.ask(1)
    assert again is not None
    if finished:
        a.complete(again.number, [1.0], {})
    b.release(seen, "gone", again=True)
    assert states(b) == ["COMPLETE" if finished else "RUNNING"]


def test_giving_back_a_trial_that_another_driver_has_finished_changes_nothing() -> None:
    storage = memory()
    mine, other = searching(storage, DEAD), searching(storage)
    number, _ = taken(mine)
    other.complete(number, [1.0], {})
    mine.release(number, "its driver was stopped", again=True)
    assert states(mine) == ["COMPLETE"]


def test_trials_are_found_by_the_key_of_their_point_earlier_ones_first(ledger: Ledger) -> None:
    claim(ledger, "a")
    ledger.fail(0, "a bad day", {})
    claim(ledger, "b")
    claim(ledger, "a")
    found = {key: [each.number for each in trials] for key, trials in ledger.by_key().items()}
    assert found == {"a": [0, 2], "b": [1]}


def test_a_trial_pruned_at_its_last_report_keeps_that_value() -> None:
    ledger = searching(memory())
    asked = ledger.ask(None)
    assert isinstance(asked, optuna.Trial)
    asked.report(40.0, 2)
    ledger.prune(asked.number, "pruned at step 2", {})
    found = trial(ledger, 0)
    assert (found.state.name, found.value) == ("PRUNED", 40.0)
    assert found.user_attrs[names.REASON] == "pruned at step 2"
