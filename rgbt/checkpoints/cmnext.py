"""Recognise files of CMNeXt, and map the names of its release to those of the network here."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Mapping

from torch import Tensor, nn

from rgbt.checkpoints.backbones import mit_size, mit_title
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
from rgbt.checks import InputError

RELEASED = ("model/inputs=imagenet_unit",)
EMBED = "backbone.extra_downsample_layers."
LAYERS = {"proj": "proj.module", "norm": "norm.ln_0"}
"""Layer of a thermal patch embedding -> released name; ln_1 is that of a third modality."""

FUSE = {"0": "conv", "1": "bn"}
"""The same of the convolution over the decoder's joined maps."""


def released_name(entry: str) -> str:
    """The released name of an entry of the network.

    Source: DELIVER release, with two modalities. The thermal patch embeddings, numbered from 0
    there, and the decoder have other names than here, where they are those of CMX.
    """
    if found := re.fullmatch(r"backbone\.extra_patch_embed(\d)\.(proj|norm)\.(.*)", entry):
        return f"{EMBED}{int(found[1]) - 1}.{LAYERS[found[2]]}.{found[3]}"
    if found := re.fullmatch(r"(decode_head\.linear_fuse\.)(\d)\.(.*)", entry):
        return f"{found[1]}{FUSE[found[2]]}.{found[3]}"
    return entry


def released(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The entries of a network under the released names."""
    return OrderedDict((released_name(key), value) for key, value in state.items())


def _recognise(contents: Contents) -> Facts | None:
    """A MiT stream and one of pooling blocks, under the released names or those here."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "backbone.patch_embed", "backbone.extra_block1.0.c_nets."):
        return None
    size = mit_size(shapes, "backbone.")
    thermal = count_blocks(shapes, rf"{re.escape(EMBED)}0\.norm\.ln_(\d+)\.")
    layout, what = "cmnext" if thermal else "cmnext_renamed", "CMNeXt checkpoint"
    if thermal > 1:
        layout, what = "cmnext_several", f"{what} of {thermal + 1} modalities"
    return Facts(
        layout=layout,
        what=what,
        family="cmnext",
        size=mit_title(size),
        classes=size_at(shapes, "decode_head.linear_pred.weight"),
        fits=((f"model=cmnext_{size}",),) if size and thermal <= 1 else (),
        convention=RELEASED,
    )


def _refuse(_family: str, _model: nn.Module, facts: Facts) -> Rule:
    raise InputError(
        f"a {facts.title}; CMNeXt here has two modalities, RGB and thermal, so use a file that was "
        "trained with two."
    )


LAYOUTS = {
    "cmnext": Layout(_recognise, lambda *_: Rule(source=released_name)),
    "cmnext_renamed": Layout(_recognise, lambda *_: Rule()),
    "cmnext_several": Layout(_recognise, _refuse),
}
"""By name; CMX's names are part of these, so that they are tried first."""
