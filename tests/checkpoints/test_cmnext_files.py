"""Files of CMNeXt: containers, sizes, further modalities, MiT of ImageNet, and `inspect`."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt import weights
from rgbt.checkpoints.cmnext import released, released_name
from rgbt.checkpoints.load import load_weights, plan_for
from rgbt.checkpoints.read import read
from rgbt.checkpoints.recognise import recognise
from rgbt.checks import InputError
from tests.checkpoints.files import holds, like, network, saved
from tests.checkpoints.imagenet import mit_file
from tests.commands import Call
from tests.models import golden

MIT_SIZES = {"embed_dims": [16, 32, 64, 96], "depths": [1, 1, 1, 1], "num_heads": [1, 2, 4, 6]}
Tensors = OrderedDict[str, Tensor]


def released_file(yaml: str = "cmnext_tiny") -> Tensors:
    """Every tensor of a network under its released name, with a number of that name."""
    with torch.device("meta"):
        state = golden.network(yaml).state_dict()
    named = released(state)
    assert len(named) == len(state)
    return like(named)


def test_released_names_of_what_is_called_otherwise_here() -> None:
    """Patch embeddings of the thermal stream are numbered from 0; all other names are ours."""
    found = {
        released_name(f"backbone.extra_patch_embed{stage}.{layer}.bias")
        for stage in (1, 4)
        for layer in ("proj", "norm")
    }
    assert found == {
        f"backbone.extra_downsample_layers.{number}.{layer}.bias"
        for number in (0, 3)
        for layer in ("proj.module", "norm.ln_0")
    }
    fuse = "decode_head.linear_fuse"
    assert released_name(f"{fuse}.0.weight") == f"{fuse}.conv.weight"
    assert released_name(f"{fuse}.1.running_var") == f"{fuse}.bn.running_var"
    for same in ("backbone.patch_embed1.proj.bias", "backbone.extra_block1.0.c_nets.0.weight"):
        assert released_name(same) == same


CONTAINERS: dict[str, Callable[[Tensors], Any]] = {
    "bare": lambda state: state,
    "of several devices": lambda state: {f"module.{key}": value for key, value in state.items()},
    "checkpoint": lambda state: {
        **{"epoch": 7, "model_state_dict": state, "optimizer_state_dict": {"state": {}}},
        **{"loss": 0.5, "scheduler_state_dict": {"last_epoch": 7}, "best_miou": 59.9},
    },
}


@pytest.mark.parametrize("container", CONTAINERS)
def test_both_containers_are_loaded_with_and_without_prefix(tmp_path: Path, container: str) -> None:
    model = network("cmnext_tiny")
    path = saved(tmp_path, CONTAINERS[container](released_file()))
    report = load_weights(model, path)
    assert report.facts.title == "CMNeXt checkpoint (9 classes)"
    assert (report.num_set, report.leftover, report.fresh) == (report.num_entries, {}, {})
    for key, value in model.state_dict().items():
        assert holds(value, released_name(key)), key


@pytest.mark.parametrize(
    "size", ["b0", *(pytest.param(each, marks=pytest.mark.slow) for each in ("b1", "b2", "b3")),
             "b4", pytest.param("b5", marks=pytest.mark.slow)],
)  # fmt: skip
def test_the_size_follows_from_the_names(tmp_path: Path, size: str) -> None:
    facts = recognise(read(saved(tmp_path, released_file(f"cmnext_{size}"))))
    assert facts.title == f"CMNeXt checkpoint (MiT-{size.upper()}, 9 classes)"
    assert facts.fits == ((f"model=cmnext_{size}",),)
    assert facts.convention == ("model/inputs=imagenet_unit",)


def test_names_of_the_network_here_are_recognised_too(tmp_path: Path) -> None:
    """A state dict that is saved by hand; CMX has most of its names."""
    model = network("cmnext_tiny")
    report = load_weights(model, saved(tmp_path, like(model.state_dict())))
    assert report.facts.family == "cmnext"
    assert report.num_set == report.num_entries
    assert all(holds(value, key) for key, value in model.state_dict().items())


def test_more_than_two_modalities_are_refused(tmp_path: Path) -> None:
    state = released_file()
    for number in range(4):
        for end in ("weight", "bias"):
            name = f"backbone.extra_downsample_layers.{number}.norm.ln_"
            state[f"{name}1.{end}"] = state[f"{name}0.{end}"]
    path = saved(tmp_path, state)
    assert recognise(read(path)).fits == ()
    model = network("cmnext_tiny")
    before = {key: value.clone() for key, value in model.state_dict().items()}
    with pytest.raises(InputError) as error:
        load_weights(model, path)
    assert str(error.value) == (
        f"{path} is a CMNeXt checkpoint of 3 modalities (9 classes); CMNeXt here has two "
        "modalities, RGB and thermal, so use a file that was trained with two."
    )
    assert all(torch.equal(before[key], value) for key, value in model.state_dict().items())


@pytest.mark.parametrize(
    ("yaml", "said"),
    [
        ("cmx_tiny", "(CMNeXt checkpoint (9 classes)) cannot be loaded into CMX"),
        ("cmnext_tiny", "of another shape or kind"),
    ],
)
def test_a_file_of_another_network_or_size_is_refused(tmp_path: Path, yaml: str, said: str) -> None:
    state = released_file()
    if yaml == "cmnext_tiny":
        state["backbone.extra_block1.0.layer_scale_1"] = torch.ones(3)
    with pytest.raises(InputError) as error:
        load_weights(network(yaml), saved(tmp_path, state))
    assert said in str(error.value)


def imagenet() -> Tensors:
    return mit_file((16, 32, 64, 96), (1, 1, 1, 1))


def test_imagenet_mit_fills_the_rgb_stream_alone(tmp_path: Path) -> None:
    model = network("cmnext_tiny", **MIT_SIZES)
    before = {key: value.clone() for key, value in model.state_dict().items()}
    report = load_weights(model, saved(tmp_path, {"model": imagenet()}))
    rgb = ("backbone.patch_embed", "backbone.block", "backbone.norm")
    for key, value in model.state_dict().items():
        if key.startswith(rgb):
            assert holds(value, key.removeprefix("backbone.")), key
        else:
            assert torch.equal(value, before[key]), key
    assert report.num_set == len(imagenet()) - 2  # its classifier
    assert model.record.pretrained_parts == rgb


def test_imagenet_mit_of_b2_sets_as_many_tensors_as_released(tmp_path: Path) -> None:
    with torch.device("meta"):
        model = golden.network("cmnext_b2")
    contents = read(saved(tmp_path, mit_file((64, 128, 320, 512), (3, 4, 6, 3))))
    _, plan, _ = plan_for(model, contents, ())
    assert plan.fits
    assert len(plan.values) == 332


@pytest.mark.parametrize(
    "name", ["patch_embed1.proj.weight", "block3.0.attn.sr.bias", "norm4.bias"]
)
def test_an_imagenet_file_without_a_tensor_of_the_rgb_stream_is_refused(
    tmp_path: Path, name: str
) -> None:
    tensors = imagenet()
    del tensors[name]
    with pytest.raises(InputError, match="1 entry of the network missing from the file"):
        load_weights(network("cmnext_tiny", **MIT_SIZES), saved(tmp_path, tensors))


def test_inspect_names_the_recipe(tmp_path: Path, call: Call) -> None:
    whole = saved(tmp_path, released_file("cmnext_b0"), name="whole.pth")
    code, out, _ = call(weights.entry, "inspect", str(whole))
    said = " ".join(out.split())
    assert code == 0
    assert "CMNeXt checkpoint (MiT-B0, 9 classes)" in said
    assert "cmnext (with model=cmnext_b0 model.weights=FILE)" in said
    assert "into model=cmnext_b0 model.num_classes=9" in said
    start = saved(tmp_path, mit_file((32, 64, 160, 256), (2, 2, 2, 2)), name="mit_b0.pth")
    code, out, _ = call(weights.entry, "inspect", str(start), "model=cmnext_b0")
    assert code == 0
    assert "cmnext (with model=cmnext_b0 pretrained=FILE)" in " ".join(out.split())
