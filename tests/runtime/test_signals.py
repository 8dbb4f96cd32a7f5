"""Signals: between two steps of a training, at once elsewhere, and what is left afterwards."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from torch import nn
from torch.utils.data import DataLoader

from rgbt.config.plain_command import PlainCommand
from rgbt.data.loaders import ENDING, start_worker
from rgbt.engine.checkpoint import State, load_checkpoint
from rgbt.engine.trainer import Trainer
from rgbt.runtime.signals import Stopped, answered
from rgbt.types import Batch
from tests.checkpoints.test_torch_files import same
from tests.commands import Call, NoOptions, assert_one_sentence
from tests.engine.test_trainer import batches, make
from tests.waiting import DEADLINE_S

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def send(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)


@pytest.fixture(autouse=True)
def answering() -> Iterator[None]:
    with answered():
        yield


def sending(number: signal.Signals, step: int, times: int = 1) -> Iterator[Batch]:
    """Batches; the signal comes while one is made."""
    for done, batch in enumerate(batches(0)):
        for _ in range(times if done == step else 0):
            send(number)
        yield batch


def train(folder: Path, **changes: object) -> tuple[Trainer, list]:
    return make(folder, max_steps=6, checkpoint_minutes=1440, eval_every=3, log_every=4, **changes)


@pytest.mark.parametrize(
    ("number", "step"), [(signal.SIGINT, 1), (signal.SIGTERM, 2), (signal.SIGHUP, 4)]
)
def test_the_step_in_progress_is_finished_and_saved(
    tmp_path: Path, number: signal.Signals, step: int
) -> None:
    """In the steps 2, 3 (an evaluation is due after it) and 5; the rest equals a whole run."""
    whole, log = train(tmp_path / "whole")
    whole.fit(batches(0), State(seed=7))
    first, first_log = train(tmp_path / "run")
    saved = f"at step {step + 1}, and the checkpoint is saved; rerun"
    with answered(), pytest.raises(Stopped, match=saved) as stop:
        first.fit(sending(number, step), State(seed=7))
    assert (stop.value.step, stop.value.code) == (step + 1, 128 + number)
    second, second_log = train(tmp_path / "run")
    state = State(seed=7)
    assert second.resume(state)
    assert state.step == step + 1
    second.fit(batches(state.step), state)
    ends = [load_checkpoint(tmp_path / where / "last.pt") for where in ("whole", "run")]
    assert same(*ends)
    logs = (log, first_log + second_log)
    names = [[sorted(values) for _, values in lines] for lines in logs]
    losses = [[(step, values["loss"]) for step, values in lines] for lines in logs]
    assert names[0] == names[1]
    assert losses[0] == losses[1]


def test_evaluation_is_left_at_once_and_repeated_on_resuming(tmp_path: Path) -> None:
    waited: list[int] = []

    def stopped(step: int, _: nn.Module) -> float:
        send(signal.SIGTERM)
        waited.append(step)
        return 0.0

    trainer, _ = train(tmp_path)
    trainer.hooks.evaluate = stopped
    with answered(), pytest.raises(Stopped) as stop:
        trainer.fit(batches(0), State(seed=7))
    assert (stop.value.step, waited) == (3, [])
    again, _ = train(tmp_path)
    evaluated: list[int] = []
    again.hooks.evaluate = lambda step, _: evaluated.append(step) or float(step)
    state = State(seed=7)
    assert again.resume(state)
    assert (state.step, state.evaluated_step) == (3, 0)
    again.fit(batches(3), state)
    assert evaluated == [3, 6]


def test_signal_that_comes_while_processes_agree_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def signalled(number: int) -> int:
        send(signal.SIGTERM)
        return number

    trainer, _ = train(tmp_path)
    monkeypatch.setattr("rgbt.engine.trainer.largest", signalled)
    with pytest.raises(Stopped, match="at step 1, and"):
        trainer.fit(batches(0), State(seed=7))


def test_second_ctrl_c_stops_in_the_middle_of_step(tmp_path: Path) -> None:
    trainer, _ = train(tmp_path)
    with pytest.raises(KeyboardInterrupt) as interrupt:
        trainer.fit(sending(signal.SIGINT, 1, times=2), State(seed=7))
    assert not isinstance(interrupt.value, Stopped)
    assert list(tmp_path.iterdir()) == []


def test_clusters_signal_more_than_once(tmp_path: Path) -> None:
    trainer, _ = train(tmp_path)
    with pytest.raises(Stopped, match="at step 2"):
        trainer.fit(sending(signal.SIGTERM, 1, times=3), State(seed=7))


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (signal.SIGHUP, 129, "stopped by SIGHUP; rerun the command to resume."),
        (signal.SIGINT, 130, "interrupted; rerun the command to resume."),
        (signal.SIGTERM, 143, "stopped by SIGTERM; rerun the command to resume."),
    ],
)
def test_commands_end_with_the_code_of_the_signal(
    call: Call, number: signal.Signals, code: int, said: str
) -> None:
    def main(options: NoOptions, overrides: list[str]) -> int:
        del options, overrides
        send(number)
        raise AssertionError("the signal waits")

    before = signal.getsignal(number)
    found, _, err = call(PlainCommand(NoOptions, main))
    assert found == code
    assert_one_sentence(err, said)
    assert signal.getsignal(number) is before


def test_what_the_process_ignores_stays_ignored() -> None:
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with answered():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            send(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def started(loader: DataLoader[int]) -> Iterator[int]:
    """As `rgbt.data.loaders.Batches` does."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        return iter(loader)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def test_workers_leave_group_signals_to_the_main_process() -> None:
    """Ctrl-C in a terminal and `killpg` reach them too; the step in progress needs them."""
    loader = DataLoader(
        range(40), batch_size=None, num_workers=1, worker_init_fn=start_worker, prefetch_factor=2
    )
    found = started(loader)
    assert next(found) == 0
    (worker,) = found._workers  # type: ignore[attr-defined]
    for number in SIGNALS:
        subprocess.run(["kill", f"-{int(number)}", str(worker.pid)], check=True)
    assert list(found) == list(range(1, 40))
    fresh = started(loader)
    assert next(fresh) == 0
    (worker,) = fresh._workers  # type: ignore[attr-defined]
    worker.terminate()
    worker.join(5)
    assert worker.exitcode == 0, "the main process ends them"


def test_workers_end_where_no_signal_can_be_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on macOS."""
    monkeypatch.delattr(signal, "sigtimedwait")
    loader = DataLoader(range(4), batch_size=None, num_workers=1, worker_init_fn=start_worker)
    found = started(loader)
    (worker,) = found._workers  # type: ignore[attr-defined]
    assert list(found) == [0, 1, 2, 3]
    worker.join(DEADLINE_S)
    assert worker.exitcode == 0


def test_library_error_after_a_signal_is_its_consequence(call: Call) -> None:
    """As where a ``finally`` needs what was not complete yet."""

    def main(options: NoOptions, overrides: list[str]) -> int:
        del options, overrides
        half: list[str] = []
        try:
            send(signal.SIGTERM)
        finally:
            half.pop()

    found, _, err = call(PlainCommand(NoOptions, main))
    assert found == 143
    assert_one_sentence(err, "stopped by SIGTERM; rerun the command to resume.")
