"""Recognise files of DINOv2's vision transformers, and map them to the networks.

The released files (flat, with DINOv2's names) and timm's form of them, which has `reg_token` for
`register_tokens`, no `mask_token`, and with registers no position of the class token: it is part of
`cls_token` (timm/models/vision_transformer.py, `_convert_dinov2`).
"""

from __future__ import annotations

from torch import nn

from rgbt.checkpoints.layout import (
    Facts,
    Layout,
    Rule,
    Shapes,
    count_blocks,
    has_parts,
    shapes_of,
    size_at,
)
from rgbt.checkpoints.read import Contents
from rgbt.checks import InputError

SIZES: dict[tuple[int, int], tuple[str, str]] = {
    (384, 12): ("ViT-S/14", "dinov2_vits14"),
    (768, 12): ("ViT-B/14", "dinov2_vitb14"),
    (1024, 24): ("ViT-L/14", ""),
    (1536, 40): ("ViT-g/14", ""),
}
"""Width and blocks -> size in words and network; "" where there is none of that size."""

INPUTS = "model/inputs=cmx"
"""ImageNet's means and deviations for R, G, B (DINOv2, data/transforms.py)."""

ENCODER = "backbone.encoder."
TIMM_REGISTERS = "reg_token"
NOT_OF_ENCODER = "not part of the encoder"
NO_MASK_TOKEN = "timm drops it; hidden patches get this one"  # noqa: S105 - not a password


def _recognise_dinov2(contents: Contents) -> Facts | None:
    """A file with a class token, positions and blocks with LayerScale at the top."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "cls_token", "pos_embed", "patch_embed.proj.", "norm."):
        return None
    if has_parts(shapes, "blocks.0.0.attn.qkv.", "blocks.0.0.ls1."):
        return Facts("dinov2_chunked", "DINOv2 checkpoint of a training")
    if not has_parts(shapes, "blocks.0.attn.qkv.", "blocks.0.ls1."):
        return None
    is_timm = "mask_token" not in shapes
    size, model = SIZES.get(
        (size_at(shapes, "pos_embed", 2) or 0, count_blocks(shapes, r"blocks\.(\d+)\.")), ("", "")
    )
    registers = size_at(shapes, TIMM_REGISTERS if is_timm else "register_tokens", 1)
    patch = size_at(shapes, "patch_embed.proj.weight", 2)
    fits = model and patch == 14 and registers in (None, 4)
    return Facts(
        layout="dinov2_timm" if is_timm else "dinov2",
        what=f"DINOv2 vision transformer{' of timm' if is_timm else ''}",
        size=", ".join(filter(None, (size, f"{registers} registers" if registers else ""))),
        fits=((f"model={model}{'_reg' if registers else ''}",),) if fits else (),
        convention=(INPUTS, f"model.position_resize={'size' if registers else 'factor'}"),
    )


def _rule(family: str, model: nn.Module, facts: Facts) -> Rule | None:
    """The encoder gets the file; everything behind it is drawn anew.

    Raises:
        InputError: an encoder of DINOv3, or one with registers for a file without, or the other way
            round.
    """
    if family != "dinov2":
        return None
    check_generation(shapes_of(model.state_dict()), facts, "DINOv2")
    _check_registers(shapes_of(model.state_dict()), facts)
    is_timm = facts.layout == "dinov2_timm"

    def source(entry: str) -> str:
        name = entry.removeprefix(ENCODER)
        return TIMM_REGISTERS if is_timm and name == "register_tokens" else name

    return Rule(
        source=source,
        fresh=(
            (r"backbone\.(?!encoder\.)", NOT_OF_ENCODER),
            (r"sem_seg_head\.", NOT_OF_ENCODER),
            *(((rf"{ENCODER}mask_token$", NO_MASK_TOKEN),) if is_timm else ()),
        ),
        positions=(f"{ENCODER}pos_embed",) if is_timm else (),
    )


def check_generation(own: Shapes, facts: Facts, generation: str) -> None:
    """Refuse a file of the other generation: DINOv2 learns positions, DINOv3 rotates by them.

    Raises:
        InputError: naming the network that fits.
    """
    mine = "DINOv3" if f"{ENCODER}rope_embed.periods" in own else "DINOv2"
    if mine != generation:
        raise InputError(
            f"{facts.title}: a file of {generation}, while the encoder of this network is one of "
            f"{mine}{_fitting(facts)}."
        )


def _fitting(facts: Facts) -> str:
    return f"; use {facts.fits[0][0]}" if facts.fits else ""


def _check_registers(own: Shapes, facts: Facts) -> None:
    has_own = f"{ENCODER}register_tokens" in own
    if has_own == ("registers" in facts.size):
        return
    words = ("without", "with") if has_own else ("with", "without")
    raise InputError(
        f"{facts.title}: a file {words[0]} registers, while this network is one {words[1]} "
        f"registers{_fitting(facts)}."
    )


def _refuse(family: str, _model: nn.Module, _facts: Facts) -> Rule | None:
    """Chunked names are not read."""
    if family != "dinov2":
        return None
    raise InputError(
        "DINOv2 checkpoint of a training, whose blocks are in chunks (blocks.0.0. and so on). "
        "Rename blocks.C.I. to blocks.I. and save the backbone alone, as in the published files."
    )


DINOV2 = {
    "dinov2": Layout(_recognise_dinov2, _rule),
    "dinov2_timm": Layout(_recognise_dinov2, _rule),
    "dinov2_chunked": Layout(_recognise_dinov2, _refuse),
}
"""By name; tried after the other backbones."""
