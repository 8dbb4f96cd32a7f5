"""Loading is complete or does not happen: what lacks, what is too much, what differs."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checkpoints.load import load_weights
from rgbt.checks import InputError
from rgbt.models.cmx.model import CMX
from tests.checkpoints.files import holds, like, named, network, saved, sentence
from tests.checkpoints.imagenet import mit_file, resnet_file, swin_file

MIT_SIZES = {"embed_dims": [16, 32, 64, 96], "depths": [1, 1, 1, 1], "num_heads": [1, 2, 4, 6]}
SWIN_SIZES = {"embed_dim": 32, "depths": [1, 1, 2, 1], "num_heads": [1, 2, 4, 8], "window_size": 5}

Tensors = OrderedDict[str, Tensor]
X = torch.zeros(1)


def own_names(prefix: str = "") -> Callable[[nn.Module], Tensors]:
    return lambda model: like(model.state_dict(), prefix)


CASES: dict[str, tuple[str, dict[str, Any], Callable[[nn.Module], Tensors], str]] = {
    # layout: network, its sizes, tensors of the file, one name of it that matters
    "crm": (
        "mask2former_tiny",
        {},
        own_names("network."),
        "network.sem_seg_head.predictor.query_feat.weight",
    ),
    "cmx": ("cmx_tiny", {}, own_names(), "decode_head.linear_fuse.0.weight"),
    "temporal": (
        "cmx_tiny",
        {},
        lambda model: OrderedDict(
            like(model.state_dict()),
            **named({"voting.weight": (9, 18, 3, 3), "voting.bias": (9,)}),
        ),
        "backbone.extra_norm4.bias",
    ),
    "rtfnet": ("rtfnet_tiny", {}, own_names(), "deconv1.0.conv1.weight"),
    "mfnet": ("mfnet_tiny", {}, own_names(), "decode4.conv.weight"),
    "heatnet": (
        "heatnet_tiny",
        {},
        own_names("module.trgb_segnet."),
        "module.trgb_segnet.psp.bottleneck.weight",
    ),
    "swin": (
        "mask2former_tiny",
        SWIN_SIZES,
        lambda _: swin_file(32, (1, 1, 2, 1), (1, 2, 4, 8), 5, labels=10),
        "layers.2.blocks.1.norm2.bias",
    ),
    "mit": (
        "cmx_tiny",
        MIT_SIZES,
        lambda _: mit_file((16, 32, 64, 96), (1, 1, 1, 1)),
        "block2.0.mlp.dwconv.dwconv.weight",
    ),
    "resnet": (
        "rtfnet_18",
        {"base_width": 4},
        lambda _: resnet_file(18, width=4),
        "layer3.1.bn2.running_var",
    ),
}


def refused(model: nn.Module, path: Path, fresh: tuple[str, ...] = ()) -> str:
    """The sentence of a refusal, after which the network is as it was."""
    before = {key: value.clone() for key, value in model.state_dict().items()}
    with pytest.raises(InputError) as error:
        load_weights(model, path, fresh)
    assert all(torch.equal(before[key], value) for key, value in model.state_dict().items())
    assert str(path) in sentence(error) or "model.fresh" in sentence(error)
    return sentence(error)


@pytest.mark.parametrize("layout", CASES)
def test_incomplete_and_altered_files(tmp_path: Path, layout: str) -> None:
    """The file as it should be is loaded; every way of spoiling it gets a sentence of its own."""
    yaml, sizes, tensors_of, name = CASES[layout]
    model = network(yaml, **sizes)
    tensors = tensors_of(model)
    report = load_weights(model, saved(tmp_path, tensors))
    assert report.num_set + report.num_zeros + sum(report.fresh.values()) == report.num_entries
    assert "\n" not in report.sentence()
    less = OrderedDict((key, value) for key, value in tensors.items() if key != name)
    spoiled = {
        "of the network missing from the file": less,
        "1 entry of the file unknown to the network": tensors | {f"{name.split('.')[0]}.extra": X},
        "file 3 x 5 x 7, network ": tensors | {name: torch.zeros(3, 5, 7)},
        "file int64, network float32": tensors | {name: tensors[name].long()},
    }
    for said, content in spoiled.items():
        text = refused(model, saved(tmp_path, OrderedDict(content)))
        assert said in text
        assert name.split(".")[-2] in text or "extra" in text


def cmx_file() -> Tensors:
    return like(network("cmx_b0").state_dict())


def windows_of(side: int) -> Tensors:
    return swin_file(32, (1, 1, 2, 1), (1, 2, 4, 8), side, labels=21841)


REFUSED: list[tuple[str, Callable[[], Any], tuple[str, ...], str]] = [
    # network, content of the file, parts that are fresh, message
    (
        "mask2former_tiny",
        cmx_file,
        (),
        "cannot be loaded into RGB-T Mask2Former; it fits model=cmx_b0",
    ),
    (
        *("rtfnet_tiny", lambda: resnet_file(101, prefix="Scale.", counters=False), ()),
        "it fits model=deeplabv2 model/inputs=caffe",
    ),
    ("rtfnet_tiny", lambda: {"w": X}, (), "in an unknown layout"),
    (
        *("cmx_tiny", lambda: mit_file((32, 64, 160, 256), (2, 2, 2, 2)), ()),
        ". The file fits model=cmx_b0.",
    ),
    ("mask2former_tiny", lambda: windows_of(7), (), "windows of 7 x 7 tokens"),
    ("mask2former_tiny", lambda: windows_of(12), (), "windows of 12 x 12 tokens"),
    (
        *("mfnet_tiny", lambda: {"model": network("cmx_tiny").state_dict(), "step": 240}, ()),
        "CMX (9 classes)) cannot be loaded into MFNet",
    ),
    ("mfnet_tiny", lambda: {"a": X}, ("decod1",), "no part 'decod1' (did you mean 'decode1'?)"),
    ("mfnet_tiny", lambda: {"a": X}, ("decode",), "no part 'decode'"),  # not a whole word
]


@pytest.mark.parametrize(("yaml", "content", "fresh", "said"), REFUSED)
def test_files_that_are_refused(
    tmp_path: Path, yaml: str, content: Callable[[], Any], fresh: tuple[str, ...], said: str
) -> None:
    made = like(network(yaml).state_dict()) if fresh else content()
    assert said in refused(network(yaml), saved(tmp_path, made), fresh)


CLASS_PARTS = {
    "mask2former_tiny": ("network.", "sem_seg_head.predictor.class_embed"),
    "cmx_tiny": ("", "decode_head.linear_pred"),
    "cmnext_tiny": ("", "decode_head.linear_pred"),
    "rtfnet_tiny": ("", "deconv5.1"),
    "mfnet_tiny": ("", "decode1"),
    "heatnet_tiny": ("trgb_segnet.", "final"),
}


@pytest.mark.parametrize("yaml", CLASS_PARTS)
def test_another_number_of_classes(tmp_path: Path, yaml: str) -> None:
    """The refusal says which part to start anew, and doing so works."""
    prefix, part = CLASS_PARTS[yaml]
    path = saved(tmp_path, like(network(yaml, 9).state_dict(), prefix))
    model = network(yaml, 5)
    said = refused(model, path)
    assert "Only parts that depend on the number of classes (the file has 9) differ" in said
    assert f"'model.fresh=[{part}]'" in said

    before = {key: value.clone() for key, value in model.state_dict().items()}
    report = load_weights(model, path, (part,))
    assert report.fresh == {"named in model.fresh": report.num_entries - report.num_set}
    assert report.leftover == report.fresh
    for key, value in model.state_dict().items():
        if key.startswith(f"{part}."):
            assert torch.equal(value, before[key])
        else:
            assert holds(value, prefix + key)


def test_a_branch_that_is_named_fresh(tmp_path: Path) -> None:
    """The other branch still gets the file, so that nothing is left over."""
    model = network("mask2former_tiny", **SWIN_SIZES)
    part = "backbone.THR_branch.layers"
    path = saved(tmp_path, swin_file(32, (1, 1, 2, 1), (1, 2, 4, 8), 5, labels=10))
    before = model.state_dict()[f"{part}.0.blocks.0.mlp.fc1.weight"].clone()
    report = load_weights(model, path, (part,))
    assert "named in model.fresh" in report.fresh
    assert "named in model.fresh" not in report.leftover
    assert torch.equal(model.state_dict()[f"{part}.0.blocks.0.mlp.fc1.weight"], before)
    name = "layers.0.blocks.0.mlp.fc1.weight"
    assert holds(model.state_dict()[f"backbone.RGB_branch.{name}"], name)


def test_stages_that_are_one_in_the_network_and_two_in_the_file(tmp_path: Path) -> None:
    apart, shared = network("mask2former_tiny"), network("mask2former_tiny", share_start=2)
    path = saved(tmp_path, {f"network.{k}": v for k, v in apart.state_dict().items()})
    said = refused(shared, path)
    assert "share one tensor in the network but differ in the file" in said
    assert "model.share_start=4" in said

    other = network("mask2former_tiny", share_start=2)
    for value in other.state_dict().values():
        value.add_(1)
    state = {f"network.{key}": value for key, value in other.state_dict().items()}
    load_weights(shared, saved(tmp_path, state))
    for key, value in other.state_dict().items():
        assert torch.equal(shared.state_dict()[key], value)


def test_tokens_that_are_one_in_the_network_and_two_in_the_file(tmp_path: Path) -> None:
    apart = network("mask2former_tiny")
    shared = network("mask2former_tiny", mask_token="shared")
    path = saved(tmp_path, {f"network.{k}": v for k, v in apart.state_dict().items()})
    assert "for example with model.mask_token=branch" in refused(shared, path)
    state = {f"network.{key}": value for key, value in shared.state_dict().items()}
    load_weights(network("mask2former_tiny", mask_token="shared"), saved(tmp_path, state))


def test_the_sentence_of_a_load(tmp_path: Path) -> None:
    model = network("rtfnet_18", base_width=4)
    tensors = resnet_file(18, counters=False, width=4)
    path = saved(tmp_path, OrderedDict((key, value.half()) for key, value in tensors.items()))
    report = load_weights(model, path)
    assert report.sentence().startswith(f"weights of {path}, ImageNet ResNet (ResNet-18): ")
    assert f"{report.num_set} of {report.num_entries} entries set" in report.sentence()
    assert "40 counters of batch normalisation begin at 0" in report.sentence()
    assert "not part of the ImageNet network" in report.sentence()
    assert "float16 converted" in report.sentence()
    assert model.state_dict()["encoder_rgb_bn1.weight"].dtype == torch.float32
    assert "unused entries of the file: 2 (ImageNet's classifier)" in report.sentence()


class Mine(nn.Module):
    """A network that is none of rgbt.models."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(2, 3)


