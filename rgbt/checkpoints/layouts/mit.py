"""ImageNet MiT files, ``mit_b0.pth`` to ``mit_b5.pth``."""

from __future__ import annotations

from torch import nn

from rgbt.checkpoints.layout import (
    NOT_IN_FILE,
    Facts,
    Rule,
    Shapes,
    count_blocks,
    has_parts,
    shapes_of,
    size_at,
)
from rgbt.checkpoints.read import Contents

SIZES: dict[tuple[int, tuple[int, ...]], str] = {
    (32, (2, 2, 2, 2)): "b0",
    (64, (2, 2, 2, 2)): "b1",
    (64, (3, 4, 6, 3)): "b2",
    (64, (3, 4, 18, 3)): "b3",
    (64, (3, 8, 27, 3)): "b4",
    (64, (3, 6, 40, 3)): "b5",
}
"""Channels of the first stage and blocks per stage -> name."""


def recognise(contents: Contents) -> Facts | None:
    """A file with one stream at the top."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "patch_embed1.", "block1.0.attn."):
        return None
    size = mit_size(shapes, "")
    return Facts(
        layout="mit",
        what="ImageNet MiT",
        size=mit_title(size),
        fits=((f"model=cmx_{size}",),) if size else (),
    )


def mit_size(shapes: Shapes, prefix: str) -> str:
    """The size (b0 to b5) of the stream behind `prefix`, "" for unpublished ones."""
    depths = tuple(count_blocks(shapes, rf"{prefix}block{stage}\.(\d+)\.") for stage in range(1, 5))
    return SIZES.get((size_at(shapes, f"{prefix}patch_embed1.norm.weight") or 0, depths), "")


def mit_title(size: str) -> str:
    """The size as it is printed: MiT-B2."""
    return f"MiT-{size.upper()}" if size else ""


def rule(family: str, _model: nn.Module, _facts: Facts) -> Rule | None:
    """Both streams get the file; a thermal stem of one channel its mean over the input channels.

    Released: CMX and the temporal release feed thermal three times, so that the stem is copied.
    """
    if family != "cmx":
        return None
    return Rule(
        source=lambda entry: entry.removeprefix("backbone.").removeprefix("extra_"),
        fresh=((r"backbone\.F[RF]Ms\.", NOT_IN_FILE), (r"decode_head\.", NOT_IN_FILE)),
        leftover=((r"head\.", "ImageNet's classifier"),),
        stems=("backbone.extra_patch_embed1.proj.weight",),
    )
