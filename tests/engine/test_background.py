"""Checkpoints are due by time; a thread writes them while training continues."""

from __future__ import annotations

import copy
import errno
import multiprocessing
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.checkpoints.files import save
from rgbt.engine import checkpoint, trainer
from rgbt.engine.checkpoint import State, load_checkpoint
from rgbt.runtime.signals import Stopped, answered
from rgbt.types import Batch
from tests.checkpoints.test_torch_files import same
from tests.engine.test_trainer import Trainer, batches, make
from tests.runtime.test_signals import send, signal
from tests.waiting import DEADLINE_S, until

OFTEN = 1e-9  # minutes: after every step, unless a checkpoint is being written
NEVER = 1440


@pytest.fixture
def saved(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Names and steps of the files that are written."""
    return watched(monkeypatch, lambda _: None)


def watched(
    monkeypatch: pytest.MonkeyPatch, before: Callable[[Any], object]
) -> list[tuple[str, int]]:
    found: list[tuple[str, int]] = []

    def saving(path: Path, value: Any) -> None:
        before(value)
        save(path, value)
        found.append((path.name, checkpoint.step_of(value, path)))

    monkeypatch.setattr(checkpoint, "save", saving)
    return found


def at_step(made: Trainer, number: int, act: Callable[[], object]) -> None:
    """Do something at the end of a step."""
    log = made.hooks.log

    def logged(step: int, values: dict[str, float]) -> None:
        log(step, values)
        if step == number:
            act()

    made.hooks.log = logged  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"checkpoint_minutes": 10}, [3, 6, 9, 10]),
        ({"checkpoint_minutes": 20}, [5, 10]),
        ({"checkpoint_minutes": NEVER}, [10]),
        ({"checkpoint_minutes": NEVER, "checkpoint_evaluations": True}, [4, 8, 10]),
        ({"checkpoint_minutes": 0}, [*range(1, 11)]),
    ],
)
def test_checkpoints_are_due_by_time_and_at_the_end(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    saved: list[tuple[str, int]],
    changes: dict[str, Any],
    expected: list[int],
) -> None:
    """Steps of four minutes; evaluations after 4, 8 and 10 of them, each better than the last."""
    clock = SimpleNamespace(now=0.0, perf_counter=time.perf_counter)
    clock.monotonic = lambda: clock.now
    monkeypatch.setattr(trainer, "time", clock)
    made, _ = make(tmp_path, max_steps=10, eval_every=4, **changes)
    for number in range(1, 11):
        # The thread is done in four minutes: the next step does not find it at work.
        def pass_time() -> None:
            if made._writing is not None:
                made._writing.result()
            clock.now += 240

        at_step(made, number, pass_time)
    made.fit(batches(0), State(seed=0))
    assert [step for name, step in saved if name == "last.pt"] == expected
    # Of evaluations between two checkpoints, the best one is written.
    best = [max((n for n in (4, 8, 10) if n <= step), default=0) for step in expected]
    assert [step for name, step in saved if name == "best.pt"] == sorted({*best} - {0})


def test_training_continues_while_a_thread_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checkpoint of step 1 has its weights, although it ends when step 5 has come."""
    come, weights, waited = Event(), {}, []
    made, log = make(tmp_path, max_steps=8, eval_every=6, checkpoint_minutes=OFTEN)
    at_step(made, 1, lambda: made._writing.result())  # the memory is there

    def wait(value: Any) -> None:
        waited.append(come.wait(DEADLINE_S))
        if "state" in value:
            written[value["state"]["step"]] = copy.deepcopy(value)

    written: dict[int, Any] = {}
    watched(monkeypatch, wait)
    made.hooks.evaluate = lambda step, _: -float(step) / 9  # type: ignore[method-assign]
    for number in range(1, 9):
        at_step(
            made, number, lambda: weights.update({len(log): copy.deepcopy(made.model.state_dict())})
        )
    at_step(made, 5, come.set)
    made.fit(batches(0), State(seed=0))
    assert all(waited)
    first, second, *_ = written
    assert (first, second >= 5) == (1, True), "those that are due in between are put off"
    for step, payload in written.items():
        assert same(dict(payload["model"]), dict(weights[step])), step
    best = load_checkpoint(tmp_path / "best.pt")
    assert best["step"] == 6
    assert same(dict(best["model"]), dict(weights[6]))


def test_error_of_the_thread_ends_training_at_the_next_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    watched(monkeypatch, full)
    made, log = make(tmp_path, max_steps=30, eval_every=30, checkpoint_minutes=OFTEN)

    def endless() -> Iterator[Batch]:
        for batch in batches(0):
            if made._writing is not None:
                until(lambda: made._writing is None or made._writing.done(), "the thread")
            yield batch

    with pytest.raises(OSError, match="No space left on device"):
        made.fit(endless(), State(seed=0))
    assert len(log) <= 4
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("minutes", [OFTEN, NEVER])
def test_signal_waits_for_the_file_of_its_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, minutes: float
) -> None:
    saved = watched(monkeypatch, lambda _: time.sleep(0.2))
    made, _ = make(tmp_path, eval_every=3, checkpoint_minutes=minutes)
    at_step(made, 4, lambda: send(signal.SIGTERM))
    with answered(), pytest.raises(Stopped, match="at step 4, and the checkpoint is saved"):
        made.fit(batches(0), State(seed=0))
    assert saved[-1] == ("last.pt", 4)
    assert load_checkpoint(tmp_path / "last.pt")["state"]["step"] == 4
    assert load_checkpoint(tmp_path / "best.pt")["step"] == 3


def test_error_of_a_step_waits_for_the_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved = watched(monkeypatch, lambda _: time.sleep(0.2))
    made, _ = make(tmp_path, checkpoint_minutes=OFTEN, eval_every=6)
    at_step(made, 1, lambda: made._writing.result())

    def dies() -> None:
        raise ZeroDivisionError

    at_step(made, 4, dies)
    with pytest.raises(ZeroDivisionError):
        made.fit(batches(0), State(seed=0))
    assert saved, "the checkpoint that was being written"
    assert load_checkpoint(tmp_path / "last.pt")["state"]["step"] == saved[-1][1]


def test_loader_process_is_forked_while_the_thread_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    come, codes = Event(), []
    watched(monkeypatch, lambda _: come.wait(DEADLINE_S))
    made, _ = make(tmp_path, checkpoint_minutes=OFTEN, eval_every=6)
    at_step(made, 1, lambda: made._writing.result())

    def fork() -> None:
        until(lambda: made._writing.running(), "the thread")
        process = multiprocessing.get_context("fork").Process(target=_load)
        process.start()
        process.join(DEADLINE_S)
        codes.append(process.exitcode)
        come.set()

    at_step(made, 4, fork)
    made.fit(batches(0), State(seed=0))
    assert codes == [0]
    assert load_checkpoint(tmp_path / "last.pt")["state"]["step"] == 6


def _load() -> None:
    next(batches(0)).rgb.float().sum()
