"""Checkpoints of CRM and SpatialSeg: the whole RGB-T Mask2Former as Lightning stores it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.checkpoints.layout import (
    DERIVED,
    Facts,
    Rule,
    Shapes,
    count_blocks,
    has_parts,
    shapes_of,
    size_at,
)
from rgbt.checkpoints.layouts.swin import SIZES, TITLES
from rgbt.checkpoints.read import Contents

PREFIX = "network."
"""Attribute of the release's LightningModule."""

RGB, THERMAL = "backbone.RGB_branch.", "backbone.THR_branch."
CLASS_WEIGHT = "sem_seg_head.predictor.class_embed.weight"
NO_OBJECT = 0.1
"""Last of the released loss's class weights."""


def recognise(contents: Contents) -> Facts | None:
    """A file with the two branches and the head."""
    names = contents.tensors.keys()
    prefix = PREFIX if any(name.startswith(PREFIX) for name in names) else ""
    if not has_parts(names, f"{prefix}{RGB}", f"{prefix}sem_seg_head."):
        return None
    shapes = {name.removeprefix(prefix): s for name, s in shapes_of(contents.tensors).items()}
    rows = size_at(shapes, CLASS_WEIGHT)
    size = _size(shapes)
    overrides = (f"model=mask2former_{size}", *_settings(contents)) if size else ()
    return Facts(
        layout="mask2former",
        what="checkpoint of CRM or SpatialSeg",
        family="mask2former",
        size=TITLES.get(size, ""),
        classes=None if rows is None else rows - 1,
        prefix=prefix,
        fits=(overrides,) if overrides else (),
        convention=("model/inputs=crm", *_fusion(contents)),
    )


def _size(shapes: Shapes) -> str:
    depths = tuple(
        count_blocks(shapes, rf"backbone\.RGB_branch\.layers\.{stage}\.blocks\.(\d+)\.")
        for stage in range(4)
    )
    return SIZES.get((size_at(shapes, f"{RGB}patch_embed.norm.weight") or 0, depths), "")


def _settings(contents: Contents) -> tuple[str, ...]:
    """What the configuration in the file says and the weights do not, where it is not usual."""
    found = _configuration(contents)
    share = found.get("SWIN.SHARE_START_IDX", share_start(contents))
    return (
        *(each for each in _fusion(contents) if each != "model.fusion=max"),
        *((f"model.share_start={share}",) if share in (0, 1, 2, 3) else ()),
    )


def _configuration(contents: Contents) -> dict[str, Any]:
    return {key.split("MODEL.")[-1]: value for key, value in contents.settings.items()}


def _fusion(contents: Contents) -> tuple[str, ...]:
    """How the file's configuration joins the branches; nothing where it holds none."""
    fusion = _configuration(contents).get("FUSION.AGGREGATION")
    return () if fusion is None else (f"model.fusion={str(fusion).lower()}",)


def share_start(contents: Contents) -> int:
    """First stage whose weights are one piece of memory under the names of both branches."""
    for stage in range(4):
        name = f"layers.{stage}.blocks.0.norm1.weight"
        rgb, thermal = (
            next((t for key, t in contents.tensors.items() if key.endswith(f"{b}{name}")), None)
            for b in (RGB, THERMAL)
        )
        if rgb is not None and thermal is not None and rgb.data_ptr() == thermal.data_ptr():
            return stage
    return 4


def rule(_family: str, _model: nn.Module, _facts: Facts) -> Rule:
    """Names are ours, but for constants that are rebuilt here."""
    return Rule(
        leftover=(
            (r".*\.relative_position_index$", DERIVED),
            (r"criterion\.empty_weight$", "belongs to the loss"),
        )
    )


def released(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The released names: with the constants that are rebuilt here."""
    named = OrderedDict((f"{PREFIX}{key}", value) for key, value in state.items())
    for key, value in state.items():
        if key.endswith("relative_position_bias_table"):
            name = key.replace("bias_table", "index")
            named[f"{PREFIX}{name}"] = position_index(value.shape[0])
    empty = torch.ones(state[CLASS_WEIGHT].shape[0])
    empty[-1] = NO_OBJECT
    named[f"{PREFIX}criterion.empty_weight"] = empty
    return named


def position_index(rows: int) -> Tensor:
    """Row of the bias table for every pair of tokens of a window.

    Args:
        rows: of the table, (2 w - 1)^2 for windows of w x w tokens.

    Returns:
        (w^2, w^2) int64: (dy + w - 1) (2 w - 1) + dx + w - 1, first token less second.
    """
    span = round(rows**0.5)
    side = (span + 1) // 2
    y, x = torch.arange(side * side) // side, torch.arange(side * side) % side
    dy, dx = y[:, None] - y[None], x[:, None] - x[None]
    index: Tensor = (dy + side - 1) * span + dx + side - 1
    return index
