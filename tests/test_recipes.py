"""Sizes and steps by data set: the released numbers, and the warnings for other data sets."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.build.training_setup import _report_unpublished_settings
from rgbt.config.compose import compose, conf_dir
from rgbt.data import kp, pst900
from rgbt.metrics.counts import Counts
from rgbt.requirements import Record
from rgbt.run import main
from tests.commands import SMALL, Call, only_run, short
from tests.test_run import ELSEWHERE

FOLDER = conf_dir() / "recipe"


def recipe(name: str) -> Any:
    """A file of the group, merged with those that it builds on."""
    node = OmegaConf.load(FOLDER / f"{name}.yaml")
    assert isinstance(node, DictConfig)
    below = [each for each in node.pop("defaults", []) if each != "_self_"]
    return OmegaConf.merge(*(recipe(each) for each in below), node)


@pytest.mark.parametrize(
    ("name", "height", "images", "crop"),
    [
        ("mfnet", 480, 1568, [240, 320]),
        ("pst900", 720, 597, [224, 320]),
        ("kp", 512, 499, [256, 320]),
    ],
)
def test_sizes_are_those_of_the_crm_release(
    name: str, height: int, images: int, crop: list[int]
) -> None:
    found = recipe(name)
    assert found.dataset == name
    assert list(found.train_sizes) == [int(k * 0.1 * height) for k in range(5, 21)]
    assert list(found.crop_hw) == crop
    assert (found.batch_size, found.max_steps) == (14 if name == "mfnet" else 12, 35000)
    assert found.eval_every == 5 * (images // found.batch_size)
    assert (found.lr, found.backbone_multiplier, found.clip_norm) == (1e-4, 0.1, 0.01)


def test_spatialseg_recipe_differs_only_on_mfnet() -> None:
    ours, theirs = recipe("mfnet_spatialseg"), recipe("mfnet")
    differ = {key for key in theirs if ours[key] != theirs[key]}
    assert differ == {"batch_size", "max_steps", "eval_every"}
    assert (ours.batch_size, ours.max_steps, ours.eval_every) == (5, 70000, 5 * (1568 // 5))


def test_every_recipe_holds_the_crop_of_the_demo_in_images_of_its_data_set() -> None:
    shapes = {"mfnet": (480, 640), "pst900": (720, 1280), "kp": (512, 640)}
    for path in FOLDER.glob("*.yaml"):
        found = recipe(path.stem)
        height, width = shapes[found.dataset]
        assert min(found.demo_sizes) >= 120
        assert min(found.demo_sizes) * width // height >= 160, path.stem


def test_an_experiment_on_another_data_set_takes_its_recipe() -> None:
    found = compose(["+experiment=grbm_pst900", "scale=paper", "dataset.root=unused"])
    assert found.recipe.dataset == found.dataset.name == "pst900"
    assert (found.data.batch_size, found.trainer.max_steps, found.trainer.eval_every) == (
        *(12, 35000, 245),
    )
    assert list(found.transform.crop_hw) == [224, 320]
    assert found.transform.sizes[-1] == 1440
    assert (found.transform.max_size, found.masker.patch_size) == (1920, 32)
    found = compose(["+experiment=spatialseg_kp", "scale=paper", "dataset.root=unused"])
    assert found.recipe.dataset == found.dataset.name == "kp"
    assert (found.data.batch_size, found.masker.patch_size) == (12, 64)
    assert found.loss.spatial.alpha == 2.0


def test_a_recipe_is_chosen_against_that_of_an_experiment() -> None:
    found = compose(
        ["+experiment=grbm", "scale=paper", "dataset=kp", "recipe=kp", "dataset.root=unused"]
    )
    assert (found.data.batch_size, found.trainer.max_steps) == (12, 35000)
    found = compose(["+experiment=crm_kp", "recipe.demo_steps=3"])
    assert list(found.transform.sizes) == [128, 140, 152, 164, 176, 188]
    assert found.trainer.max_steps == 3


QUICK = ("crm_pst900", "spatialseg_kp")
"""Of the six; the others are like them."""


@pytest.mark.parametrize(
    "experiment",
    [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in ELSEWHERE],
)
def test_an_experiment_on_another_data_set_trains_and_counts(
    call: Call, tmp_path: Path, experiment: str
) -> None:
    splits = ("dataset.num_train=3", "dataset.num_val=3", "dataset.num_test=3")
    place = (f"dataset.cache_dir={tmp_path / 'cache'}", f"runs_dir={tmp_path / 'runs'}")
    size = ("dataset.height=48", "dataset.width=64", "tracking=none")
    code, out, err = call(
        main, f"+experiment={experiment}", *splits, *size, *place, *SMALL, *short(1)
    )
    assert code == 0, err
    counts = Counts.load(only_run(tmp_path / "runs") / "counts_test.npz")
    assert counts.classes == (kp if experiment.endswith("kp") else pst900).CLASSES
    assert (counts.night is None) == experiment.endswith("pst900")
    # Void of KP does not count.
    assert (counts.counts.sum() < 3 * 48 * 64) == experiment.endswith("kp")
    assert counts.classes[-1] in out


# ---- warnings -------------------------------------------------------------------------------

PUBLISHED = {
    **{"recipe": "mfnet", "data": "mfnet", "scale": "paper", "val": ("a",), "picked": "val"},
    **{"tested": "best", "weights": "file", "parts": ("backbone",)},
}
"""A run as published, as the remarks look at it."""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, []),
        ({"scale": "demo", "data": "kp", "weights": None}, []),
        ({"weights": None, "parts": ()}, []),
        ({"data": "mine", "recipe": "mine"}, []),
        ({"data": "pst900"}, ["published for mfnet, not", "choose recipe=pst900, or set recipe."]),
        (
            {"data": "mine", "recipe": "kp"},
            ["published for kp, not for mine; set recipe.train_sizes"],
        ),
        (
            {"weights": None},
            ["starts from ImageNet weights, but this run starts from random weights"],
        ),
        ({"val": ("x", "b", "y"), "scale": "demo"}, ["val: 2 of its 3 images are test images"]),
        # Requested by name, as the releases do, or not picked at all.
        ({"val": ("x",), "picked": "test"}, []),
        ({"val": ("x",), "tested": "last"}, []),
    ],
)
def test_settings_that_are_not_the_published_ones_are_reported(
    changes: dict[str, Any], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    run = SimpleNamespace(**PUBLISHED | changes)
    splits = {"train": ("t",), "val": run.val, "test": ("x", "y")}
    session: Any = SimpleNamespace(
        spec=SimpleNamespace(
            scale=SimpleNamespace(name=run.scale, pretrained=run.scale == "paper"),
            recipe=SimpleNamespace(dataset=run.recipe),
        ),
        dataset=SimpleNamespace(name=run.data, names=splits.__getitem__),
        trainer=SimpleNamespace(selection_split=run.picked, tested=run.tested),
        model=SimpleNamespace(record=Record(pretrained_parts=run.parts)),
        weights=run.weights,
    )
    _report_unpublished_settings(session)
    said = capsys.readouterr().err
    assert len(said.splitlines()) == bool(words)
    assert all(word in said for word in words)
