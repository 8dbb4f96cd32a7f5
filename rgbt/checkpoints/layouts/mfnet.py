"""MFNet's checkpoints: bare state dicts; the published one, of torch 0.4, has no counters."""

from __future__ import annotations

from rgbt.checkpoints.layout import Facts, has_parts, own_names, shapes_of, size_at
from rgbt.checkpoints.read import Contents

WIDTHS = {"conv1_rgb": 16, "conv5_rgb.conv1_left": 48, "conv5_inf.conv1_left": 18}
"""Channels of some units of the published size."""


CONVENTION = ("model/inputs=unit", "model.final_activation=true")


def recognise(contents: Contents) -> Facts | None:
    """A file with both encoders ("inf" is thermal) and the decoder."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "conv1_rgb.conv.", "conv1_inf.conv.", "decode"):
        return None
    published = all(
        size_at(shapes, f"{unit}.conv.weight") == width for unit, width in WIDTHS.items()
    )
    return Facts(
        layout="mfnet",
        what="MFNet checkpoint",
        family="mfnet",
        classes=size_at(shapes, "decode1.conv.weight"),
        fits=(("model=mfnet",),) if published else (),
        convention=CONVENTION,
    )


rule = own_names
