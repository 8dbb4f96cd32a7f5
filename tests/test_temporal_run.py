"""Training on two frames, end to end: repeated, interrupted, with every network, with bad input."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbt.engine.checkpoint import load_checkpoint
from rgbt.metrics.counts import Counts
from rgbt.transforms.virtual_view import VirtualView
from tests.commands import Call, assert_one_sentence, losses, only_run, short, train

NO_PATCH = "masker.patch_size=null"
TEMPORAL = ("+experiment=temporal_con", NO_PATCH, "consistency=none")


def same_weights(one: Path, two: Path) -> bool:
    first, second = (load_checkpoint(each / "last.pt")["model"] for each in (one, two))
    assert first.keys() == second.keys()
    return all(torch.equal(first[name], second[name]) for name in first)


@pytest.fixture
def run(call: Call, data: Path, tmp_path: Path) -> Any:
    def started(where: str, *overrides: str) -> Path:
        code, _, err = train(call, data, tmp_path / where, *TEMPORAL, *overrides)
        assert code == 0, err
        return only_run(tmp_path / where)

    return started


@pytest.mark.slow
def test_draws_depend_on_the_seed_only(run: Any) -> None:
    """Not the number of workers either."""
    one, helped = run("a", *short(3)), run("b", "scale.num_workers=2", *short(3))
    other = run("c", "seed=1", *short(3))
    assert set(losses(one)[0]) == {
        *("loss", "loss/cross_entropy_1", "loss/cross_entropy_2", "loss/dice_1", "loss/con"),
    }
    assert one.name == helped.name
    assert losses(one) == losses(helped)
    assert same_weights(one, helped)
    assert losses(one) != losses(other)
    assert all(math.isfinite(v) for step in losses(one) for v in step.values())


@pytest.mark.parametrize("experiment", ["temporal_con", "temporal_con_released"])
@pytest.mark.slow
def test_interrupted_and_continued_equals_uninterrupted(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, experiment: str
) -> None:
    overrides = (f"+experiment={experiment}", NO_PATCH, *short(6))
    drawn = 0

    def stopped(self: VirtualView, count: int, generator: torch.Generator) -> torch.Tensor:
        nonlocal drawn
        drawn += 1
        if drawn == 6:
            raise KeyboardInterrupt
        return draw(self, count, generator)

    draw = VirtualView.draw
    with monkeypatch.context() as patch:
        patch.setattr(VirtualView, "draw", stopped)
        code, _, _ = train(call, data, tmp_path / "stopped", *overrides)
    assert code == 130
    (folder,) = (tmp_path / "stopped").iterdir()
    assert not (folder / "result.json").exists()

    code, _, err = train(call, data, tmp_path / "stopped", *overrides)
    assert code == 0, err
    assert "resumes at step 4" in err
    code, _, err = train(call, data, tmp_path / "straight", *overrides)
    assert code == 0, err
    straight = only_run(tmp_path / "straight")
    assert losses(folder) == losses(straight)
    assert same_weights(folder, straight)
    for name in ("counts_test.npz", "evaluations/consistency_aligned_test.npz"):
        mine, theirs = (Counts.load(each / name).counts for each in (folder, straight))
        assert (mine == theirs).all()


def take_a_step(call: Call, data: Path, runs: Path, *overrides: str) -> dict[str, float]:
    code, _, err = train(call, data, runs, NO_PATCH, *overrides, "consistency=none", *short(1))
    assert code == 0, err
    (step,) = losses(only_run(runs))
    assert all(math.isfinite(value) for value in step.values())
    return step


@pytest.mark.slow
@pytest.mark.parametrize(
    "network",
    [
        *("+experiment=cmx", "+experiment=cmnext"),
        *("+experiment=rtfnet", "+experiment=mfnet"),
        *("model=heatnet_tiny", "model=deeplabv2_tiny"),
    ],
)
def test_networks_of_scores_take_a_step(
    call: Call, data: Path, tmp_path: Path, network: str
) -> None:
    words = (network, "transform=flip", "scheme=temporal_paper", "loss=temporal_paper")
    step = take_a_step(call, data, tmp_path, *words)
    assert step["loss"] == pytest.approx(sum(v for name, v in step.items() if name != "loss"))
    assert {"loss/cross_entropy_1", "loss/dice_1", "loss/con"} < set(step)


@pytest.mark.parametrize(
    "second", ["con", *(pytest.param(each, marks=pytest.mark.slow) for each in ("con_acc", "dice"))]
)
def test_a_network_of_masks_takes_a_step(
    call: Call, data: Path, tmp_path: Path, second: str
) -> None:
    words = (
        *("model=mask2former_tiny", "transform=flip", "scheme=temporal_paper"),
        *("loss=temporal_paper", "loss@loss.segmentation=set_criterion", f"loss.second={second}"),
    )
    step = take_a_step(call, data, tmp_path, *words)
    part = "dice_2" if second == "dice" else second
    assert {f"loss/{part}", "loss/dice_1", "loss/seg_dice_1", "loss/class_1"} <= set(step)
    assert all(value > 0 for value in step.values())


ROWS = {
    "B": (("loss.alpha=0", "loss.beta=0", "loss.second=none"), set()),
    "C": (("loss.alpha=0", "loss.second=dice"), {"dice_2"}),
    "D": (("loss.alpha=0",), {"con"}),
    "E": (("loss.alpha=0", "loss.second=con_acc"), {"con_acc"}),
    "F": (("loss.beta=0", "loss.second=none"), {"dice_1"}),
    "G": (("loss.second=dice",), {"dice_1", "dice_2"}),
    "I": (("loss.second=con_acc",), {"dice_1", "con_acc"}),
    "rotation": (("scheme.view.mode=rotation",), {"dice_1", "con"}),
    "translation": (("scheme.view.mode=translation",), {"dice_1", "con"}),
}


@pytest.mark.slow
@pytest.mark.parametrize(("words", "parts"), ROWS.values(), ids=ROWS)
def test_rows_of_the_tables_are_overrides(
    call: Call, data: Path, tmp_path: Path, words: tuple[str, ...], parts: set[str]
) -> None:
    step = take_a_step(call, data, tmp_path, "+experiment=temporal_con_released", *words)
    both = {"cross_entropy_1", "cross_entropy_2"}
    assert set(step) == {"loss", *(f"loss/{part}" for part in parts | both)}


def test_a_size_of_evaluation_that_rounds_is_measured_or_refused(
    call: Call, data: Path, tmp_path: Path
) -> None:
    """50 rows of images of 48x64 are 67 columns, not 66.7."""
    words = ("+experiment=temporal_con", NO_PATCH, "scale.test_short_edge=50", *short(1))
    code, _, err = train(call, data, tmp_path / "runs", *words)
    if code != 0:
        assert_one_sentence(err, "another image size")
        assert not (tmp_path / "runs").exists()
