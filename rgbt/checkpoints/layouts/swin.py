"""ImageNet Swin Transformers: the original files, and the pickles that detectron2 reads."""

from __future__ import annotations

import math

from torch import nn

from rgbt.checkpoints.layout import (
    DERIVED,
    NOT_IN_FILE,
    Facts,
    Rule,
    count_blocks,
    has_parts,
    shapes_of,
    size_at,
)
from rgbt.checkpoints.read import Contents
from rgbt.checks import InputError

SIZES: dict[tuple[int, tuple[int, ...]], str] = {
    (96, (2, 2, 6, 2)): "swin_t",
    (96, (2, 2, 18, 2)): "swin_s",
    (128, (2, 2, 18, 2)): "swin_b",
    (192, (2, 2, 18, 2)): "swin_l",
}
"""Channels of the first stage and blocks per stage -> name."""

TITLES = {"swin_t": "Swin-T", "swin_s": "Swin-S", "swin_b": "Swin-B", "swin_l": "Swin-L"}
LABELS_22K = (21841, 21842)
TABLE = "layers.0.blocks.0.attn.relative_position_bias_table"
BRANCHES = ("backbone.RGB_branch.", "backbone.THR_branch.")


def recognise(contents: Contents) -> Facts | None:
    """A file with Swin's names at the top."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "patch_embed.proj.", "layers.0.blocks.0.attn.qkv."):
        return None
    depths = tuple(count_blocks(shapes, rf"layers\.{n}\.blocks\.(\d+)\.") for n in range(4))
    size = SIZES.get((size_at(shapes, "patch_embed.norm.weight") or 0, depths), "")
    labels = size_at(shapes, "head.weight")
    return Facts(
        layout="swin",
        what="ImageNet Swin Transformer",
        size=TITLES.get(size, ""),
        fits=((f"model=mask2former_{size}",),) if size and size != "swin_l" else (),
        window=window_of(size_at(shapes, TABLE)),
        remarks=("trained on ImageNet-22k",) if labels in LABELS_22K else (),
    )


def window_of(rows: int | None) -> int | None:
    """Side of an attention window from the rows of its bias table, (2 w - 1)^2."""
    return None if rows is None else (math.isqrt(rows) + 1) // 2


def rule(family: str, model: nn.Module, facts: Facts) -> Rule | None:
    """Both branches get the file; the thermal patch convolution its mean over the input channels.

    Released: CRM and SpatialSeg, DetectionCheckpointer with the thermal convolution averaged
    (keepdim). Output normalisations, mask tokens, fusion and head are not in the file; the file's
    last normalisation is not norm3.

    Raises:
        InputError: windows of another size.
    """
    if family != "mask2former":
        return None
    _check_window(model, facts)

    def source(entry: str) -> str:
        for branch in BRANCHES:
            entry = entry.removeprefix(branch)
        return entry

    return Rule(
        source=source,
        fresh=(
            (r"backbone\.(RGB|THR)_branch\.mask_token$", NOT_IN_FILE),
            (r"backbone\.(RGB|THR)_branch\.norm[0-3]\.", NOT_IN_FILE),
            (r"backbone\.norm_layers\.", NOT_IN_FILE),
            (r"sem_seg_head\.", NOT_IN_FILE),
        ),
        leftover=(
            (r".*\.relative_position_index$", DERIVED),
            (r".*\.attn_mask$", DERIVED),
            (r"norm\.", "normalises ImageNet's features, of which the decoder takes others"),
            (r"head\.", "ImageNet's classifier"),
        ),
        stems=("backbone.THR_branch.patch_embed.proj.weight",),
    )


def _check_window(model: nn.Module, facts: Facts) -> None:
    own = window_of(size_at(shapes_of(model.state_dict()), f"{BRANCHES[0]}{TABLE}"))
    if own != facts.window and facts.window is not None:
        raise InputError(
            f"{facts.title} with windows of {facts.window} x {facts.window} tokens, while those of "
            f"this network are {own} x {own} and their bias tables cannot be exchanged; take the "
            "file for windows of that size (7 x 7: ImageNet at 224 pixels)."
        )
