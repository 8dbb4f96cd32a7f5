"""Write the footnotes of a class table: which classes are absent, and how means count them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rgbt.metrics.metric import Absent

COUNTED: dict[Absent, str] = {"released": "counted as 0", "exclude": "left out of the mean"}


def absent_notes(
    by_region: NDArray[np.integer],
    classes: Sequence[str],
    scored: NDArray[np.bool_],
    split: str,
    absent: Absent,
) -> tuple[str, ...]:
    """Footnotes about absent classes that change the means over classes.

    A class is absent where it is neither labelled nor predicted. One that is predicted although no
    label holds it has an IoU of 0 with either convention (see `rgbt.metrics.scores`).

    Of the (R, K, K) counts of all images, K names and the scored ones (K,), the others not being
    mentioned: at most three sentences without a full stop, about absent classes, classes that are
    predicted only, and classes that some regions lack.
    """
    labelled, predicted = by_region.sum(-1) > 0, by_region.sum(-2) > 0
    there = labelled | predicted
    gone = scored & ~there.any(0)
    unlabelled = scored & there.any(0) & ~labelled.any(0)
    partly = np.flatnonzero(scored & there.any(0) & ~there.all(0)).tolist()
    notes = []
    if gone.any():
        named = ", ".join(np.array(classes)[gone])
        notes.append(f"absent from the {split} split: {named} ({COUNTED[absent]})")
    if unlabelled.any():
        named = ", ".join(np.array(classes)[unlabelled])
        notes.append(f"predicted, but not labelled in the {split} split: {named} (IoU 0)")
    if partly:
        lacks = []
        for each in partly:
            regions = [str(number) for number in (np.flatnonzero(~there[:, each]) + 1)]
            plural = "s" * (len(regions) > 1)
            lacks.append(f"{classes[each]} (region{plural} {', '.join(regions)})")
        notes.append(f"absent from some regions: {', '.join(lacks)}; {COUNTED[absent]} there")
    return tuple(notes)
