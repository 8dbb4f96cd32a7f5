"""AdamW with the parameter groups of the CRM and SpatialSeg releases."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from rgbt.checks import InputError, check_range

NORMS = (nn.LayerNorm, nn.GroupNorm, nn.modules.batchnorm._BatchNorm)
UNDECAYED_NAMES = ("relative_position_bias_table", "absolute_pos_embed")


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
        betas: exponential decay rates of the two moments.
        eps: added to the denominator.
    """

    lr: float
    backbone_multiplier: float
    weight_decay: float
    betas: tuple[float, float]
    eps: float

    def __post_init__(self) -> None:
        if self.lr <= 0:
            raise InputError(f"optimizer.lr must be positive, got {self.lr:g}.")
        check_range("optimizer.backbone_multiplier", self.backbone_multiplier, 0.0, 1e6)
        check_range("optimizer.weight_decay", self.weight_decay, 0.0, 1e6)
        for beta in self.betas:
            check_range("optimizer.betas", beta, 0.0, 1.0 - 1e-12)

    def __call__(self, model: nn.Module) -> torch.optim.Optimizer:
        """The optimizer of all trainable parameters of `model`."""
        groups = parameter_groups(model, lr=self.lr, backbone_lr=self.lr * self.backbone_multiplier)
        settings = [
            {
                "params": tensors,
                "lr": lr,
                "base_lr": lr,
                "weight_decay": self.weight_decay * decayed,
            }
            for (lr, decayed), tensors in groups.items()
        ]
        return torch.optim.AdamW(settings, betas=self.betas, eps=self.eps, fused=True)


def parameter_groups(
    model: nn.Module, *, lr: float, backbone_lr: float
) -> dict[tuple[float, bool], list[nn.Parameter]]:
    """(learning rate, decayed) -> parameters, each parameter once even where modules are shared.

    Source: CRM release. Biases, mask tokens and raw level embeddings are decayed; affine
    parameters of normalisations, `nn.Embedding` weights and position bias tables are not.
    """
    groups: dict[tuple[float, bool], list[nn.Parameter]] = {}
    seen: set[int] = set()
    pretrained: tuple[str, ...] = getattr(model, "pretrained_parts", ())
    for module_name, module in model.named_modules():
        for name, parameter in module.named_parameters(recurse=False):
            if id(parameter) in seen or not parameter.requires_grad:
                continue
            seen.add(id(parameter))
            decayed = not isinstance(module, (*NORMS, nn.Embedding)) and name not in UNDECAYED_NAMES
            in_backbone = f"{module_name}.{name}".lstrip(".").startswith(pretrained)
            groups.setdefault((backbone_lr if in_backbone else lr, decayed), []).append(parameter)
    return groups
