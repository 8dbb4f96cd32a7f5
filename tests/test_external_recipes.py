"""Recipes of published networks: every file composes, and states what its readers need."""

from __future__ import annotations

import inspect
import re

import pytest
import yaml
from omegaconf import DictConfig

from rgbt.config.component import Component
from rgbt.config.compose import available, compose, conf_dir, load_choice
from rgbt.config.stored_config import EXTERNAL
from rgbt.files.adapters import adapter_of
from rgbt.models.external.network import ExternalNetwork

FOLDER = conf_dir() / "model" / "external"
RECIPES = sorted(path.stem for path in FOLDER.glob("*.yaml"))
CHANNELS = {"rtfdnet": 3, "frequency_guided": 1}
"""Of thermal, where a stacked tensor has not four channels, or both images apart not three each."""


def test_recipes_are_choices_of_the_group() -> None:
    assert available("model/external") == RECIPES
    assert "external" in available("model")
    assert len(RECIPES) == 31


@pytest.fixture(scope="module")
def nodes() -> DictConfig:
    """All recipes, composed at once: each in a package of its own name."""
    chosen = [f"+model@{name}=external/{name}" for name in RECIPES]
    config = compose([*chosen, "model=external", "model.checkout=/code"])
    for name in RECIPES:
        config[name].checkout = "/code"
    return config


@pytest.mark.parametrize("classes", [9, 5])
def test_recipe_has_the_classes_of_the_data_set(nodes: DictConfig, classes: int) -> None:
    nodes.dataset.num_classes = classes
    for name in RECIPES:
        component = Component.from_node(nodes[name])
        assert component.target == EXTERNAL
        values = component.values
        assert values["num_classes"] == classes
        spaces = [values["arguments"], *values["namespaces"].values()]
        counts = [each[key] for each in spaces for key in each if re.match(r"n(um)?_class", key)]
        assert counts == [classes], f"{name}: exactly one argument has the number of classes"
        adapter = adapter_of(values["constructor"])
        pattern = r"[\w.]+:\w+" if adapter is None else rf"adapters(_2026)?\.py:{name}"
        assert re.fullmatch(pattern, values["constructor"])
        assert set(values) == set(inspect.signature(ExternalNetwork).parameters)
        channels = len(nodes[name].inputs.thermal_mean)
        assert channels == CHANNELS.get(name, 1 if nodes[name].feed == "stacked" else 3), name


@pytest.mark.parametrize("name", RECIPES)
def test_recipe_has_keys_that_differ_and_states_its_source(name: str) -> None:
    defaults = yaml.safe_load((FOLDER.parent / "external.yaml").read_text())
    text = (FOLDER / f"{name}.yaml").read_text()
    own = yaml.safe_load(text)
    assert {key for key in own if defaults.get(key) == own[key]} <= {"feed"}
    head = " ".join(line[2:] for line in text.splitlines() if line.startswith("# "))
    assert re.search(r"Repository: [\w.-]+/[\w.-]+ ", head)
    assert re.search(r"Commit: [0-9a-f]{8} \(20\d\d-\d\d-\d\d\)\. Licence: ", head)
    assert re.search(r"Licence: .*?\. Lists: (trained on|not checked)", head)
    assert re.search(r"[\d,]{9,} parameters at (nine|five) classes", head)


@pytest.mark.parametrize(
    ("name", "mean", "deviation"),
    [
        ("imagenet_449", 0.449, 0.226),
        ("imagenet_449_dformer", 0.48, 0.28),
        ("unit_three", 0.0, 1.0),
    ],
)
def test_inputs_have_the_constants_of_the_releases(
    name: str, mean: float, deviation: float
) -> None:
    """Of thermal as the code of EGFNet and DFormer states them, of RGB those of ImageNet."""
    node = load_choice(f"model/inputs/{name}")
    assert node["thermal_mean"] == pytest.approx([255 * mean] * 3)
    assert node["thermal_std"] == pytest.approx([255 * deviation] * 3)
    if name == "imagenet_449":
        assert node["rgb_mean"] == pytest.approx([255 * share for share in (0.485, 0.456, 0.406)])
        assert node["rgb_std"] == pytest.approx([255 * share for share in (0.229, 0.224, 0.225)])
