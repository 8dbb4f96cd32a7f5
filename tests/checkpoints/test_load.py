"""Loading is complete or does not happen: what lacks, what is too much, what differs."""

from __future__ import annotations

import re
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
from tests.checkpoints.files import MIT, SWIN, holds, like, network, saved
from tests.checkpoints.imagenet import mit_file, resnet_file, swin_file
from tests.models.golden import SHARED, requires_golden

Tensors = OrderedDict[str, Tensor]
X = torch.zeros(1)


def refused(model: nn.Module, path: Path, fresh: tuple[str, ...] = ()) -> str:
    """The sentence of a refusal, after which the network is as it was."""
    before = {key: value.clone() for key, value in model.state_dict().items()}
    with pytest.raises(InputError) as error:
        load_weights(model, path, fresh)
    assert all(torch.equal(before[key], value) for key, value in model.state_dict().items())
    assert "\n" not in str(error.value)
    return str(error.value)


CASES: list[tuple[str, dict[str, Any], Callable[[nn.Module], Tensors], str]] = [
    # network, its sizes, tensors of the file, one name of it that matters
    (
        *("mask2former_tiny", {}, lambda model: like(model.state_dict(), "network.")),
        "network.sem_seg_head.predictor.query_feat.weight",
    ),
    ("mask2former_tiny", SWIN, lambda _: swin_file(), "layers.2.blocks.1.norm2.bias"),
    (
        *("rtfnet_18", {"base_width": 4}, lambda _: resnet_file(18, width=4)),
        "layer3.1.bn2.running_var",
    ),
]


@pytest.mark.parametrize(("yaml", "sizes", "tensors_of", "name"), CASES)
def test_incomplete_and_altered_files_are_refused(
    tmp_path: Path, yaml: str, sizes: Any, tensors_of: Any, name: str
) -> None:
    """The file as it should be is loaded; every way of spoiling it is named."""
    model = network(yaml, **sizes)
    tensors = tensors_of(model)
    plan = load_weights(model, saved(tmp_path, tensors))
    assert plan.num_set + len(plan.zeros) + len(plan.fresh) == plan.num_entries
    assert f"{plan.num_set} of {plan.num_entries} entries set" in plan.sentence()
    less = OrderedDict((key, value) for key, value in tensors.items() if key != name)
    spoiled = {
        " is missing": less,
        "extra is unknown": tensors | {f"{name.split('.')[0]}.extra": X},
        " is 3x5x7 float32 instead of ": tensors | {name: torch.zeros(3, 5, 7)},
        "int64 instead of ": tensors | {name: tensors[name].long()},
    }
    for said, content in spoiled.items():
        text = refused(model, saved(tmp_path, OrderedDict(content)))
        assert said in text
        assert name.split(".")[-2] in text or "extra" in text


@pytest.mark.parametrize(
    ("yaml", "content", "fresh", "said"),
    [
        ("mask2former_tiny", lambda: like(network("cmx_tiny").state_dict()), (), "CMX checkpoint"),
        ("rtfnet_tiny", lambda: resnet_file(101, prefix="Scale."), (), "DeepLab v2 start"),
        ("rtfnet_tiny", lambda: {"w": X}, (), "with names such as w"),
        ("cmx_tiny", lambda: mit_file((32, 64, 160, 256), (2, 2, 2, 2)), (), "instead of"),
        ("mask2former_tiny", lambda: swin_file(window=7), (), "169x1 float32 instead of"),
        ("mfnet_tiny", lambda: {"model": network("cmx_tiny").state_dict(), "step": 1}, (), "miss"),
        ("mfnet_tiny", lambda: {"a": X}, ("decode",), "model.fresh: .* 'decode.'"),  # half a word
    ],
)
def test_files_of_other_networks_are_refused(
    tmp_path: Path, yaml: str, content: Callable[[], Any], fresh: tuple[str, ...], said: str
) -> None:
    made = like(network(yaml).state_dict()) if fresh else content()
    assert re.search(said, refused(network(yaml), saved(tmp_path, made), fresh))


