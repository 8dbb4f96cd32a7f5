"""Build optimizers with the parameter groups of the releases."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval
from torch import nn

from rgbt.ranges import Epsilon, LearningRate, NonNegative, ShareBelowOne
from rgbt.requirements import record_of

NORMS = (nn.LayerNorm, nn.GroupNorm, nn.modules.batchnorm._BatchNorm)
UNDECAYED_NAMES = ("relative_position_bias_table", "layer_scale_1", "layer_scale_2")
"""Last words of names of parameters that scale or shift; the last two are those of CMNeXt."""

BIASES = ("bias", "in_proj_bias")
Decay = Annotated[float, Interval(ge=0, le=100)]
"""Weight decay; a step subtracts it times the learning rate."""


@dataclass(frozen=True, kw_only=True)
class AdamW:
    """Builder of a `torch.optim.AdamW` with two learning rates and two weight decays.

    Source: CRM release, `train` configuration (BASE_LR, BACKBONE_MULTIPLIER, WEIGHT_DECAY,
    WEIGHT_DECAY_NORM, WEIGHT_DECAY_EMBED).

    Attributes:
        lr: learning rate of everything outside the backbone, > 0.
        backbone_multiplier: factor of `lr` for the parameters that the network counts as
            pretrained (`pretrained_parts` of its record).
        weight_decay: for every parameter except affine parameters of normalisations, embeddings,
            relative position tables and layer scales, which get 0.
        decay_biases: whether biases are decayed, as in the CRM release; CMX and the temporal
            release leave them out.
        betas: exponential decay rates of the two moments.
        eps: added to the denominator.
    """

    lr: LearningRate
    backbone_multiplier: NonNegative
    weight_decay: Decay
    decay_biases: bool
    betas: tuple[ShareBelowOne, ShareBelowOne]
    eps: Epsilon

    def __call__(self, model: nn.Module, without: tuple[str, ...] = ()) -> torch.optim.Optimizer:
        """The optimizer of the trainable parameters of `model` (see `parameter_groups`)."""
        undecayed = UNDECAYED_NAMES if self.decay_biases else (*UNDECAYED_NAMES, *BIASES)
        groups = parameter_groups(model, undecayed, without)
        settings = [
            _group(parameters, self.lr * (self.backbone_multiplier if pretrained else 1.0))
            | {"weight_decay": self.weight_decay * decayed}
            for (pretrained, decayed), parameters in groups.items()
        ]
        return torch.optim.AdamW(settings, betas=self.betas, eps=self.eps, fused=True)


@dataclass(frozen=True, kw_only=True)
class SGD:
    """Builder of a `torch.optim.SGD` with momentum that decays every parameter.

    Source: MFNet and RTFNet releases; thesis (J. Sun), code of the networks with one or two heads
    (all: momentum 0.9, weight decay 5e-4).

    Attributes:
        lr: learning rate, > 0.
        backbone_multiplier: factor of `lr` for what the network counts as pretrained.
        momentum: in [0, 1).
        weight_decay: of every parameter.
        head_rate: "scheduled", or "released": the rate of what is not pretrained stays `lr`. The
            thesis' code of maximum squares schedules the first parameter group alone.
    """

    lr: LearningRate
    backbone_multiplier: NonNegative
    momentum: ShareBelowOne
    weight_decay: Decay
    head_rate: Literal["scheduled", "released"] = "scheduled"

    def __call__(self, model: nn.Module, without: tuple[str, ...] = ()) -> torch.optim.Optimizer:
        """The optimizer of the trainable parameters of `model` (see `parameter_groups`)."""
        by_part: dict[bool, list[nn.Parameter]] = {}
        for (pretrained, _), parameters in parameter_groups(model, (), without).items():
            by_part.setdefault(pretrained, []).extend(parameters)
        settings = [
            _group(parameters, self.lr * (self.backbone_multiplier if pretrained else 1.0))
            | ({"constant": True} if self.head_rate == "released" and not pretrained else {})
            for pretrained, parameters in by_part.items()
        ]
        # On a GPU the default makes a copy of all gradients to add the decay; the fused one none.
        # On a CPU it would change the last bits of published runs.
        on_gpu = any(parameter.is_cuda for group in settings for parameter in group["params"])
        return torch.optim.SGD(
            settings,
            lr=self.lr,
            momentum=self.momentum,
            weight_decay=self.weight_decay,
            fused=True if on_gpu else None,
        )


@dataclass(frozen=True, kw_only=True)
class RMSprop:
    """Builder of a `torch.optim.RMSprop` with one rate, without momentum and weight decay.

    Source: HeatNet release (rate 1e-4, the rest as torch has it).

    Attributes:
        lr: learning rate, > 0.
        alpha: decay of the mean of squared gradients, in [0, 1).
        eps: added to the denominator.
    """

    lr: LearningRate
    alpha: ShareBelowOne
    eps: Epsilon

    def __call__(self, model: nn.Module, without: tuple[str, ...] = ()) -> torch.optim.Optimizer:
        """The optimizer of the trainable parameters of `model` (see `parameter_groups`)."""
        settings = [_group(trainable(model, without), self.lr)]
        return torch.optim.RMSprop(settings, lr=self.lr, alpha=self.alpha, eps=self.eps)


@dataclass(frozen=True, kw_only=True)
class Adam:
    """Builder of a `torch.optim.Adam` with one rate, for discriminators.

    Source: AdaptSegNet (rate 1e-4, betas 0.9 and 0.99, no weight decay); thesis (J. Sun), code
    (rate 1e-5).

    Attributes:
        lr: learning rate, > 0.
        betas: exponential decay rates of the two moments, in [0, 1).
        weight_decay: added to the gradient of every parameter, as Adam has it.
        eps: added to the denominator.
    """

    lr: LearningRate
    betas: tuple[ShareBelowOne, ShareBelowOne]
    weight_decay: Decay
    eps: Epsilon

    def __call__(self, model: nn.Module, without: tuple[str, ...] = ()) -> torch.optim.Optimizer:
        """The optimizer of the trainable parameters of `model` (see `parameter_groups`)."""
        settings = [_group(trainable(model, without), self.lr)]
        return torch.optim.Adam(
            settings, betas=self.betas, weight_decay=self.weight_decay, eps=self.eps, fused=True
        )


def _group(parameters: list[nn.Parameter], lr: float) -> dict[str, Any]:
    """A group with the base rate that a schedule reads; one with `constant` keeps that rate."""
    return {"params": parameters, "lr": lr, "base_lr": lr}


def parameter_groups(
    model: nn.Module, undecayed_names: tuple[str, ...], without: tuple[str, ...] = ()
) -> dict[tuple[bool, bool], list[nn.Parameter]]:
    """(pretrained, decayed) -> parameters, each parameter once even where modules are shared.

    Source: CRM release. Mask tokens and raw level embeddings are decayed; affine parameters of
    normalisations, `nn.Embedding` weights and `undecayed_names` are not.

    Args:
        model: parameters that are not trained are left out.
        undecayed_names: last words of names.
        without: beginnings of names that are left out, for two optimizers that share a backbone
            and have a head each ("heads.target.").

    Raises:
        ValueError: no name begins with one of `without`.
    """
    groups: dict[tuple[bool, bool], list[nn.Parameter]] = {}
    parts = record_of(model).pretrained_parts
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


def trainable(model: nn.Module, without: tuple[str, ...] = ()) -> list[nn.Parameter]:
    """All parameters of `parameter_groups` in one list."""
    groups = parameter_groups(model, (), without)
    return [parameter for group in groups.values() for parameter in group]


def step_without_gradient(optimizer: torch.optim.Optimizer) -> None:
    """Step the parameters that were stepped before with gradients of 0.

    The moving averages decay, momentum and weight decay act. Released: `zero_grad` up to torch 1.13
    leaves zeros, so that one optimiser of all parameters also steps those of the other phase.
    """
    parameters = [each for group in optimizer.param_groups for each in group["params"]]
    stepped = [each for each in parameters if optimizer.state.get(each)]
    for parameter in parameters:
        parameter.grad = None
    for parameter in stepped:
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    for parameter in stepped:
        parameter.grad = None
