"""Builders: rates and parts, updates against the written rule, two heads on one backbone."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from rgbt.engine.optimizers import SGD, Adam, AdamW, RMSprop, parameter_groups
from rgbt.requirements import NetworkRecord
from tests.engine.test_trainer import ADAMW
from tests.models.plain import nano

BUILDERS = (
    AdamW(**ADAMW),
    SGD(lr=0.1, backbone_multiplier=0.5, momentum=0.9, weight_decay=0.0),
    RMSprop(lr=0.1, alpha=0.99, eps=1e-8),
    Adam(lr=0.1, betas=(0.9, 0.99), weight_decay=0.0, eps=1e-8),
)


def two_heads() -> nn.Module:
    """A backbone and two heads."""
    heads = nn.ModuleDict({"source": nn.Linear(2, 1), "target": nn.Linear(2, 1)})
    model = nn.ModuleDict({"backbone": nn.Linear(2, 2), "heads": heads})
    model.record = NetworkRecord(pretrained_parts=("backbone.",))
    return model


@pytest.mark.parametrize("builder", BUILDERS, ids=lambda builder: type(builder).__name__)
def test_what_is_left_out_is_not_stepped(builder: Any) -> None:
    model = two_heads()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    optimizer = builder(model, without=("heads.target.",))
    assert all(group["lr"] == group["base_lr"] for group in optimizer.param_groups)
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]) == name.startswith("heads.target."), name
    stepped = sum(len(group["params"]) for group in builder(model).param_groups)
    assert stepped == len(before), "without a name nothing is left out"
    with pytest.raises(ValueError, match="no parameter's name begins with 'heads.night'"):
        builder(model, without=("heads.night",))


def test_frozen_and_shared_parameters_come_never_and_once() -> None:
    model = two_heads()
    model["heads"]["target"].weight = model["heads"]["source"].weight
    model["backbone"].bias.requires_grad_(False)
    groups = parameter_groups(model, ())
    assert sum(p.numel() for group in groups.values() for p in group) == 4 + 2 + 1 + 1


@pytest.mark.parametrize("kind", ["rmsprop", "adam", "sgd"])
def test_steps_are_those_written_out(kind: str) -> None:
    """Of a normalisation, which SGD decays too. RMSprop has neither momentum nor decay.

    In Adam the decay is part of the gradient, and both moments are corrected for their start.
    """
    model = nn.BatchNorm1d(1)
    builder: Any = {
        "rmsprop": RMSprop(lr=0.1, alpha=0.9, eps=0.5),
        "adam": Adam(lr=0.1, betas=(0.5, 0.75), weight_decay=0.25, eps=0.5),
        "sgd": SGD(lr=0.1, backbone_multiplier=0.5, momentum=0.9, weight_decay=0.25),
    }[kind]
    optimizer, value, first, second = builder(model), 1.0, 0.0, 0.0
    for step, gradient in enumerate((2.0, -1.0, 0.5), 1):
        model.weight.grad = torch.full_like(model.weight, gradient)
        optimizer.step()
        whole = gradient + 0.25 * value
        if kind == "adam":
            first, second = 0.5 * first + 0.5 * whole, 0.75 * second + 0.25 * whole**2
            moment, root = first / (1 - 0.5**step), (second / (1 - 0.75**step)) ** 0.5 + 0.5
        elif kind == "sgd":
            first = 0.9 * first + whole
            moment, root = first, 1.0
        else:
            second = 0.9 * second + 0.1 * gradient**2
            moment, root = gradient, second**0.5 + 0.5
        value -= 0.1 * moment / root
        assert model.weight.item() == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("decay_biases", [True, False])
def test_adamw_decays_weights_and_neither_norms_nor_embeddings(decay_biases: bool) -> None:
    model = nn.ModuleDict({"backbone": nn.Linear(2, 2), "norm": nn.LayerNorm(2)})
    model["query"] = nn.Embedding(3, 2)
    model.record = NetworkRecord(pretrained_parts=("backbone.",))
    settings = {"lr": 1.0, "backbone_multiplier": 0.1, "weight_decay": 0.5}
    groups = AdamW(**{**ADAMW, **settings, "decay_biases": decay_biases})(model).param_groups
    found = {(g["lr"], g["weight_decay"]): sum(p.numel() for p in g["params"]) for g in groups}
    bias = {} if decay_biases else {(0.1, 0.0): 2}
    assert found == {(0.1, 0.5): 6 - sum(bias.values()), (1.0, 0.0): 4 + 6, **bias}


def test_adamw_decays_no_tensor_of_one_dimension_of_cmnext() -> None:
    """The rule of its release: biases, normalisations and layer scales are left out."""
    model = nano("cmnext")
    groups = AdamW(**{**ADAMW, "weight_decay": 0.5, "decay_biases": False})(model).param_groups
    decayed = {id(p): g["weight_decay"] == 0.5 for g in groups for p in g["params"]}
    found = {name: decayed[id(p)] for name, p in model.named_parameters()}
    assert found == {name: p.dim() > 1 for name, p in model.named_parameters()}
    assert sum("layer_scale" in name for name in found) == 10
