"""CMX: checkpoints of its release and of the temporal release."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from rgbt.checkpoints.layout import Facts, Rule, shapes_of, size_at
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
    parts = ("backbone.patch_embed", "backbone.extra_patch_embed", "backbone.F")
    if not all(any(name.startswith(part) for name in shapes) for part in parts):
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


def rule(family: str, _model: nn.Module, _facts: Facts) -> Rule | None:
    """Names are ours."""
    if family != "cmx":
        return None
    return Rule(leftover=((r"voting\.", "never used by the temporal release"),))


def released(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """CMX's names, which are ours."""
    return OrderedDict(state)


def released_temporal(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The temporal release's names: CMX's and a convolution that it never uses, as zeros."""
    classes = state[CLASSIFIER].shape[0]
    voting = {"voting.weight": torch.zeros(classes, 2 * classes, 3, 3)}
    return OrderedDict(**state, **voting, **{"voting.bias": torch.zeros(classes)})
