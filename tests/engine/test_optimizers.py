"""Builders: rates and parts, updates against the written rule, two heads on one backbone."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.engine.optimizers import SGD, Adam, AdamW, RMSprop, parameter_groups
from rgbt.requirements import Record
from tests.models.plain import nano

ADAMW: dict[str, Any] = {
    "lr": 0.1,
    "backbone_multiplier": 0.5,
    "weight_decay": 0.0,
    "decay_biases": True,
    "betas": (0.9, 0.999),
    "eps": 1e-8,
}
BUILDERS = (
    AdamW(**ADAMW),
    SGD(lr=0.1, backbone_multiplier=0.5, momentum=0.9, weight_decay=0.0),
    RMSprop(lr=0.1, alpha=0.99, eps=1e-8),
    Adam(lr=0.1, betas=(0.9, 0.99), weight_decay=0.0, eps=1e-8),
)


class TwoHeads(nn.Module):
    """A backbone and two heads."""

    record = Record(pretrained_parts=("backbone.",))

    def __init__(self) -> None:
        super().__init__()
        self.backbone = nn.Linear(2, 2)
        self.heads = nn.ModuleDict({"source": nn.Linear(2, 1), "target": nn.Linear(2, 1)})


def names_in(model: nn.Module, optimizer: torch.optim.Optimizer) -> list[set[str]]:
    """Names of the parameters of every group."""
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    return [{names[id(each)] for each in group["params"]} for group in optimizer.param_groups]


def linear(prefix: str) -> set[str]:
    return {f"{prefix}.weight", f"{prefix}.bias"}


@pytest.mark.parametrize("builder", BUILDERS, ids=lambda builder: type(builder).__name__)
def test_what_is_left_out_is_not_stepped(builder: Any) -> None:
    model = TwoHeads()
    optimizer = builder(model, without=("heads.target.",))
    found = set().union(*names_in(model, optimizer))
    assert found == linear("backbone") | linear("heads.source")
    before = {name: value.clone() for name, value in model.state_dict().items()}
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]) == name.startswith("heads.target."), name


@pytest.mark.parametrize("builder", BUILDERS, ids=lambda builder: type(builder).__name__)
def test_every_group_says_its_base_rate_and_without_nothing_is_left_out(builder: Any) -> None:
    model = TwoHeads()
    optimizer = builder(model)
    assert set().union(*names_in(model, optimizer)) == {n for n, _ in model.named_parameters()}
    assert all(group["lr"] == group["base_lr"] for group in optimizer.param_groups)
    with pytest.raises(ValueError, match="no parameter's name begins with 'heads.night'"):
        builder(model, without=("heads.night",))


def test_frozen_and_shared_parameters_come_never_and_once() -> None:
    model = TwoHeads()
    model.heads["target"].weight = model.heads["source"].weight
    model.backbone.bias.requires_grad_(False)
    groups = parameter_groups(model, (), ())
    assert sum(p.numel() for group in groups.values() for p in group) == 4 + 2 + 1 + 1
    groups = parameter_groups(model, (), ("backbone.",))
    assert sum(len(group) for group in groups.values()) == 3


def one(value: float) -> tuple[nn.Module, Tensor]:
    model = nn.Linear(1, 1, bias=False)
    with torch.no_grad():
        model.weight.fill_(value)
    return model, model.weight


def test_rmsprop_steps_as_written() -> None:
    """v = 0.9 v + 0.1 g^2; w -= lr g / (sqrt(v) + eps), nothing decayed, no momentum."""
    model, weight = one(1.0)
    optimizer = RMSprop(lr=0.1, alpha=0.9, eps=0.5)(model)
    value, square = 1.0, 0.0
    for gradient in (2.0, -1.0, 0.5):
        weight.grad = torch.full_like(weight, gradient)
        optimizer.step()
        square = 0.9 * square + 0.1 * gradient**2
        value -= 0.1 * gradient / (square**0.5 + 0.5)
        assert weight.item() == pytest.approx(value, rel=1e-6)


def test_adam_steps_as_written() -> None:
    """The decay is part of the gradient; both moments are corrected for their start."""
    model, weight = one(1.0)
    optimizer = Adam(lr=0.1, betas=(0.5, 0.75), weight_decay=0.25, eps=0.5)(model)
    value, first, second = 1.0, 0.0, 0.0
    for step, gradient in enumerate((2.0, -1.0, 0.5), 1):
        weight.grad = torch.full_like(weight, gradient)
        optimizer.step()
        whole = gradient + 0.25 * value
        first, second = 0.5 * first + 0.5 * whole, 0.75 * second + 0.25 * whole**2
        corrected = first / (1 - 0.5**step), (second / (1 - 0.75**step)) ** 0.5
        value -= 0.1 * corrected[0] / (corrected[1] + 0.5)
        assert weight.item() == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("decay_biases", [True, False])
def test_adamw_decays_weights_and_neither_norms_nor_embeddings(
    decay_biases: bool,
) -> None:
    model = nn.ModuleDict({"backbone": nn.Linear(2, 2), "norm": nn.LayerNorm(2)})
    model["query"] = nn.Embedding(3, 2)
    model.record = Record(pretrained_parts=("backbone.",))
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


def test_sgd_steps_as_written_and_decays_everything() -> None:
    model = nn.ModuleDict({"backbone": nn.Linear(1, 1), "norm": nn.BatchNorm1d(1)})
    model.record = Record(pretrained_parts=("backbone.",))
    for parameter in model.parameters():
        nn.init.constant_(parameter, 2.0)
        parameter.grad = torch.ones_like(parameter)
    optimizer = SGD(lr=0.1, backbone_multiplier=0.5, momentum=0.9, weight_decay=0.25)(model)
    optimizer.step()
    # 2 - lr (1 + 0.25 * 2): 0.05 for the backbone, 0.1 for the rest.
    for parameter in model["backbone"].parameters():
        assert parameter.item() == pytest.approx(2 - 0.05 * 1.5)
    assert model["norm"].weight.item() == pytest.approx(2 - 0.1 * 1.5)
    assert sorted(g["base_lr"] for g in optimizer.param_groups) == [0.05, 0.1]
