"""Training on two frames, end to end: repeated, interrupted, with every network, with bad input."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbt.config.compose import compose
from rgbt.engine.checkpoint import load_checkpoint
from rgbt.metrics.counts import Counts
from rgbt.spec.specify import specify
from rgbt.transforms.virtual_view import VirtualView
from tests.commands import SPLITS, Call, assert_one_sentence, only_run, short, train
from tests.conftest import write_data

NO_PATCH = "masker.patch_size=null"
TEMPORAL = ("+experiment=temporal_con", NO_PATCH, "consistency=none")


def losses(folder: Path) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [
        {name: value for name, value in line["values"].items() if "loss" in name}
        for line in lines
        if line["kind"] == "train"
    ]


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
def test_the_seed_alone_decides(run: Any) -> None:
    one, two, other = run("a", *short(2)), run("b", *short(2)), run("c", "seed=1", *short(2))
    assert set(losses(one)[0]) == {
        *("loss", "loss/cross_entropy_1", "loss/cross_entropy_2", "loss/dice_1", "loss/con"),
    }
    assert losses(one) == losses(two)
    assert same_weights(one, two)
    assert losses(one) != losses(other)
    assert all(math.isfinite(v) for step in losses(one) for v in step.values())


@pytest.mark.slow
def test_the_number_of_workers_does_not_count(run: Any) -> None:
    alone, helped = run("a", *short(3)), run("b", "scale.num_workers=2", *short(3))
    assert alone.name == helped.name
    assert losses(alone) == losses(helped)
    assert same_weights(alone, helped)


@pytest.mark.parametrize(
    "experiment",
    ["temporal_con", pytest.param("temporal_con_released", marks=pytest.mark.slow)],
)
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
@pytest.mark.parametrize("network", ["cmx", "rtfnet", "mfnet"])
def test_networks_of_scores_take_a_step(
    call: Call, data: Path, tmp_path: Path, network: str
) -> None:
    extra = ("scheme=temporal_paper", "loss=temporal_paper")
    step = take_a_step(call, data, tmp_path, f"+experiment={network}", *extra)
    assert step["loss"] == pytest.approx(sum(v for name, v in step.items() if name != "loss"))
    assert {"loss/cross_entropy_1", "loss/dice_1", "loss/con"} < set(step)


@pytest.mark.slow
@pytest.mark.parametrize("network", ["heatnet_tiny", "deeplabv2_tiny"])
def test_networks_without_an_experiment_take_a_step(
    call: Call, data: Path, tmp_path: Path, network: str
) -> None:
    words = (f"model={network}", "transform=flip", "scheme=temporal_paper", "loss=temporal_paper")
    assert "loss/con" in take_a_step(call, data, tmp_path, *words)


@pytest.mark.parametrize("second", ["con", "con_acc", "dice"])
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
    "B": ("loss.alpha=0", "loss.beta=0", "loss.second=none"),
    "C": ("loss.alpha=0", "loss.second=dice"),
    "D": ("loss.alpha=0",),
    "E": ("loss.alpha=0", "loss.second=con_acc"),
    "F": ("loss.beta=0", "loss.second=none"),
    "G": ("loss.second=dice",),
    "I": ("loss.second=con_acc",),
    "rotation": ("scheme.view.mode=rotation",),
    "translation": ("scheme.view.mode=translation",),
}
PARTS = {
    "B": set(),
    "C": {"dice_2"},
    "D": {"con"},
    "E": {"con_acc"},
    "F": {"dice_1"},
    "G": {"dice_1", "dice_2"},
    "I": {"dice_1", "con_acc"},
    "rotation": {"dice_1", "con"},
    "translation": {"dice_1", "con"},
}


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("experiment", ["temporal_con", "temporal_con_released"])
def test_rows_of_the_tables_are_overrides(
    call: Call, data: Path, tmp_path: Path, experiment: str, row: str
) -> None:
    step = take_a_step(call, data, tmp_path, f"+experiment={experiment}", *ROWS[row])
    both = {"cross_entropy_1", "cross_entropy_2"}
    assert set(step) == {"loss", *(f"loss/{part}" for part in PARTS[row] | both)}


@pytest.mark.slow
def test_what_is_measured_is_no_part_of_the_key_but_how_it_is_trained_is() -> None:
    def key(*overrides: str) -> str:
        return specify(compose(["+experiment=temporal_con", *overrides])).key

    same = ["consistency=none", "view@consistency.view=paper"]
    assert {key(each) for each in same} == {key()}
    assert (
        specify(compose(["+experiment=cmx", "consistency=views"])).key
        == specify(compose(["+experiment=cmx"])).key
    )
    other = ["scheme.view.camera.fx=500", "scheme.detach=true", "scheme.view.yaw=[-9,10]"]
    assert len({key(each) for each in other} | {key()}) == 4
    assert key("scheme.view.yaw=[-10,10]") == key()  # 10 and 10.0 are one value


REFUSED = {
    "camera of other images": (
        ["scheme.view.camera.height=1024", "scheme.view.camera.width=1280"],
        "intrinsics of another image size",
    ),
    "measured by a camera of other images": (
        ["consistency.view.camera.height=1024", "consistency.view.camera.width=1280"],
        "intrinsics of another image size",
    ),
    "centre outside": (["scheme.view.camera.cx=900"], "intrinsics of another image size"),
    "crop of another shape": (["scale.crop_hw=[48,48]"], "intrinsics of another image size"),
    "no rectangle": (["scheme.view.yaw=[-50,50]"], "leave no valid rectangle"),
    "no rectangle, measured": (["consistency.view.yaw=[-50,50]"], "leave no valid rectangle"),
    "too steep": (
        ["scheme.view.pitch=[-90,0]"],
        "'scheme.view.pitch[0]' must be a number from -60 to 60",
    ),
    "turned round": (["scheme.view.roll=[5,-5]"], "a list of 2 (the smaller one first)"),
    "no such mode": (["scheme.view.mode=rot"], "'scheme.view.mode'"),
    "single frames": (
        ["scheme=supervised"],
        "requires frames=2 of the scheme, Supervised provides frames=1; choose scheme=temporal_p",
    ),
    "loss of single frames": (
        ["loss=cross_entropy"],
        "requires frames=2 of the loss, CrossEntropy provides frames=1; choose loss=temporal_paper",
    ),
    "masks": (["masker=crm", "masker.patch_size=32"], "choose masker=none"),
    "loss of masks": (
        ["loss@loss.segmentation=set_criterion"],
        "TemporalLoss requires outputs=masks of the model, CMX provides outputs=scores; choose ",
    ),
    "beta of nothing": (["loss.second=none"], "set loss.beta=0"),
    "no beta": (["loss.beta=0"], "set loss.second=none"),
    "no such loss": (["loss.second=cone"], "'loss.second'"),
    "set without a list": (["consistency.sets=released_1"], "'consistency.sets'"),
    "no such camera": (["camera@scheme.view.camera=sinth"], "did you mean 'synth'?"),
}


@pytest.mark.parametrize(("asked", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_fit_leaves_no_folder(
    call: Call, data: Path, tmp_path: Path, asked: list[str], sentence: str
) -> None:
    words = ["+experiment=temporal_con"]
    words += [] if "masker=crm" in asked else [NO_PATCH]
    code, _, err = train(call, data, tmp_path / "runs", *words, *asked, *short(1))
    assert code == 2, err
    assert_one_sentence(err, sentence)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "words",
    [
        ("+experiment=temporal_con",),
        ("+experiment=temporal_con", "consistency=none", "transform=none"),
        ("+experiment=cmx", "consistency=views"),
    ],
    ids=["both", "trained", "measured"],
)
def test_images_of_another_shape_leave_no_folder(
    call: Call, tmp_path: Path, words: tuple[str, ...]
) -> None:
    data = write_data(tmp_path / "mf", SPLITS, (48, 48))
    code, _, err = train(call, data, tmp_path / "runs", *words, NO_PATCH, *short(1))
    assert code == 2, err
    assert_one_sentence(err, "intrinsics of another image size")
    assert not (tmp_path / "runs").exists()


def test_the_first_test_image_may_be_unreadable_where_that_is_skipped(
    call: Call, data: Path, tmp_path: Path
) -> None:
    path = data / "images" / f"{SPLITS['test'][0]}.png"
    path.write_bytes(path.read_bytes()[:100])
    words = ("+experiment=temporal_con", NO_PATCH, "data.on_error=skip", *short(1))
    code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    folder = only_run(tmp_path / "runs")
    counts = Counts.load(folder / "evaluations" / "consistency_aligned_test.npz")
    assert counts.names == tuple(SPLITS["test"][1:])
    assert json.loads((folder / "result.json").read_text())["skipped"] == [SPLITS["test"][0]]


def test_broken_angles_leave_no_folder(call: Call, data: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.csv"
    mine.write_text("yaw,pitch,roll\n80,2,3\n")
    words = ("+experiment=temporal_con", NO_PATCH, f"consistency.sets=[{mine}]")
    code, _, err = train(call, data, tmp_path / "runs", *words, *short(1))
    assert code == 2, err
    assert_one_sentence(err, "yaw 80, pitch 2, roll 3 degrees leave no valid rectangle")
    assert not (tmp_path / "runs").exists()


def test_a_size_of_evaluation_that_rounds_is_told_before_anything_is_trained(
    call: Call, data: Path, tmp_path: Path
) -> None:
    """50 rows of images of 48x64 are 67 columns, not 66.7: measured, or refused at the start."""
    words = ("+experiment=temporal_con", NO_PATCH, "scale.test_short_edge=50", *short(1))
    code, _, err = train(call, data, tmp_path / "runs", *words)
    if code != 0:
        assert_one_sentence(err, "another image size")
        assert not (tmp_path / "runs").exists()
