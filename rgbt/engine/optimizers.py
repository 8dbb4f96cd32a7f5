"""Build optimizers with the parameter groups of the releases.

A builder takes a network and the beginnings of the names that it leaves out. Each group has the
base rate that a schedule reads; one with `constant` keeps that rate.
"""

# ruff: noqa: D102 - see above

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval
from torch import nn

from rgbt.ranges import Epsilon, LearningRate, NonNegative, ShareBelowOne
from rgbt.requirements import NetworkRecord, record_of

NORMS = (nn.LayerNorm, nn.GroupNorm, nn.modules.batchnorm._BatchNorm)
UNDECAYED_NAMES = ("relative_position_bias_table", "layer_scale_1", "layer_scale_2")
Betas = tuple[ShareBelowOne, ShareBelowOne]
Decay = Annotated[float, Interval(ge=0, le=100)]


@dataclass(frozen=True, kw_only=True)
class AdamW:
    """Builds `torch.optim.AdamW` with two learning rates and two weight decays.

    Source: CRM release, `train` configuration. What the network counts as pretrained
    (`pretrained_parts` of its record) has the rate ``lr * backbone_multiplier``. Affine parameters
    of normalisations, embeddings, relative position tables and layer scales are not decayed; nor
    are biases without `decay_biases` (CMX, temporal release).
    """

    lr: LearningRate
    backbone_multiplier: NonNegative
    weight_decay: Decay
    decay_biases: bool
    betas: Betas
    eps: Epsilon

    def __call__(self, model: nn.Module, without: tuple[str, ...] = ()) -> torch.optim.Optimizer:
        undecayed = UNDECAYED_NAMES + (() if self.decay_biases else ("bias", "in_proj_bias"))
        groups = []
        for (pretrained, decayed), part in parameter_groups(model, undecayed, without).items():
            rate = self.lr * (self.backbone_multiplier if pretrained else 1.0)
            groups.append(_group(part, rate) | {"weight_decay": self.weight_decay * decayed})
        return torch.optim.AdamW(groups, betas=self.betas, eps=self.eps, fused=True)


@dataclass(frozen=True, kw_only=True)
class SGD:
    """Builds `torch.optim.SGD` with momentum that decays every parameter.

    Source: MFNet and RTFNet releases; thesis (J. Sun), code of the networks with one or two heads.
    `head_rate` "released": the rate of what is not pretrained stays `lr`; the thesis' code of
    maximum squares schedules the first parameter group alone.
    """

    lr: LearningRate
    backbone_multiplier: NonNegative
    momentum: ShareBelowOne
    weight_decay: Decay
    head_rate: Literal["scheduled", "released"] = "scheduled"

    def __call__(self, model: nn.Module, without: tuple[str, ...] = ()) -> torch.optim.Optimizer:
        by_part: dict[bool, list[nn.Parameter]] = {}
        for (pretrained, _), part in parameter_groups(model, (), without).items():
            by_part.setdefault(pretrained, []).extend(part)
        groups = []
        for pretrained, parameters in by_part.items():
            rate = self.lr * (self.backbone_multiplier if pretrained else 1.0)
            group = _group(parameters, rate)
            if self.head_rate == "released" and not pretrained:
                group["constant"] = True
            groups.append(group)
        # On a GPU the default makes a copy of all gradients to add the decay; the fused one none.
        # On a CPU it would change the last bits of published runs.
        fused = True if any(p.is_cuda for group in groups for p in group["params"]) else None
        decay = self.weight_decay
        return torch.optim.SGD(groups, momentum=self.momentum, weight_decay=decay, fused=fused)


@dataclass(frozen=True, kw_only=True)
class RMSprop:
    """Builds `torch.optim.RMSprop` with one rate, no decay. Source: HeatNet release (1e-4)."""

    lr: LearningRate
    alpha: ShareBelowOne
    eps: Epsilon

    def __call__(self, model: nn.Module, without: tuple[str, ...] = ()) -> torch.optim.Optimizer:
        return torch.optim.RMSprop(
            [_whole(model, without, self.lr)], alpha=self.alpha, eps=self.eps
        )


@dataclass(frozen=True, kw_only=True)
class Adam:
    """Builds `torch.optim.Adam` with one rate, for discriminators.

    Source: AdaptSegNet (rate 1e-4, betas 0.9 and 0.99, no decay); thesis (J. Sun), code (1e-5).
    """

    lr: LearningRate
    betas: Betas
    weight_decay: Decay
    eps: Epsilon

    def __call__(self, model: nn.Module, without: tuple[str, ...] = ()) -> torch.optim.Optimizer:
        group = _whole(model, without, self.lr) | {"weight_decay": self.weight_decay}
        return torch.optim.Adam([group], betas=self.betas, eps=self.eps, fused=True)


def _group(parameters: list[nn.Parameter], lr: float) -> dict[str, Any]:
    return {"params": parameters, "lr": lr, "base_lr": lr}


def _whole(model: nn.Module, without: tuple[str, ...], lr: float) -> dict[str, Any]:
    """Make one group of all trainable parameters, in the order of `parameter_groups`."""
    parameters: list[nn.Parameter] = []
    for part in parameter_groups(model, (), without).values():
        parameters += part
    return _group(parameters, lr)


def parameter_groups(
    model: nn.Module, undecayed_names: tuple[str, ...], without: tuple[str, ...] = ()
) -> dict[tuple[bool, bool], list[nn.Parameter]]:
    """Group trainable parameters by (pretrained, decayed), each once even if modules share it.

    Source: CRM release. Mask tokens and raw level embeddings are decayed; affine parameters of
    normalisations, `nn.Embedding` weights and `undecayed_names` (last words of names) are not.
    `without` are beginnings of names that are left out ("heads.target."); ValueError: no such name.
    """
    groups: dict[tuple[bool, bool], list[nn.Parameter]] = {}
    parts = record_of(model, NetworkRecord).pretrained_parts
    for beginning in without:
        if not any(name.startswith(beginning) for name, _ in model.named_parameters()):
            raise ValueError(f"without: no parameter's name begins with '{beginning}'.")
    for full_name, parameter in model.named_parameters():  # shared ones once, by their first name
        module_name, _, name = full_name.rpartition(".")
        if not parameter.requires_grad or full_name.startswith(without):
            continue
        module = model.get_submodule(module_name)
        decayed = not isinstance(module, (*NORMS, nn.Embedding)) and name not in undecayed_names
        groups.setdefault((full_name.startswith(parts), decayed), []).append(parameter)
    return groups


def step_without_gradient(optimizer: torch.optim.Optimizer) -> None:
    """Step the parameters that were stepped before with gradients of 0.

    The moving averages decay, momentum and weight decay act. Released: `zero_grad` up to torch 1.13
    leaves zeros, so that one optimiser of all parameters also steps those of the other phase.
    """
    optimizer.zero_grad()
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            if optimizer.state.get(parameter):
                parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    optimizer.zero_grad()
