"""Export weights in the formats of the released code and as safetensors."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rgbt.checkpoints import cmnext, networks
from rgbt.checkpoints.layout import FAMILIES
from rgbt.checkpoints.read import NOTE
from rgbt.checks import InputError, check_choice
from rgbt.files.atomic import replacing

FORMATS = ("safetensors", "released", "released_temporal")

Note = Mapping[str, str]
"""The note of an export: network, inputs and run."""


Container = Callable[[Mapping[str, Tensor], Note], Any]
RELEASED: Mapping[str, Container] = {
    # Without the configuration object of the release, which its test does not read from here.
    "mask2former": lambda state, note: {
        "epoch": 0,
        "global_step": int(note.get("step", 0)),
        "pytorch-lightning_version": "1.9.2",
        "state_dict": networks.released_mask2former(state),
        NOTE: dict(note),
    },
    "cmx": lambda state, note: {"model": OrderedDict(state), NOTE: dict(note)},
    "cmnext": lambda state, _: cmnext.released(state),
    "rtfnet": lambda state, _: OrderedDict(state),
    "mfnet": lambda state, _: OrderedDict(state),
    "pspnet": lambda state, _: networks.released_heatnet(state),
    "external": lambda state, _: networks.released_external(state),
    "semseg": lambda state, note: {
        "epoch": 0,
        "state_dict": OrderedDict((f"module.{key}", value) for key, value in state.items()),
        NOTE: dict(note),
    },
}
"""Family -> value that torch.load returns for its released files."""

CONVENTIONS: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("released", "mask2former"): ("model/inputs=crm", "model.fusion=max"),
    ("released", "cmx"): networks.CMX_RELEASED,
    ("released_temporal", "cmx"): networks.CMX_TEMPORAL,
    ("released", "cmnext"): cmnext.RELEASED,
    ("released", "rtfnet"): networks.RTFNET_RELEASED,
    ("released", "mfnet"): networks.MFNET_RELEASED,
    ("released", "pspnet"): networks.HEATNET_RELEASED,
    ("released", "semseg"): networks.SEMSEG,
}
"""Format and family -> how the authors' code feeds and evaluates the network."""

SAID: Mapping[tuple[str, str], str] = {
    ("released", "pspnet"): (
        "the file has no entries under module.critics., because a discriminator is not part of "
        "this network; HeatNet's code loads it with no_conf, without critics"
    ),
    ("released_temporal", "cmx"): (
        "voting.weight and voting.bias are zeros, because they are never used"
    ),
}
"""The remark about a format and a family."""


def payload(layout: str, family: str, state: Mapping[str, Tensor], note: Note) -> Any:
    """The value that torch.save writes for a released layout.

    Args:
        layout: "released", or "released_temporal" for CMX as the temporal paper uses it.
        family: of the network.
        state: its entries.
        note: stored if the container supports it.

    Raises:
        InputError: there is no such layout for this family.
    """
    if layout == "released_temporal":
        if family != "cmx":
            raise InputError(
                f"format={layout} is for CMX of the temporal release, but this network is "
                f"{FAMILIES.get(family, 'not part of rgbt.models')}. Choose another format."
            )
        return networks.released_temporal(state)
    if family not in RELEASED:
        raise InputError(
            f"no released format exists for {FAMILIES.get(family, 'this network')}; use "
            "format=safetensors."
        )
    return RELEASED[family](state, note)


def save(
    path: Path, layout: str, family: str, state: Mapping[str, Tensor], note: Note
) -> str | None:
    """Write weights under a temporary name and rename it.

    Args:
        path: of the new file.
        layout: one of `FORMATS`.
        family: of the network, "" for one from elsewhere.
        state: its entries.
        note: the note of the file.

    Returns:
        a remark about the file, or none.

    Raises:
        InputError: the file exists, the format is unknown or does not fit the network.
    """
    check_choice("format", layout, FORMATS)
    if path.exists():
        raise InputError(f"out={path} already exists; remove it or choose another file name.")
    content = None if layout == "safetensors" else payload(layout, family, state, note)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        if layout == "safetensors":
            file.write(_safetensors(state, note))
        else:
            torch.save(content, file)
    return SAID.get((layout, family))


def _safetensors(state: Mapping[str, Tensor], note: Note) -> bytes:
    from safetensors.torch import save as serialised

    # The format knows no shared memory: what two branches share is written for each.
    separate = {key: value.detach().clone().contiguous() for key, value in state.items()}
    metadata = {"format": "pt", **{f"{NOTE}.{key}": value for key, value in note.items()}}
    return serialised(separate, metadata=metadata)
