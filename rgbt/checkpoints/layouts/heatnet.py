"""HeatNet's checkpoints: the segmentation network and its discriminators in one module."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

from torch import Tensor, nn

from rgbt.checkpoints.layout import Facts, Rule, shapes_of, size_at
from rgbt.checkpoints.read import Contents

PREFIX = "trgb_segnet."
WRAPPED = "module."
"""What the released files carry before every name."""

FITS = {1: "heatnet_thermal", 3: "heatnet_rgb", 4: "heatnet_early"}
"""Channels of a single stem -> configuration."""


CONVENTION = ("model/inputs=half", "model.align_corners=false")


def recognise(contents: Contents) -> Facts | None:
    """A file with names under "trgb_segnet."."""
    shapes = shapes_of(contents.tensors)
    if not any(name.startswith(f"{PREFIX}feats.") for name in shapes):
        return None
    two = any(name.startswith(f"{PREFIX}feats.conv1_2.") for name in shapes)
    channels = size_at(shapes, f"{PREFIX}feats.conv1.weight", 1)
    name = "heatnet" if two else FITS.get(channels or 0, "")
    return Facts(
        layout="heatnet",
        what="HeatNet checkpoint",
        family="pspnet",
        size="ResNet-50" if size_at(shapes, f"{PREFIX}feats.conv1.weight") == 64 else "",
        classes=size_at(shapes, f"{PREFIX}final.0.weight"),
        prefix=PREFIX,
        fits=((f"model={name}",),) if name else (),
        convention=CONVENTION,
    )


def rule(_family: str, _model: nn.Module, _facts: Facts) -> Rule:
    """Names are ours; discriminators are networks of their own here."""
    return Rule(leftover=((r"critics\.", "a discriminator, which is a network of its own here"),))


def released(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The network's released names; there are none of discriminators."""
    return OrderedDict((f"{WRAPPED}{PREFIX}{key}", value) for key, value in state.items())
