"""Recognise files of weights by their names and shapes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from rgbt.checkpoints.backbones import BACKBONES
from rgbt.checkpoints.dinov2 import DINOV2
from rgbt.checkpoints.dinov3 import DINOV3
from rgbt.checkpoints.layout import Facts, Layout
from rgbt.checkpoints.networks import NETWORKS
from rgbt.checkpoints.read import Contents
from rgbt.checks import one_line

LAYOUTS: Mapping[str, Layout] = MappingProxyType(NETWORKS | BACKBONES | DINOV2 | DINOV3)
"""By name, in the order they are tried: whole networks before backbones."""

UNKNOWN = Facts("unknown", "file of weights in an unknown layout")


def recognise(contents: Contents) -> Facts:
    """The first layout that fits; `UNKNOWN` where none does."""
    found = (layout.recognise(contents) for layout in LAYOUTS.values())
    facts = next((each for each in found if each is not None), UNKNOWN)
    if contents.note:
        # The inputs are in the note and do not follow from the layout.
        origin = " ".join(filter(None, map(contents.note.get, ("run", "checkpoint"))))
        noted = f"exported from {one_line(origin or 'rgbt')}, with the inputs of its note"
        return replace(
            facts,
            fits=tuple(each[:1] for each in facts.fits),
            convention=(),
            inputs=_inputs(contents.note.get("inputs", "")),
            remarks=(noted,),
        )
    return facts


def _inputs(text: str) -> Mapping[str, object] | None:
    """`model.inputs` as an export notes it, None where it does not."""
    try:
        noted = json.loads(text)
    except json.JSONDecodeError:
        return None
    return noted if isinstance(noted, dict) else None
