"""Files that this project wrote: checkpoints of runs and exports, with a network's own names."""

from __future__ import annotations

from rgbt.checkpoints.layout import FAMILIES, Facts, own_names
from rgbt.checkpoints.layouts import cmx, heatnet, mask2former, mfnet, rtfnet
from rgbt.checkpoints.read import Contents


def recognise(contents: Contents) -> Facts | None:
    """A file that says of itself that it is ours; the network is recognised by its names."""
    if not contents.ours:
        return None
    family = contents.note.get("family", "")
    whole = (mask2former, cmx, rtfnet, mfnet, heatnet)
    guesses = (layout.recognise(contents) for layout in whole)
    guess = next((facts for facts in guesses if facts is not None), Facts("own", ""))
    family = family or guess.family
    what = "export of a run" if contents.note else "checkpoint of a run"
    return Facts(
        layout="own",
        what=f"{what}, {FAMILIES.get(family, family)}" if family else what,
        family=family,
        size=guess.size,
        classes=guess.classes,
        fits=tuple(overrides[:1] for overrides in guess.fits),
    )


rule = own_names
