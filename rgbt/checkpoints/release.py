"""Export weights in the formats of the released code and as safetensors."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rgbt.checkpoints.files import NOTE
from rgbt.checkpoints.kinds import CMNEXT, KINDS
from rgbt.checks import InputError, check_choice
from rgbt.files.atomic import replacing

FORMATS = ("safetensors", "released")

# The note of an export: network, inputs and run.
Note = Mapping[str, str]

# Family -> key under which its releases put the weights ("": at the top), and what is before every
# name. HeatNet's code loads the file of a PSPNet with no_conf, without discriminators.
RELEASES = {
    "mask2former": ("state_dict", "network."),
    "semseg": ("state_dict", "module."),
    "cmx": ("model", ""),
    "pspnet": ("", "module.trgb_segnet."),
    **dict.fromkeys(("cmnext", "rtfnet", "mfnet", "external"), ("", "")),
}

# Prefix of the names of a network from elsewhere (`rgbt.models.external.network`).
EXTERNAL_PREFIX = "network."

CLASS_WEIGHT = "sem_seg_head.predictor.class_embed.weight"
# The last class weight of CRM's released loss.
NO_OBJECT = 0.1


def convention_of(layout: str, family: str) -> tuple[str, ...]:
    """Return how the authors' code feeds and evaluates the network that a layout is for."""
    if layout == "safetensors" or not KINDS.get(family):
        return ()
    fusion = ("model.fusion=max",) if family == "mask2former" else ()
    return (*KINDS[family][family == "cmx"].convention, *fusion)


def save(path: Path, layout: str, family: str, state: Mapping[str, Tensor], note: Note) -> None:
    """Write the weights of a network, "" for the `family` of one from elsewhere, to a new file.

    `layout` is one of `FORMATS`; the `note` is stored if it has a place for it. InputError: the
    file exists, the format is unknown or does not fit the network.
    """
    check_choice("format", layout, FORMATS)
    if path.exists():
        raise InputError(f"out={path} already exists; remove it or choose another file name.")
    is_safe = layout == "safetensors"
    content = _safetensors(state, note) if is_safe else released(family, state, note)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        if isinstance(content, bytes):
            file.write(content)
        else:
            torch.save(content, file)


def released(family: str, state: Mapping[str, Tensor], note: Note) -> dict[str, Any]:
    """Arrange what torch.save writes for the authors' code; arguments and errors as of `save`."""
    if family not in RELEASES:
        what = family or "this network"
        raise InputError(f"format=released does not exist for {what}; use format=safetensors.")
    wrapper, prefix = RELEASES[family]
    named = OrderedDict()
    for key, value in state.items():
        named[prefix + _released_name(family, key)] = value
    if family == "mask2former":
        for key, value in state.items():
            if key.endswith("relative_position_bias_table"):
                named[prefix + key.replace("bias_table", "index")] = position_index(len(value))
        named[f"{prefix}criterion.empty_weight"] = torch.ones(len(state[CLASS_WEIGHT]))
        named[f"{prefix}criterion.empty_weight"][-1] = NO_OBJECT
    if not wrapper:
        return named
    steps = {"global_step": int(note.get("step", 0)), "pytorch-lightning_version": "1.9.2"}
    more = steps if family == "mask2former" else {}
    return {"epoch": 0, **more, wrapper: named, NOTE: dict(note)}


def _released_name(family: str, entry: str) -> str:
    if family == "external":
        return entry.removeprefix(EXTERNAL_PREFIX)
    return CMNEXT.source(entry) if family == "cmnext" else entry


def position_index(rows: int) -> Tensor:
    """Compute the row of Swin's bias table, of (2 w - 1)^2 rows, for every pair of tokens.

    (w^2, w^2) int64 of a window of w x w:
    (dy + w - 1) (2 w - 1) + dx + w - 1, first token less second.
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
