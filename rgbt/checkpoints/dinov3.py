"""Recognise files of DINOv3's vision transformers, and map them to the networks.

The released files (flat, with DINOv3's names), and two other forms of them, whose tensors get the
released names:

- Hugging Face (transformers, models/dinov3_vit): queries, keys and values are apart, and keys have
  no bias.
- timm (timm/models/eva.py): no mask token; the bias of queries and values is apart, or it is left
  out, where all of it is 0.

The released files hold the periods of the positions rounded to bfloat16. The other forms do not
hold them, and both programs compute them, as the network does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rgbt.checkpoints.dinov2 import (
    ENCODER,
    INPUTS,
    NO_MASK_TOKEN,
    NOT_OF_ENCODER,
    check_generation,
)
from rgbt.checkpoints.layout import (
    Facts,
    Layout,
    Rule,
    count_blocks,
    has_parts,
    shapes_of,
    size_at,
)
from rgbt.checkpoints.read import Contents

SIZES: dict[tuple[int, int, bool], tuple[str, str]] = {
    (384, 12, False): ("ViT-S/16", "dinov3_vits16"),
    (384, 12, True): ("ViT-S+/16", "dinov3_vits16plus"),
    (768, 12, False): ("ViT-B/16", "dinov3_vitb16"),
    (1024, 24, False): ("ViT-L/16", ""),
    (1280, 32, True): ("ViT-H+/16", ""),
    (4096, 40, True): ("ViT-7B/16", ""),
}
"""Width, blocks and gated MLP -> size in words and network; "" where there is none of that size."""

CONVENTION = (INPUTS, "model.norm_eps=1e-05", "model.rope_base=100.0")
COMPUTED = "computed from model.rope_base"
KEY_BIAS = "the bias of the keys is 0 in this network too"


@dataclass(frozen=True)
class Form:
    """Names by which a form of the files is recognised.

    Attributes:
        origin: behind "DINOv3 vision transformer".
        parts: beginnings of names, each of which the file has.
        token: the class token.
        patch: weights of the patch embedding.
        blocks: regular expression with the number of a block.
        gate: beginning of a name that only a gated MLP has.
    """

    origin: str
    parts: tuple[str, ...]
    token: str
    patch: str
    blocks: str
    gate: str


FORMS = {
    "dinov3": Form(
        origin="",
        parts=("storage_tokens", "rope_embed.periods", "blocks.0.attn.qkv.", "blocks.0.ls1."),
        token="cls_token",  # noqa: S106 - not a password
        patch="patch_embed.proj.weight",
        blocks=r"blocks\.(\d+)\.",
        gate="blocks.0.mlp.w3.",
    ),
    "dinov3_hugging_face": Form(
        origin=" of Hugging Face",
        parts=("embeddings.register_tokens", "layer.0.attention.k_proj.", "layer.0.layer_scale1."),
        token="embeddings.cls_token",  # noqa: S106 - not a password
        patch="embeddings.patch_embeddings.weight",
        blocks=r"layer\.(\d+)\.",
        gate="layer.0.mlp.gate_proj.",
    ),
    "dinov3_timm": Form(
        origin=" of timm",
        parts=("reg_token", "blocks.0.attn.qkv.", "blocks.0.gamma_1"),
        token="cls_token",  # noqa: S106 - not a password
        patch="patch_embed.proj.weight",
        blocks=r"blocks\.(\d+)\.",
        gate="blocks.0.mlp.fc1_g.",
    ),
}
"""By name of the layout."""


def _recognise_dinov3(contents: Contents) -> Facts | None:
    """A file of one of the forms, without learned positions."""
    shapes = shapes_of(contents.tensors)
    if "pos_embed" in shapes:
        return None
    for layout, form in FORMS.items():
        if not has_parts(shapes, *form.parts):
            continue
        width = size_at(shapes, form.token, 2) or 0
        blocks, is_gated = count_blocks(shapes, form.blocks), has_parts(shapes, form.gate)
        size, model = SIZES.get((width, blocks, is_gated), ("", ""))
        fits = model and size_at(shapes, form.patch, 2) == 16
        return Facts(
            layout=layout,
            what=f"DINOv3 vision transformer{form.origin}",
            size=size,
            fits=((f"model={model}",),) if fits else (),
            convention=CONVENTION,
        )
    return None


def _rule(family: str, model: nn.Module, facts: Facts) -> Rule | None:
    """The encoder gets the file, under released names; everything behind it is drawn anew.

    Raises:
        InputError: an encoder of DINOv2.
    """
    if family != "dinov2":
        return None
    check_generation(shapes_of(model.state_dict()), facts, "DINOv3")

    def source(entry: str) -> str:
        name = entry.removeprefix(ENCODER)
        return "storage_tokens" if name == "register_tokens" else name

    is_released, is_timm = facts.layout == "dinov3", facts.layout == "dinov3_timm"
    return Rule(
        source=source,
        fresh=(
            (r"backbone\.(?!encoder\.)", NOT_OF_ENCODER),
            (r"sem_seg_head\.", NOT_OF_ENCODER),
            *(() if is_released else ((rf"{ENCODER}rope_embed\.periods$", COMPUTED),)),
            *(((rf"{ENCODER}mask_token$", NO_MASK_TOKEN),) if is_timm else ()),
        ),
        leftover=((r"blocks\.\d+\.attn\.qkv\.bias_mask$", KEY_BIAS),),
    )


Names = tuple[tuple[str, str], ...]
"""(regular expression, replacement), applied one after the other."""

FROM_HUGGING_FACE: Names = (
    (r"^embeddings\.patch_embeddings\.", "patch_embed.proj."),
    (r"^embeddings\.register_tokens$", "storage_tokens"),
    (r"^embeddings\.", ""),
    (r"^layer\.", "blocks."),
    (r"\.layer_scale(\d)\.lambda1$", r".ls\1.gamma"),
    (r"\.attention\.o_proj\.", ".attn.proj."),
    (r"\.attention\.([qkv])_proj\.", r".attn.\1."),
)
FROM_TIMM: Names = (
    (r"^reg_token$", "storage_tokens"),
    (r"\.gamma_(\d)$", r".ls\1.gamma"),
    (r"\.attn\.([qv])_bias$", r".attn.\1.bias"),
)
GATED = {
    "dinov3_hugging_face": (("gate_proj", "w1"), ("up_proj", "w2"), ("down_proj", "w3")),
    "dinov3_timm": (("fc1_g", "w1"), ("fc1_x", "w2"), ("fc2", "w3")),
}
PLAIN = {"dinov3_hugging_face": (("up_proj", "fc1"), ("down_proj", "fc2")), "dinov3_timm": ()}
"""Layers of the MLP, with and without a gate."""


def _from_hugging_face(tensors: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Released names; queries, keys and values as one projection, keys without a bias."""
    found = _renamed(tensors, "dinov3_hugging_face", FROM_HUGGING_FACE)
    if "mask_token" in found:
        found["mask_token"] = found["mask_token"].flatten(0, -2)
    for name in [name for name in found if name.endswith(".attn.q.weight")]:
        start = name.removesuffix("q.weight")
        parts = [f"{start}{part}.weight" for part in "qkv"]
        if all(part in found for part in parts):
            found[f"{start}qkv.weight"] = torch.cat([found.pop(part) for part in parts])
        _join_biases(found, start)
    return found


