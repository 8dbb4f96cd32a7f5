"""Export weights in the formats of the released code and as safetensors."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rgbt.checkpoints.kinds import CMNEXT, KINDS, TEMPORAL
from rgbt.checkpoints.read import NOTE
from rgbt.checks import InputError, check_choice
from rgbt.files.atomic import replacing

FORMATS = ("safetensors", "released", "released_temporal")

Note = Mapping[str, str]
"""The note of an export: network, inputs and run."""

WRAPPED = {"mask2former": "state_dict", "semseg": "state_dict", "cmx": "model"}
"""Family -> key under which its releases put the weights; others have them at the top."""

PREFIXES = {"mask2former": "network.", "semseg": "module.", "pspnet": "module.trgb_segnet."}
"""Family -> before every released name, where there is something."""

EXTERNAL_PREFIX = "network."
"""Before the names of a network from elsewhere (`rgbt.models.external.network`)."""

CLASS_WEIGHT = "sem_seg_head.predictor.class_embed.weight"
NO_OBJECT = 0.1
"""Last of the class weights of the released loss of CRM."""

REMARKS = {
    "pspnet": (
        "the file has no entries under module.critics., because a discriminator is not part of "
        "this network; HeatNet's code loads it with no_conf, without critics"
    )
}
"""Family -> what the authors' code needs to know."""


def convention_of(layout: str, family: str) -> tuple[str, ...]:
    """How the authors' code feeds and evaluates the network that a file of a layout is for."""
    if layout == "safetensors" or family not in KINDS or not KINDS[family]:
        return ()
    kind = TEMPORAL if layout == "released_temporal" else KINDS[family][family == "cmx"]
    return (*kind.convention, *(("model.fusion=max",) if family == "mask2former" else ()))


def save(
    path: Path, layout: str, family: str, state: Mapping[str, Tensor], note: Note
) -> str | None:
    """Write weights under a temporary name and rename it.

    Args:
        path: of the new file.
        layout: one of `FORMATS`; "released_temporal" is CMX as the temporal release has it.
        family: of the network, "" for one from elsewhere.
        state: its entries.
        note: the note of the file, stored if the format has a place for it.

    Returns:
        a remark about the file, or none.

    Raises:
        InputError: the file exists, the format is unknown or does not fit the network.
    """
    check_choice("format", layout, FORMATS)
    if path.exists():
        raise InputError(f"out={path} already exists; remove it or choose another file name.")
    is_safe = layout == "safetensors"
    content = _safetensors(state, note) if is_safe else payload(layout, family, state, note)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        if isinstance(content, bytes):
            file.write(content)
        else:
            torch.save(content, file)
    return REMARKS.get(family) if layout == "released" else None


def payload(layout: str, family: str, state: Mapping[str, Tensor], note: Note) -> dict[str, Any]:
    """The value that torch.save writes for a released layout; arguments as of `save`.

    Raises:
        InputError: there is no such layout for this family.
    """
    if layout == "released_temporal" and family == "cmx":
        voting = torch.zeros(
            *(len(state["decode_head.linear_pred.weight"]) * n for n in (1, 2)), 3, 3
        )
        unused = {"voting.weight": voting, "voting.bias": voting[:, 0, 0, 0].clone()}
        return OrderedDict(state, **unused)  # a convolution that it never uses
    whole = (*PREFIXES, "cmx", "cmnext", "rtfnet", "mfnet", "external")
    if layout == "released_temporal" or family not in whole:
        raise InputError(
            f"format={layout} does not exist for {family or 'this network'}; use "
            "format=safetensors."
        )
    prefix = PREFIXES.get(family, "")
    named = OrderedDict((prefix + _released_name(family, key), each) for key, each in state.items())
    if family == "mask2former":
        for key, value in state.items():
            if key.endswith("relative_position_bias_table"):
                named[prefix + key.replace("bias_table", "index")] = position_index(len(value))
        named[f"{prefix}criterion.empty_weight"] = torch.ones(len(state[CLASS_WEIGHT]))
        named[f"{prefix}criterion.empty_weight"][-1] = NO_OBJECT
    if family not in WRAPPED:
        return named
    steps = {"global_step": int(note.get("step", 0)), "pytorch-lightning_version": "1.9.2"}
    return {
        "epoch": 0,
        **(steps if family == "mask2former" else {}),
        WRAPPED[family]: named,
        NOTE: dict(note),
    }


def _released_name(family: str, entry: str) -> str:
    if family == "external":
        return entry.removeprefix(EXTERNAL_PREFIX)
    return CMNEXT.source(entry) if family == "cmnext" else entry


def position_index(rows: int) -> Tensor:
    """Row of Swin's bias table for every pair of tokens of a window.

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


def _safetensors(state: Mapping[str, Tensor], note: Note) -> bytes:
    from safetensors.torch import save as serialised

    # The format knows no shared memory: what two branches share is written for each.
    separate = {key: value.detach().clone().contiguous() for key, value in state.items()}
    metadata = {"format": "pt", **{f"{NOTE}.{key}": value for key, value in note.items()}}
    return serialised(separate, metadata=metadata)