@pytest.mark.parametrize(
    ("yaml", "prefix", "part"),
    [
        ("mask2former_tiny", "network.", "sem_seg_head.predictor.class_embed"),
        ("rtfnet_tiny", "", "deconv5.1"),
    ],
)
def test_another_number_of_classes(tmp_path: Path, yaml: str, prefix: str, part: str) -> None:
    """Such parts keep their initial values if they are named, or for a common start."""
    path = saved(tmp_path, like(network(yaml, 9).state_dict(), prefix))
    assert f"{part}." in refused(network(yaml, 5), path)
    for fresh, other_classes in (((part,), False), ((), True)):
        model = network(yaml, 5)
        before = {key: value.clone() for key, value in model.state_dict().items()}
        plan = load_weights(model, path, fresh, other_classes=other_classes)
        assert plan.num_set + len(plan.fresh) == plan.num_entries
        assert all(key.startswith(f"{part}.") for key in plan.fresh)
        for key, value in model.state_dict().items():
            is_kept = key in plan.fresh
            assert torch.equal(value, before[key]) if is_kept else holds(value, prefix + key)


def test_two_tensors_of_the_file_become_one(tmp_path: Path) -> None:
    apart, one = network("mask2former_tiny"), network("mask2former_tiny", share_start=2)
    path = saved(tmp_path, {f"network.{k}": v for k, v in apart.state_dict().items()})
    assert "are one in the network but differ in the file" in refused(one, path)
    other = network("mask2former_tiny", share_start=2)
    for value in other.state_dict().values():
        value.add_(1)
    state = {f"network.{key}": value for key, value in other.state_dict().items()}
    load_weights(one, saved(tmp_path, state))
    for key, value in other.state_dict().items():
        assert torch.equal(one.state_dict()[key], value)


class MyCMX(CMX):
    """A network of the user's that is one of rgbt.models."""


def test_networks_from_elsewhere_take_files_of_their_own(tmp_path: Path) -> None:
    model = nn.Sequential(OrderedDict(layer=nn.Linear(2, 3)))
    state = like(model.state_dict())
    last = {"model": state, "others": {}, "optimizers": {}, "state": {"step": 3}}
    for content in ({"model": state, "step": 3}, {**last, "rgbt": {"run": "x"}}, state):
        plan = load_weights(model, saved(tmp_path, content))
        assert plan.num_set == 2
        assert plan.is_own == (content is not state)
        assert all(holds(value, key) for key, value in model.state_dict().items())
    one = {"model": {"layer.weight": torch.zeros(3, 2)}, "step": 1}
    assert "layer.bias is missing" in refused(model, saved(tmp_path, one))
    assert "no file of weights for Seq" in refused(model, saved(tmp_path, resnet_file(18)))
    derived = network("cmx_tiny", **MIT)
    derived.__class__ = MyCMX
    load_weights(derived, saved(tmp_path, mit_file()))
    assert holds(derived.state_dict()["backbone.extra_norm1.bias"], "norm1.bias")


def test_a_file_with_nan_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    model = nn.Linear(3, 2)
    broken = OrderedDict(model.state_dict(), weight=torch.full((2, 3), float("nan")))
    broken["bias"] = model.bias.detach() + 1
    said = refused(model, saved(tmp_path, {"model": broken, "step": 1}))
    assert "'weight' holds NaN or infinity (1 of 2 tensors do)" in said


@requires_golden
def test_released_weights_of_mfnet_begin_their_counters_at_0() -> None:
    path, model = SHARED / "realdata/mfnet_weights/final.pth", network("mfnet")
    for key, value in model.state_dict().items():
        value.add_(key.endswith("tracked"))
    plan = load_weights(model, path)
    assert (plan.num_set, len(plan.zeros), plan.num_entries) == (228, 38, 266)
    expected = torch.load(path, map_location="cpu", weights_only=True)
    state = model.state_dict()
    assert all(torch.equal(state[key], expected[key]) for key in expected)
    assert all(value == 0 for key, value in state.items() if key.endswith("num_batches_tracked"))