def _from_timm(tensors: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Released names; a joint bias, which is 0 where the file has none."""
    found = _renamed(tensors, "dinov3_timm", FROM_TIMM)
    has_bias = any(name.endswith((".attn.q.bias", ".attn.v.bias")) for name in found)
    for name in [name for name in found if name.endswith(".attn.qkv.weight")]:
        start = name.removesuffix("qkv.weight")
        if has_bias:
            _join_biases(found, start)
        else:
            found[f"{start}qkv.bias"] = found[name].new_zeros(len(found[name]))
    return found


def _renamed(tensors: Mapping[str, Tensor], layout: str, names: Names) -> dict[str, Tensor]:
    is_gated = has_parts(tensors, FORMS[layout].gate)
    layers = (GATED if is_gated else PLAIN)[layout]
    names = (*names, *((rf"\.mlp\.{old}\.", f".mlp.{new}.") for old, new in layers))
    found = {}
    for name, tensor in tensors.items():
        new = name
        for pattern, replacement in names:
            new = re.sub(pattern, replacement, new)
        found[new] = tensor
    return found


def _join_biases(tensors: dict[str, Tensor], start: str) -> None:
    """Replace the biases of queries and values by the joint one; a lone one stays, and is named."""
    first, last = f"{start}q.bias", f"{start}v.bias"
    if first in tensors and last in tensors:
        query, value = tensors.pop(first), tensors.pop(last)
        tensors[f"{start}qkv.bias"] = torch.cat([query, torch.zeros_like(query), value])


DINOV3 = {
    "dinov3": Layout(_recognise_dinov3, _rule),
    "dinov3_hugging_face": Layout(_recognise_dinov3, _rule, _from_hugging_face),
    "dinov3_timm": Layout(_recognise_dinov3, _rule, _from_timm),
}
"""By name; tried after DINOv2."""
