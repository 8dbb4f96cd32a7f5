"""Every file composes, the schema is the constructor, and the key names what matters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError
from rgbt.config.component import Component, build
from rgbt.config.compose import conf_dir, flatten
from rgbt.spec.run_spec import NODES
from rgbt.spec.specify import specify
from tests.models.golden import alone, compose


@dataclass(frozen=True, kw_only=True)
class Knob:
    size: tuple[int, int]
    kind: Literal["a", "b"]
    inner: Knob | None = None
    model: object = None


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (conf_dir() / group).glob("*.yaml"))


@pytest.fixture(scope="module")
def default() -> DictConfig:
    """The whole configuration, of which one node at a time is exchanged."""
    return compose()


@pytest.mark.parametrize(
    ("group", "option"), [(g, o) for g in NODES if (conf_dir() / g).is_dir() for o in options(g)]
)
def test_every_option_of_every_group_passes_the_check(
    group: str, option: str, default: DictConfig
) -> None:
    if group == "scale":  # sets nodes of all groups
        spec = specify(compose(f"scale={option}", "dataset.root=unused", "dataset=mfnet"))
        assert spec.plain["scale"]["name"] == option
        return
    made = option.startswith("synth")
    needed = {} if group != "dataset" or made else {"root": "unused"}
    if option == "folder":
        needed |= {"num_classes": 2, "classes": "[a,b]", "rgb": "a", "thermal": "b", "label": "c"}
    words = [f"dataset.{key}={needed[key]}" for key in needed]
    if option == "external":
        words = ["model.checkout=unused", "model.constructor=a:B"]
    chosen = alone(f"{group}/{option}", *words)
    usual = default[group]
    try:
        default[group] = chosen[group]
        component = Component.from_node(default[group], group)
    finally:
        default[group] = usual
    assert component.target == component.plain["_target_"] == chosen[group]["_target_"]


def test_paper_scale_is_the_released_recipe() -> None:
    config = compose("+experiment=grbm_released", "scale=paper", "dataset.root=unused")
    assert (config.data.batch_size, config.trainer.max_steps) == (5, 70000)
    assert list(config.transform.sizes) == [int(0.1 * k * 480) for k in range(5, 21)]
    assert (config.optimizer.lr, config.optimizer.backbone_multiplier) == (1e-4, 0.1)
    assert (config.trainer.clip_norm, config.optimizer.weight_decay) == (0.01, 0.05)
    assert (config.masker.patch_size, config.loss.num_points) == (64, 112 * 112)
    assert compose("+experiment=crm", "scale=paper").masker.patch_size == 32
    assert compose("+experiment=grbm", "scale=demo").masker.patch_size == 32


def test_recipes_of_the_reference_networks() -> None:
    """Numbers of the temporal release (CMX), and of the RTFNet and MFNet releases."""
    cmx, rtfnet, mfnet = (
        compose(f"+experiment={name}", "scale=paper", "dataset.root=unused")
        for name in ("cmx", "rtfnet", "mfnet")
    )
    adamw = cmx.optimizer
    assert (adamw.lr, adamw.weight_decay, adamw.decay_biases) == (6e-5, 0.01, False)
    assert (adamw.backbone_multiplier, cmx.trainer.clip_norm) == (1.0, None)
    assert (cmx.trainer.max_steps, cmx.schedule.warmup_steps) == (200 * 1568, 10 * 1568)
    assert (cmx.schedule.power, cmx.schedule.per) == (0.9, "iteration")
    for config in (rtfnet, mfnet):
        sgd = config.optimizer
        assert (sgd.lr, sgd.momentum, sgd.weight_decay) == (0.01, 0.9, 5e-4)
        assert (config.schedule.factor, config.trainer.clip_norm) == (0.95, None)
    epochs = (rtfnet.schedule.epoch_steps, mfnet.trainer.max_steps)
    assert epochs == (1568 // 3 + 1, 100 * (784 // 8))
    assert (cmx.model.inputs.thermal_scale, cmx.model.drop_path_stage2) == (
        *("image_max", "released"),
    )
    batch_sizes = [config.data.batch_size for config in (cmx, rtfnet, mfnet)]
    assert batch_sizes == [1, 3, 8]
    for config in (cmx, rtfnet, mfnet):
        assert list(config.transform.crop_hw) == [480, 640]
        assert (config.transform.flip_probability, config.transform.colour_probability) == (0.5, 0)
    assert [config.model._target_.split(".")[2] for config in (cmx, rtfnet, mfnet)] == [
        *("cmx", "rtfnet", "mfnet")
    ]


PUBLISHED: list[tuple[str, dict[str, Any]]] = [
    ("cmx_b2", {"drop_path_rate": 0.1, "decoder_dropout": 0.1, "decoder_norm_eps": 1e-3}),
    ("cmx_b2", {"drop_path_stage2": "ramp", "decoder_norm_eps_eval": None}),
    ("heatnet", {"dropout": [0.3, 0.15], "align_corners": False}),
    ("deeplabv2_two_heads_modified", {"dropout": [0.3, 0.15], "align_corners": False}),
    *((f"mask2former_swin_{size}", {"drop_path_rate": 0.3}) for size in "tsb"),
    *((f"rtfnet_{n}", {"final_relu": True, "thermal_stem": "rgb_mean"}) for n in (18, 50, 152)),
    ("mfnet", {"final_activation": True}),
    *(
        (name, {"ceil_mode": True, "align_corners": True})
        for name in ("deeplabv2", "deeplabv2_tiny")
    ),
]
"""Values that neither parameter counts nor recorded outputs in evaluation mode would show."""


@pytest.mark.parametrize(("name", "settings"), PUBLISHED)
def test_published_settings_of_the_networks(name: str, settings: dict[str, Any]) -> None:
    model = alone(f"model/{name}").model
    assert {key: model[key] for key in settings} == settings
    if "ceil_mode" in settings:
        assert model.summed_rates == model.rates


def test_the_key_leaves_out_paths_hardware_and_tracking() -> None:
    same = [
        *("dataset.root=/a", "runs_dir=/b", "tracking=none", "data.num_workers=3"),
        *(
            "trainer.accelerator=cpu",
            "fresh=true",
            "trainer.threads=2",
            "name=other",
            "data.eval_batch_size=1",
        ),
    ]
    base = ["+experiment=grbm", "dataset=mfnet", "dataset.root=/elsewhere"]
    key = specify(compose(*base)).key
    assert specify(compose(*base, *same)).key == key
    # The file says 4.0; a user types 4.
    assert specify(compose(*base, "masker.sigma_div=4")).key == key
    for change in (
        "seed=1",
        "masker.sigma_div=2",
        "dataset.name=mine",
        "trainer.max_steps=7",
        "trainer.threads=1",
    ):
        assert specify(compose(*base, change)).key != key, change


def test_a_node_is_built_with_converted_values_and_offered_objects() -> None:
    inner = {"_target_": f"{__name__}.Knob", "size": [3, 4], "kind": "b"}
    node = OmegaConf.create({"knob": {**inner, "kind": "a", "inner": inner}}).knob
    offered = object()
    knob = build(node, model=offered, unused=1)
    assert (knob.size, knob.kind, knob.model) == ((3, 4), "a", offered)
    assert (knob.inner.size, knob.inner.kind, knob.inner.model) == ((3, 4), "b", None)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"size": [1]}, r"'knob.size' must be a list of 2, each a whole number, got \[1\]"),
        ({"size": [1, 2.5]}, r"'knob.size\[1\]' must be a whole number, got"),
        ({"size": [1, True]}, r"'knob.size\[1\]' must be a whole number, got"),
        ({"kind": "c"}, "'knob.kind' must be 'a' or 'b', got \"c\""),
        ({"kin": "a"}, "'knob.kin' is not a setting of .*did you mean 'kind'"),
        ({"kind": "???"}, "'knob.kind' has no value"),
        ({"kind": "${nowhere}"}, "'knob.kind' cannot be resolved"),
        ({"_target_": "no.such.Thing"}, "'knob._target_': cannot import no.such.Thing"),
    ],
)
def test_wrong_values_are_named_with_their_key(change: dict, sentence: str) -> None:
    good = {"_target_": f"{__name__}.Knob", "size": [1, 2], "kind": "a"}
    with pytest.raises(InputError, match=sentence):
        Component.from_node(OmegaConf.create({"knob": {**good, **change}}).knob, "knob")


def test_a_missing_value_is_named_when_the_object_is_built() -> None:
    node = OmegaConf.create({"knob": {"_target_": f"{__name__}.Knob", "kind": "a"}}).knob
    with pytest.raises(InputError, match="'knob.size' has no value"):
        build(node)


def test_flatten_gives_dotted_keys() -> None:
    config = OmegaConf.create({"a": {"b": 1, "c": [1, 2]}, "d": "${a.b}"})
    assert flatten(config) == {"a.b": 1, "a.c": [1, 2], "d": 1}


def test_paths_are_read_as_they_are_typed() -> None:
    from rgbt.config.command import readable_paths

    typed = ["model.weights=a/epoch=299 (best).ckpt", "dataset.root=~/MF", "model.weights=a,b"]
    first, root, grid = readable_paths([*typed, "masker.sigma_div=1,2", "-m"])[:3]
    assert compose(first).model.weights == "a/epoch=299 (best).ckpt"
    assert root == f"dataset.root={Path.home()}/MF"
    assert grid == "model.weights=a,b"
    assert readable_paths(["-m", "masker.sigma_div=1,2"]) == ["-m", "masker.sigma_div=1,2"]
