"""CMX: checkpoints of its release and of the temporal release."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from rgbt.checkpoints.layout import Facts, Rule, has_parts, shapes_of, size_at
from rgbt.checkpoints.layouts.mit import mit_size, mit_title
from rgbt.checkpoints.read import Contents

VOTING = "voting."
"""A convolution of the temporal release that is never used."""

CLASSIFIER = "decode_head.linear_pred.weight"
RELEASED = ("model/inputs=cmx_released", "model.decoder_norm_eps_eval=1e-5")
TEMPORAL = ("model/inputs=temporal",)


def recognise(contents: Contents) -> Facts | None:
    """A file with both streams under `backbone.`; `voting.` tells the releases apart."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "backbone.patch_embed", "backbone.extra_patch_embed", "backbone.F"):
        return None
    temporal = any(name.startswith(VOTING) for name in shapes)
    size = mit_size(shapes, "backbone.")
    convention = TEMPORAL if temporal else RELEASED
    return Facts(
        layout="cmx",
        what="CMX checkpoint of the temporal release" if temporal else "CMX checkpoint",
        family="cmx",
        size=mit_title(size),
        classes=size_at(shapes, CLASSIFIER),
        fits=((f"model=cmx_{size}", *convention),) if size else (),
        convention=convention,
    )


def rule(_family: str, _model: nn.Module, _facts: Facts) -> Rule:
    """Names are ours."""
    return Rule(leftover=((r"voting\.", "never used by the temporal release"),))


def released_temporal(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The temporal release's names: CMX's and a convolution that it never uses, as zeros."""
    classes = state[CLASSIFIER].shape[0]
    voting = {"voting.weight": torch.zeros(classes, 2 * classes, 3, 3)}
    return OrderedDict(**state, **voting, **{"voting.bias": torch.zeros(classes)})