class MyCMX(CMX):
    """A network of the user's that is one of rgbt.models."""


def test_networks_from_elsewhere_take_files_of_their_own(tmp_path: Path) -> None:
    model = Mine()
    state = like(model.state_dict())
    for content in (
        {"model": state, "step": 3},
        {"model": state, "optimizers": {}, "state": {"step": 3}},
        state,
    ):
        report = load_weights(model, saved(tmp_path, content))
        assert report.num_set == 2
        assert all(holds(value, key) for key, value in model.state_dict().items())
    said = refused(
        model, saved(tmp_path, {"model": {"layer.weight": torch.zeros(3, 2)}, "step": 1})
    )
    assert "1 entry of the network missing from the file (layer.bias)" in said
    said = refused(model, saved(tmp_path, resnet_file(18)))
    assert "other parameter names than Mine" in said


def test_a_class_derived_from_a_network_takes_its_files(tmp_path: Path) -> None:
    model = network("cmx_tiny", **MIT_SIZES)
    model.__class__ = MyCMX
    load_weights(model, saved(tmp_path, mit_file((16, 32, 64, 96), (1, 1, 1, 1))))
    assert holds(model.state_dict()["backbone.extra_norm1.bias"], "norm1.bias")


def test_checkpoints_of_runs(tmp_path: Path) -> None:
    """Both kinds, of a family with a release, of one without, and of another network."""
    for yaml in ("cmx_tiny", "cmnext_tiny", "deeplabv2_tiny"):
        model = network(yaml)
        path = saved(tmp_path, {"model": like(model.state_dict()), "step": 240})
        report = load_weights(model, path)
        assert report.facts.layout == "own"
        assert report.num_set == report.num_entries
        assert all(holds(value, key) for key, value in model.state_dict().items())


def test_a_file_with_nan_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    model = nn.Linear(3, 2)
    before = model.bias.detach().clone()
    broken = OrderedDict(model.state_dict(), weight=torch.full((2, 3), float("nan")))
    broken["bias"] = before + 1
    path = tmp_path / "broken.pt"
    torch.save({"model": broken}, path)
    with pytest.raises(InputError, match=r"'weight' holds NaN or infinity \(1 of 2 tensors do\)"):
        load_weights(model, path)
    assert torch.equal(model.bias, before)
