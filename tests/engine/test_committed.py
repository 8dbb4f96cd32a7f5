"""A state is committed as a whole, and a damaged one has a predecessor."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbt.checkpoints.torch_files import save
from rgbt.checks import RunError
from rgbt.engine import committed
from rgbt.engine.checkpoint import State, load_checkpoint
from rgbt.engine.committed import Checkpoints
from rgbt.engine.trainer import Trainer
from tests.engine.test_trainer import batches, make

COUNTS = "counts_val.npz"


def training(folder: Path, scores: dict[int, float], **changes: object) -> Trainer:
    """A trainer whose evaluations have these scores and leave a file beside their weights."""
    trainer, _ = make(folder, **{"eval_every": 2, "checkpoint_every": 1, **changes})

    def validate(step: int) -> float:
        place = trainer.checkpoints.begin_evaluation(step)
        (place / COUNTS).write_text(f"step {step}: {scores[step]}")
        return scores[step]

    trainer.validate = validate
    return trainer


def run(folder: Path, scores: dict[int, float], **changes: object) -> State:
    trainer = training(folder, scores, **changes)
    state = State(seed=0)
    trainer.resume(state)
    trainer.fit(batches(state.step), state)
    return state


RISING = {2: 0.4, 4: 0.5, 6: 0.3}


def agree(folder: Path, state: State) -> None:
    """State, best weights and counts are of one evaluation."""
    assert load_checkpoint(folder / "best.pt")["step"] == state.best_step
    assert (folder / COUNTS).read_text() == f"step {state.best_step}: {state.best_score}"


@pytest.fixture
def killed_at(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, int], None]:
    """End the process, as far as this one can, before the n-th file of a name is written."""

    def prepare(name: str, nth: int) -> None:
        left = [nth]

        def dying(path: Path, value: Any) -> None:
            left[0] -= path.name == name
            if left[0] == 0:
                monkeypatch.undo()
                raise KeyboardInterrupt
            save(path, value)

        monkeypatch.setattr(committed, "save", dying)

    return prepare


def test_an_evaluation_that_was_not_committed_counts_for_nothing(
    tmp_path: Path, killed_at: Callable[[str, int], None]
) -> None:
    """Killed after the best weights of step 4, before the state; on other hardware it scores less.

    With weights and counts written under their last names, those of step 4 stood for step 2.
    """
    killed_at("last.pt", 4)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, RISING)
    assert (tmp_path / "checkpoints" / "4" / "best.pt").exists()
    state = run(tmp_path, {4: 0.35, 6: 0.3})
    assert (state.best_step, state.best_score) == (2, 0.4)
    agree(tmp_path, state)


def test_a_state_that_was_committed_is_published_on_resuming(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dying(checkpoints: Checkpoints, step: int) -> None:
        if step == 4:
            raise KeyboardInterrupt
        publish(checkpoints, step)

    publish = Checkpoints._publish
    monkeypatch.setattr(Checkpoints, "_publish", dying)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, RISING)
    monkeypatch.undo()
    assert load_checkpoint(tmp_path / "best.pt")["step"] == 2
    loaded = Checkpoints(tmp_path).load()
    assert loaded is not None
    assert loaded[1].best_step == 4
    agree(tmp_path, loaded[1])
    agree(tmp_path, run(tmp_path, RISING))


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def last_two(folder: Path) -> bytes:
    """Killed at step 5, whose state and the one before it are there; the last.pt of a whole run."""
    run(folder / "whole", RISING)
    trainer = training(folder / "run", RISING)
    state = State(seed=0)

    def stopping() -> Any:
        for number, batch in zip(range(5), batches(0), strict=False):
            yield batch
            assert number < 5
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer.fit(stopping(), state)
    assert state.step == 5
    return (folder / "whole" / "last.pt").read_bytes()


@pytest.mark.parametrize("how", ["damaged", "missing", "best"])
def test_damaged_state_is_replaced_by_the_previous_one(tmp_path: Path, how: str) -> None:
    whole, folder = last_two(tmp_path), tmp_path / "run"
    if how == "best":  # of step 4, as the state before is: there is nothing to fall back to
        damage(folder / "best.pt")
        with pytest.raises(RunError, match=r"4/best\.pt cannot be read.*damaged too.*remove"):
            Checkpoints(folder).load()
        return
    if how == "damaged":
        damage(folder / "last.pt")
    else:
        (folder / "last.pt").unlink()
    trainer, state = training(folder, RISING), State(seed=0)
    assert trainer.resume(state)
    assert state.step == 4
    said = trainer.checkpoints.warning
    assert ("last.pt cannot be read" in said) == (how == "damaged"), said
    trainer.fit(batches(4), state)
    assert (folder / "last.pt").read_bytes() == whole
    agree(folder, state)


def test_damaged_best_weights_are_made_again(tmp_path: Path) -> None:
    trainer, state = training(tmp_path, RISING, max_steps=4), State(seed=0)
    trainer.fit(batches(0), state)  # the state before is of step 3, whose best step is 2
    damage(tmp_path / "best.pt")
    again, resumed = training(tmp_path, RISING), State(seed=0)
    assert again.resume(resumed)
    assert (resumed.step, resumed.best_step) == (3, 2)
    assert "4/best.pt cannot be read" in again.checkpoints.warning
    agree(tmp_path, resumed)
    again.fit(batches(3), resumed)
    agree(tmp_path, resumed)


def test_two_damaged_states_are_one_sentence(tmp_path: Path) -> None:
    last_two(tmp_path)
    folder = tmp_path / "run"
    damage(folder / "last.pt")
    damage(folder / "last_previous.pt")
    with pytest.raises(
        RunError, match=r"last\.pt cannot be read.*previous checkpoint .* is damaged too.*remove"
    ):
        Checkpoints(folder).load()


def test_one_checkpoint_more_is_kept_and_none_in_the_end(tmp_path: Path) -> None:
    state = run(tmp_path, RISING)
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"4"}
    assert {path.name for path in tmp_path.iterdir()} == {
        *("last.pt", "last_previous.pt", "best.pt", COUNTS, "checkpoints")
    }
    Checkpoints(tmp_path).tidy()
    assert {path.name for path in tmp_path.iterdir()} == {"last.pt", "best.pt", COUNTS}
    agree(tmp_path, state)
    again = run(tmp_path, {})  # a run killed before its result has nothing more to train
    assert again == state


def test_files_are_copied_where_there_are_no_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    agree(tmp_path, run(tmp_path, RISING))
    assert (tmp_path / "best.pt").stat().st_nlink == 1, "a copy and not a link"


def test_a_run_of_before_resumes(tmp_path: Path) -> None:
    """Its best weights lie beside last.pt alone, its state has fewer entries."""
    whole, old = last_two(tmp_path), tmp_path / "run"
    Checkpoints(old).tidy()
    for name in ("last.pt", "best.pt"):
        payload = load_checkpoint(old / name)
        for entry in ("evaluated_step", "unlogged"):
            payload.get("state", {}).pop(entry, None)
        torch.save(payload, old / name)
    state = run(old, RISING)
    agree(old, state)
    assert (old / "last.pt").read_bytes() == whole


def test_weights_of_another_step_are_refused(tmp_path: Path) -> None:
    run(tmp_path, RISING)
    assert Checkpoints(tmp_path).load_best(4)
    with pytest.raises(
        RunError, match=r"is of step 4, but the best evaluation of this run is of step 2"
    ):
        Checkpoints(tmp_path).load_best(2)
