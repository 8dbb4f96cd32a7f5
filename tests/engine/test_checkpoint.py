"""The best weights and the files of their evaluation agree with the state that names them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from torch import nn

from rgbt.checkpoints.files import save
from rgbt.checks import InputError, RunError
from rgbt.engine import checkpoint
from rgbt.engine.checkpoint import State, load_checkpoint, load_last, restore_weights
from tests.engine.test_trainer import batches, make

COUNTS = "counts_val.npz"
RISING = {2: 0.4, 4: 0.5, 6: 0.3}


def run(folder: Path, scores: dict[int, float]) -> State:
    """Train or resume; evaluations have these scores, and leave a file beside their weights."""
    trainer, _ = make(folder, eval_every=2, checkpoint_every=1)
    latest: list[str] = []

    def evaluate(step: int, _: nn.Module) -> float:
        latest.append(f"step {step}: {scores[step]}")
        return scores[step]

    trainer.hooks.evaluate = evaluate
    trainer.hooks.keep = lambda: (folder / COUNTS).write_text(latest[-1])
    state = State(seed=0)
    trainer.resume(state)
    trainer.fit(batches(state.step), state)
    return state


def agree(folder: Path, state: State) -> None:
    """State, best weights and counts are of one evaluation."""
    assert load_checkpoint(folder / "best.pt")["step"] == state.best_step
    assert (folder / COUNTS).read_text() == f"step {state.best_step}: {state.best_score}"


@pytest.mark.parametrize(("name", "nth", "best"), [("best.pt", 2, 2), ("last.pt", 4, 4)])
def test_killed_while_the_best_is_saved_makes_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, nth: int, best: int
) -> None:
    """Killed after the evaluation of step 4, before its best weights or before its state."""
    left = [nth]

    def dying(path: Path, value: Any) -> None:
        left[0] -= path.name == name
        if left[0] == 0:
            raise KeyboardInterrupt
        save(path, value)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", dying)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, RISING)
    _, state = load_last(tmp_path)
    assert (state.step, state.best_step) == (3, 2)
    assert load_checkpoint(tmp_path / "best.pt")["step"] == best
    state = run(tmp_path, RISING)
    assert (state.best_step, state.best_score) == (4, 0.5)
    agree(tmp_path, state)


@pytest.mark.parametrize("name", ["last.pt", "best.pt"])
@pytest.mark.parametrize("how", ["damaged", "missing", "of another step"])
def test_damaged_checkpoints_are_refused(tmp_path: Path, name: str, how: str) -> None:
    run(tmp_path, RISING)
    path = tmp_path / name
    if how == "missing":
        path.unlink()
    elif how == "damaged":
        flipped = bytearray(path.read_bytes())
        flipped[len(flipped) // 2] ^= 1
        path.write_bytes(flipped)
    else:
        content = load_checkpoint(path) | {"step": 3}
        content.pop("state", None)
        save(path, content)
    if (name, how) == ("last.pt", "missing"):
        assert run(tmp_path, RISING).step == 6, "the run begins anew"
        return
    with pytest.raises(RunError, match="; remove the folder and rerun"):
        load_last(tmp_path)


def test_finished_training_keeps_three_files_and_trains_no_more(tmp_path: Path) -> None:
    state = run(tmp_path, RISING)
    agree(tmp_path, state)
    assert {path.name for path in tmp_path.iterdir()} == {"last.pt", "best.pt", COUNTS}
    assert run(tmp_path, {}) == state  # killed before its result


def test_checkpoint_of_another_model_is_refused_with_the_keys(tmp_path: Path) -> None:
    weights = nn.Linear(2, 3).state_dict()
    for model in (nn.Linear(2, 4), nn.Linear(2, 3, bias=False), nn.Linear(2, 3).double()):
        with pytest.raises(InputError, match="of another model: .*(weight|bias)"):
            restore_weights(model, weights, tmp_path / "other.pt")
