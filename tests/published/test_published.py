"""Every setting of every recipe has its published value, or a reason for having another one."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from rgbt.config.compose import available, compose, load_choice
from tests.published.recipes import (
    SIDES,
    Row,
    entries,
    flattened,
    missing,
    rows_of,
    sections,
    unpublished,
    words,
)

CONF = Path(__file__).resolve().parents[2] / "conf"
FOLDERS = sorted({path.parent.relative_to(CONF).as_posix() for path in CONF.glob("*/**/*.yaml")})
FILES = {f"{each}/{name}" for each in FOLDERS for name in available(each)} | {"config"}
EXPERIMENTS = sorted(
    path.stem
    for path in (CONF / "experiment").glob("*.yaml")
    if not path.stem.startswith("start_")  # at scale=bench alone, on embedded scenes
)
NOT_OF_A_RECIPE = {
    "commands, evaluations and stores": "corruption debug hydra label_map search tracking",
    "images of this project": "dataset/folder dataset/synth camera/synth transform/none",
    "sizes of scale=demo and scale=bench": "scale/demo scale/bench optimizer/adamw_rtfnet_tiny "
    "optimizer/sgd_thesis_tiny transform/thesis_96x192 transform/thesis_blur_96x192 "
    "transform/heatnet_96x192 transform/semseg_89x89",
    "starts of scale=bench": "experiment/start",
    "scale=real, whose networks and lists are ours": "scale/real dataset/mfnet200 dataset/crack332 "
    "model/mask2former_lite model/cmx_lite model/inputs/lite",
    "networks of other authors": "model/external model/inputs/imagenet_449 model/inputs/unit_three",
    "data sets and losses that no paper here uses": "dataset/fmb dataset/semanticrt dataset/msrs "
    "dataset/cart loss/ohem loss/focal loss/lovasz_softmax",
    "videos, which no paper here has": "dataset/video dataset/mvseg",
}
"""Files without a number of a recipe at scale=paper: the beginnings of their paths, by reason.
Networks whose name ends in "_tiny" are of scale=demo too."""


@cache
def configuration(*overrides: str) -> dict[str, Any]:
    """Keys and values at scale=paper."""
    config = compose((*overrides, "scale=paper", "dataset.root=/data"))
    return dict(flattened(OmegaConf.to_container(config, resolve=True)))  # type: ignore[arg-type]


def pinned(entry: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """The value of each key of an entry by the table."""
    base = entry.split()[0]
    inherited = rows_of(base) if base != entry else {}
    values = {key: row.value(base) for key, row in inherited.items() if key in found}
    return values | {key: row.value(entry) for key, row in rows_of(entry).items()}


def free(entry: str) -> set[str]:
    """The keys of an entry that need no source."""
    base = entry.split()[0]
    groups = (each for each in unpublished() if base in each.experiments or not each.experiments)
    return {key for group in groups for key in group.keys}


def problems_of(entry: str, found: Mapping[str, Any]) -> list[str]:
    """What the table and a configuration disagree about, one sentence each."""
    values, others = pinned(entry, found), free(entry)
    wrong = [
        f"{entry}: {key} is {found[key]!r}, but the table has {value!r}"
        for key, value in values.items()
        if key in found and found[key] != value
    ]
    gone = [f"{entry}: the table has {key}, the configuration does not" for key in values]
    new = [
        f"{entry}: {key}={value!r} has no source. Add it to a section of tests/published, or to a "
        "group of `unpublished` with the reason."
        for key, value in found.items()
        if key not in values and key not in others
    ]
    twice = [f"{entry}: {key} is in a section and in `unpublished`" for key in values]
    return [
        *wrong,
        *(text for text, key in zip(gone, values, strict=True) if key not in found),
        *new,
        *(text for text, key in zip(twice, values, strict=True) if key in others),
    ]


@pytest.mark.parametrize("entry", entries())
def test_every_setting_has_its_published_value(entry: str) -> None:
    problems = problems_of(entry, configuration(*words(entry)))
    assert not problems, "\n" + "\n".join(problems)


def test_every_experiment_is_in_the_table() -> None:
    listed = {name for name in entries() if " " not in name}
    assert not set(EXPERIMENTS) - listed, (
        "add these experiments to the lists of tests/published that have the experiment that they "
        "build on, and a row for each key in which they differ"
    )
    assert not listed - set(EXPERIMENTS), "conf/experiment has no such file any more"


def test_every_experiment_has_a_line_about_what_is_missing() -> None:
    lines = missing()
    assert not set(EXPERIMENTS) - set(lines), "add a line to tests/published/missing.yaml"
    assert not set(lines) - set(EXPERIMENTS), "conf/experiment has no such file any more"
    assert all(20 < len(text) < 400 and text.endswith(".") for text in lines.values())


# ---- mutations ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("entry", "change"),
    [
        ("crm", "scheme.nonlocal_weight=0.5"),
        ("crm_kp", "scheme.modality_weight=2.0"),
        ("baseline", "loss.dice_weight=2.0"),
        ("grbm", "loss.no_object_weight=1.0"),
        ("spatialseg", "loss.spatial.alpha=1.5"),
        ("multi_head_night", "scheme.weight=0.001"),
        ("grbm_released", "masker.ratio=0.4"),
        ("temporal_con", "scheme.view.roll=[-10.0,10.0]"),
        ("cmx model=cmx_b4", "model.depths=[3,4,18,3]"),
        ("crm masker=square", "masker.ratio=0.25"),
        ("sh_source", "dataset.crop=[5,645,320,1600]"),
    ],
)
def test_a_changed_value_is_named(entry: str, change: str) -> None:
    (problem,) = problems_of(entry, configuration(*words(entry), change))
    key, _, _ = change.partition("=")
    assert problem.startswith(f"{entry}: {key} is ")


def test_a_number_without_source_is_named() -> None:
    found = configuration(*words("crm"))
    (problem,) = problems_of("crm", {**found, "scheme.warm_weight": 0.5})
    assert problem.startswith("crm: scheme.warm_weight=0.5 has no source.")


def test_a_key_that_is_no_more_is_named() -> None:
    found = dict(configuration(*words("crm")))
    del found["scheme.nonlocal_weight"]
    (problem,) = problems_of("crm", found)
    assert "the table has scheme.nonlocal_weight, the configuration does not" in problem


# ---- the table itself -----------------------------------------------------------------------


def all_rows() -> list[Row]:
    return [row for section in sections() for row in section.rows]


def test_every_value_has_a_place_or_a_reason() -> None:
    for row in all_rows():
        assert row.used, f"{row.key}: for no experiment"
        for name in SIDES:
            if side := row.sides.get(name):
                assert side.place.strip(), f"{row.key}: {name} says no place"


def test_no_number_is_read_as_text() -> None:
    """YAML takes 1e-4 for a word: a number needs a point."""
    texts = [value for row in all_rows() for side in row.sides.values() for value in [side.value]]
    assert not [
        text for text in texts if isinstance(text, str) and re.fullmatch(r"[\d.e+-]+", text)
    ]


def test_group_without_source_has_only_keys_of_experiments() -> None:
    known = {key for name in EXPERIMENTS for key in configuration(*words(name))}
    stale = {key for group in unpublished() for key in group.keys} - known
    assert not stale
    listed = {name for group in unpublished() for name in group.experiments}
    assert listed <= set(EXPERIMENTS)


# ---- other scales ---------------------------------------------------------------------------

SMALL = {
    "optimizer.lr": 1e-3,
    "optimizer.backbone_multiplier": 1.0,
    "trainer.max_steps": 240,
    "trainer.eval_every": 120,
    "trainer.clip_norm": 1.0,
    "data.batch_size": 4,
    "scale.crop_hw": [120, 160],
    "scale.train_sizes": [120, 132, 144, 156, 168, 180],
    "scale.num_points": 1024,
    "scale.warmup_steps": 20,
    "scale.critic_width": 16,
    "scale.critic_lr": 1e-3,
}
# As the runs of the archive have them; those of scale=demo as its tutorials do.
OTHER_SCALES: dict[str, dict[str, Any]] = {
    "bench crm": SMALL | {"schedule.power": 0.9},
    "bench rtfnet": SMALL | {"optimizer.lr": 5e-3, "trainer.max_steps": 480},
    "bench sh_adversarial": SMALL
    | {"optimizer.lr": 0.05, "trainer.max_steps": 160, "scheme.critic_optimizer.lr": 1e-3},
    "bench heatnet": SMALL | {"trainer.max_steps": 300, "scheme.critic_optimizer.lr": 1e-3},
    "demo crm": SMALL | {"optimizer.lr": 2e-3},
}


@pytest.mark.parametrize("entry", OTHER_SCALES)
def test_other_scales_have_the_rates_of_archived_runs(entry: str) -> None:
    scale, experiment = entry.split()
    config = compose((f"+experiment={experiment}", f"scale={scale}"))
    found = dict(flattened(OmegaConf.to_container(config, resolve=True)))  # type: ignore[arg-type]
    expected = OTHER_SCALES[entry]
    assert {key: found[key] for key in expected} == expected


# ---- files ----------------------------------------------------------------------------------


def chosen_files(file: str) -> set[str]:
    """A file of conf/ and those that its defaults choose at scale=paper, without ".yaml"."""
    folder, found = file.rpartition("/")[0], {file}
    for entry in load_choice(file).get("defaults", []):
        pairs = entry.items() if isinstance(entry, dict) else [("", entry)]
        for group, name in pairs:
            target = "/".join(filter(None, [_group(group), _at_paper_scale(name)]))
            if not target.startswith("/"):
                target = f"{folder}/{target}"
            if target.strip("/") in FILES:
                found |= chosen_files(target.strip("/"))
    return found


def _group(text: str) -> str:
    return text.removeprefix("override ").partition("@")[0]


def _at_paper_scale(name: str) -> str:
    by_scale = re.search(r"paper:([^,}]+)", name)
    return by_scale[1] if by_scale else name


def test_files_with_numbers_of_recipes_are_in_the_table() -> None:
    reached = chosen_files("config") | chosen_files("scale/paper")
    for entry in entries():
        for word in words(entry):
            target = word.removeprefix("+").replace("=", "/")
            if target in FILES:
                reached |= chosen_files(target)
    exempt = tuple(each for text in NOT_OF_A_RECIPE.values() for each in text.split())
    left = {each for each in FILES - reached if not each.startswith(exempt)}
    assert {each for each in left if not each.endswith("_tiny")} == set(), (
        "no experiment of tests/published chooses these files: add one with the override, such as "
        "'crm masker=square', or name the file in NOT_OF_A_RECIPE"
    )


def test_the_files_of_a_composition_are_followed() -> None:
    found = chosen_files("experiment/temporal_con_released")
    assert {"experiment/cmx", "model/cmx_b2", "model/inputs/cmx", "view/released"} <= found
    assert not {"model/cmx_tiny", "masker/square"} & found
