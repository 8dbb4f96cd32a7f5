"""Builders of optimizers, with the parameter groups of the releases."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from rgbt.checks import InputError, check_range

NORMS = (nn.LayerNorm, nn.GroupNorm, nn.modules.batchnorm._BatchNorm)
UNDECAYED_NAMES = ("relative_position_bias_table",)
BIASES = ("bias", "in_proj_bias")


@dataclass(frozen=True, kw_only=True)
class AdamW:
    """Builder of a `torch.optim.AdamW` with two learning rates and two weight decays.

    Source: CRM release, `train` configuration (BASE_LR, BACKBONE_MULTIPLIER, WEIGHT_DECAY,
    WEIGHT_DECAY_NORM, WEIGHT_DECAY_EMBED).

    Attributes:
        lr: learning rate of everything outside the backbone, > 0.
        backbone_multiplier: factor of `lr` for the parameters that the network counts as
            pretrained (the prefixes of names in its attribute `pretrained_parts`).
        weight_decay: for every parameter except affine parameters of normalisations, embeddings
            and relative position tables, which get 0.
        decay_biases: whether biases are decayed, as in the CRM release; CMX and the temporal
            release leave them out.
        betas: exponential decay rates of the two moments.
        eps: added to the denominator.
    """

    lr: float
    backbone_multiplier: float
    weight_decay: float
    decay_biases: bool
    betas: tuple[float, float]
    eps: float

    def __post_init__(self) -> None:
        _check(self.lr, self.backbone_multiplier, self.weight_decay)
        for beta in self.betas:
            check_range("optimizer.betas", beta, 0.0, 1.0 - 1e-12)

    def __call__(self, model: nn.Module) -> torch.optim.Optimizer:
        """The optimizer of all trainable parameters of `model`."""
        undecayed = UNDECAYED_NAMES if self.decay_biases else (*UNDECAYED_NAMES, *BIASES)
        groups = parameter_groups(model, undecayed)
        settings = [
            {
                **_rates(self.lr, self.backbone_multiplier if pretrained else 1.0),
                "params": parameters,
                "weight_decay": self.weight_decay * decayed,
            }
            for (pretrained, decayed), parameters in groups.items()
        ]
        return torch.optim.AdamW(settings, betas=self.betas, eps=self.eps, fused=True)


@dataclass(frozen=True, kw_only=True)
class SGD:
    """Builder of a `torch.optim.SGD` with momentum that decays every parameter.

    Source: MFNet and RTFNet releases (momentum 0.9, weight decay 5e-4).

    Attributes:
        lr: learning rate, > 0.
        backbone_multiplier: factor of `lr` for what the network counts as pretrained.
        momentum: in [0, 1).
        weight_decay: of every parameter.
    """

    lr: float
    backbone_multiplier: float
    momentum: float
    weight_decay: float

    def __post_init__(self) -> None:
        _check(self.lr, self.backbone_multiplier, self.weight_decay)
        check_range("optimizer.momentum", self.momentum, 0.0, 1.0 - 1e-12)

    def __call__(self, model: nn.Module) -> torch.optim.Optimizer:
        """The optimizer of all trainable parameters of `model`."""
        by_part: dict[bool, list[nn.Parameter]] = {}
        for (pretrained, _), parameters in parameter_groups(model, ()).items():
            by_part.setdefault(pretrained, []).extend(parameters)
        settings = [
            {
                **_rates(self.lr, self.backbone_multiplier if pretrained else 1.0),
                "params": parameters,
            }
            for pretrained, parameters in by_part.items()
        ]
        return torch.optim.SGD(
            settings, lr=self.lr, momentum=self.momentum, weight_decay=self.weight_decay
        )


def _check(lr: float, backbone_multiplier: float, weight_decay: float) -> None:
    if lr <= 0:
        raise InputError(f"optimizer.lr must be positive, got {lr:g}.")
    check_range("optimizer.backbone_multiplier", backbone_multiplier, 0.0, 1e6)
    check_range("optimizer.weight_decay", weight_decay, 0.0, 1e6)


def _rates(lr: float, factor: float) -> dict[str, float]:
    """What a schedule reads (`base_lr`) and what it writes."""
    return {"lr": lr * factor, "base_lr": lr * factor}


def parameter_groups(
    model: nn.Module, undecayed_names: tuple[str, ...]
) -> dict[tuple[bool, bool], list[nn.Parameter]]:
    """(pretrained, decayed) -> parameters, each parameter once even where modules are shared.

    Source: CRM release. Mask tokens and raw level embeddings are decayed; affine parameters of
    normalisations, `nn.Embedding` weights and `undecayed_names` are not.
    """
    groups: dict[tuple[bool, bool], list[nn.Parameter]] = {}
    seen: set[int] = set()
    parts: tuple[str, ...] = getattr(model, "pretrained_parts", ())
    for module_name, module in model.named_modules():
        for name, parameter in module.named_parameters(recurse=False):
            if id(parameter) in seen or not parameter.requires_grad:
                continue
            seen.add(id(parameter))
            decayed = not isinstance(module, (*NORMS, nn.Embedding)) and name not in undecayed_names
            pretrained = f"{module_name}.{name}".lstrip(".").startswith(parts)
            groups.setdefault((pretrained, decayed), []).append(parameter)
    return groups
