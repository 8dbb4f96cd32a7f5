"""The best weights and the files of their evaluation agree with the state that names them."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from torch import nn

from rgbt.checkpoints.files import save
from rgbt.checks import InputError, RunError
from rgbt.engine.checkpoint import State, load_checkpoint, load_last, restore_weights, settle
from rgbt.files.atomic import write_atomic
from tests.engine.test_trainer import batches, make

COUNTS = "counts_val.npz"
RISING = {2: 0.4, 4: 0.5, 6: 0.3}


def run(folder: Path, scores: dict[int, float]) -> State:
    """Train or resume; evaluations have these scores, and leave a file beside their weights."""
    trainer, _ = make(folder, eval_every=2, checkpoint_minutes=0)
    latest: list[str] = []

    def evaluate(step: int, _: nn.Module) -> float:
        latest.append(f"step {step}: {scores[step]}")
        return scores[step]

    def keep() -> Callable[[Path], None]:
        found = latest[-1].encode()
        return lambda coming: write_atomic(coming / COUNTS, found)

    trainer.hooks.evaluate = evaluate
    trainer.hooks.keep = keep
    state = State(seed=0)
    trainer.resume(state)
    trainer.fit(batches(state.step), state)
    return state


def agree(folder: Path, state: State) -> None:
    """State, best weights and counts are of one evaluation."""
    assert load_checkpoint(folder / "best.pt")["step"] == state.best_step
    assert (folder / COUNTS).read_text() == f"step {state.best_step}: {state.best_score}"


def test_killed_at_every_rename_resumes_with_files_of_one_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Evaluations that are repeated score less, as on a device whose sums have another order."""
    renamed: list[str] = []
    rename = os.replace

    def dying(source: Any, target: Any) -> None:
        if len(renamed) == last:
            raise KeyboardInterrupt
        renamed.append(Path(target).relative_to(folder).as_posix())
        rename(source, target)

    monkeypatch.setattr(os, "replace", dying)
    for number in count():
        last, folder = number, tmp_path / str(number)
        renamed.clear()
        try:
            run(folder, RISING)
            break
        except KeyboardInterrupt:
            last = 1000
        step = 0
        if (folder / "last.pt").exists():
            _, state = load_last(folder)
            step = state.step
            if state.best_step:
                agree(folder, state)
        state = run(folder, {2: 0.3, 4: 0.1, 6: 0.2})
        assert state.best_step == (4 if step >= 4 else 2)
        agree(folder, state)
        assert {path.name for path in folder.iterdir()} == {"last.pt", "best.pt", COUNTS}
    assert renamed[7:10] == [f"next_4/{COUNTS}", "next_4/best.pt", "last.pt"]
    assert sorted(renamed[10:12]) == ["best.pt", COUNTS]


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


@pytest.mark.parametrize("place", ["next_3", "next_3/figures"])
def test_nothing_outside_of_the_run_folder_is_moved_or_removed(tmp_path: Path, place: str) -> None:
    outside, folder = tmp_path / "mine", tmp_path / "run"
    outside.mkdir()
    (outside / "notes.txt").write_text("mine")
    (folder / place).parent.mkdir(parents=True)
    (folder / place).symlink_to(outside)
    for best_step in (3, 4):  # to be named, and to be removed
        with pytest.raises(InputError, match="a link that leads out of"):
            settle(folder, best_step)
        assert (outside / "notes.txt").read_text() == "mine"
