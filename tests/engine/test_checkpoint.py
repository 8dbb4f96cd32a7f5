"""A state is committed as a whole, with its best weights and the files of their evaluation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rgbt.checkpoints.torch_files import save
from rgbt.checks import RunError
from rgbt.engine import checkpoint
from rgbt.engine.checkpoint import Checkpoints, State, load_checkpoint
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

        monkeypatch.setattr(checkpoint, "save", dying)

    return prepare


def test_an_evaluation_that_was_not_committed_counts_for_nothing(
    tmp_path: Path, killed_at: Callable[[str, int], None]
) -> None:
    """Killed after the evaluation of step 4, before its state; on other hardware it scores less."""
    killed_at("last.pt", 4)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, RISING)
    state = run(tmp_path, {4: 0.35, 6: 0.3})
    assert (state.best_step, state.best_score) == (2, 0.4)
    agree(tmp_path, state)


@pytest.mark.parametrize("moved", [False, True])
def test_best_weights_of_a_committed_state_are_written_on_resuming(
    tmp_path: Path, killed_at: Callable[[str, int], None], moved: bool
) -> None:
    """Killed after the state of step 4, before its best weights."""
    killed_at("best.pt", 2)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, RISING)
    assert load_checkpoint(tmp_path / "best.pt")["step"] == 2
    if not moved:  # killed a moment earlier
        (tmp_path / COUNTS).replace(Checkpoints(tmp_path).begin_evaluation(4) / COUNTS)
    loaded = Checkpoints(tmp_path).load()
    assert loaded is not None
    assert loaded[1].best_step == 4
    agree(tmp_path, loaded[1])
    agree(tmp_path, run(tmp_path, {6: 0.3}))


@pytest.mark.parametrize("name", ["last.pt", "best.pt"])
@pytest.mark.parametrize("how", ["damaged", "missing", "of another step"])
def test_damaged_checkpoints_are_refused(tmp_path: Path, name: str, how: str) -> None:
    run(tmp_path, RISING)
    path = tmp_path / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    if how == "missing":
        path.unlink()
    elif how == "of another step":
        save(path, {"model": {}, "step": 3})
    if (name, how) == ("last.pt", "missing"):
        assert Checkpoints(tmp_path).load() is None, "the run begins anew"
        return
    with pytest.raises(RunError, match="; remove .* and rerun"):
        Checkpoints(tmp_path).load()


def test_nothing_else_is_kept(tmp_path: Path) -> None:
    state = run(tmp_path, RISING)
    Checkpoints(tmp_path).tidy()
    assert {path.name for path in tmp_path.iterdir()} == {"last.pt", "best.pt", COUNTS}
    agree(tmp_path, state)
    again = run(tmp_path, {})  # a run killed before its result has nothing more to train
    assert again == state


def test_weights_of_another_step_are_refused(tmp_path: Path) -> None:
    run(tmp_path, RISING)
    assert Checkpoints(tmp_path).load_best(4)
    with pytest.raises(
        RunError, match=r"is of step 4, but the best evaluation of this run is of step 2"
    ):
        Checkpoints(tmp_path).load_best(2)
