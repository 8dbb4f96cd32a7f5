"""Scores of the same counts by the protocols of other evaluations, beside the protocol used.

Published evaluations differ in three rules: how a class without a pixel counts, whether the
background takes part, and whether images are added before the ratio or their scores averaged after
it. All are computed from the counts of each image; `rgbt.metrics.scores` has the formulas.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import product
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import Counts, scored_classes
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import MEANS, Scores, absent_rule, class_mean, iou, recall, tally
from rgbt.tables import TextTable, number

if TYPE_CHECKING:  # --help answers without waiting for pandas
    import pandas as pd

# A class without a pixel: `released` and `exclude` as in `rgbt.metrics.scores`; `labelled`: a class
# without a labelled pixel is left out, also where it is predicted.
AbsentRule = Literal["released", "exclude", "labelled"]
# The background: part of the mean; in no mean, but its pixels count; pixels labelled as background
# are ignored (ignore_index of many codes).
Background = Literal["scored", "unscored", "ignored"]
# One confusion matrix of all images, or the mean of the scores of single images.
Over = Literal["matrix", "images"]

COLUMNS = ("method", "split", "images", "background", "absent", "over", "metric", "value")
METRICS = {names.MIOU: iou, names.MACC: recall}
SAID = {
    "released": "count as 0",
    "exclude": "left out",
    "labelled": "left out, predicted or not",
    "scored": "in the mean",
    "unscored": "not in the mean",
    "ignored": "its labels ignored",
}


def protocol_scores(name: str, counts: Counts, background: Collection[str] = ()) -> pd.DataFrame:
    """Compute mIoU and mAcc by every combination of the rules, one a row: `COLUMNS`.

    The mean of single images is over those that have a class left; a class that is alone in its
    image counts there, as in the codes that average over images.

    Args:
        name: of the method.
        counts: of single frames, (N, R, K, K).
        background: classes of the rules `unscored` and `ignored`; without one, only `scored`.

    Returns:
        values in percent; NaN: nothing to score.

    Raises:
        InputError: `background` names no class, or leaves no scored class.
    """
    import pandas as pd

    rows = []
    for treated, (images, scored) in _by_background(counts, background).items():
        for rule, (metric, score) in product(get_args(AbsentRule), METRICS.items()):
            absent: Absent = "released" if rule == "released" else "exclude"
            whole, each = _ruled(images.sum(0), rule), _ruled(images, rule)
            pooled = MEANS[metric](whole, absent, scored)
            averaged = class_mean(class_mean(score(each, absent), scored))
            for over, value in zip(get_args(Over), (pooled, averaged), strict=True):
                rows.append((treated, rule, over, metric, 100 * float(value)))
    frame = pd.DataFrame(rows, columns=COLUMNS[3:])
    return frame.assign(method=name, split=counts.split, images=len(counts.names))[[*COLUMNS]]


def protocol_table(
    frame: pd.DataFrame, counts: Counts, background: Collection[str], where: str = ""
) -> TextTable:
    """Show `protocol_scores` with the protocol of the counts marked by "*" and described below.

    `where`: list and size of the labels, in words.
    """
    used = _used(counts, background)
    rows = []
    for (treated, rule), cells in frame.groupby(["background", "absent"], sort=False):
        of = cells.set_index(["over", "metric"])["value"]
        texts = [number(of[key]) for key in product(get_args(Over), METRICS)]
        if (treated, rule) == used:
            texts[:2] = [f"{text} *" for text in texts[:2]]
        rows.append((SAID[str(rule)], SAID[str(treated)] if background else "-", *texts))
    columns = (*METRICS, *(f"{metric} by image" for metric in METRICS))
    title = f"{frame['method'][0]}, {counts.split} ({len(counts.names)} images): "
    return TextTable(
        f"{title}the same counts by other protocols",
        ("absent classes", "background", *columns),
        tuple(rows),
        tuple(_notes(counts, background, where)),
    )


def _by_background(
    counts: Counts, background: Collection[str]
) -> dict[Background, tuple[Scores, NDArray[np.bool_]]]:
    """Return tallies of each image (N, 3, K) and scored classes (K,) for each rule."""
    matrices = counts.counts.sum(1, dtype=np.int64)
    if not background:
        return {"scored": (tally(matrices), counts.scored)}
    own = set(background)
    try:
        without = scored_classes(counts.classes, own | {*counts.unscored})
    except ValueError as error:
        raise InputError(f"background: {error}") from error
    including = scored_classes(counts.classes, {*counts.unscored} - own)
    ignored = matrices.copy()
    ignored[:, [counts.classes.index(name) for name in own]] = 0
    images = tally(matrices)
    return {
        "scored": (images, including),
        "unscored": (images, without),
        "ignored": (tally(ignored), without),
    }


def _ruled(tallies: Scores, rule: AbsentRule) -> Scores:
    """Drop predictions of classes without labels, where these are left out."""
    if rule != "labelled":
        return tallies
    kept = tallies.copy()
    kept[..., 2, :] *= tallies[..., 1, :] > 0
    return kept


def _used(counts: Counts, background: Collection[str]) -> tuple[str, str]:
    """Return the rules of the counts themselves; "" where their background is partly scored."""
    unscored = {*background} & {*counts.unscored}
    if unscored and unscored < {*background}:
        return "", counts.absent
    return "unscored" if unscored else "scored", counts.absent


def _notes(counts: Counts, background: Collection[str], where: str) -> Iterator[str]:
    images = f"{len(counts.names)} images of split {counts.split}"
    parts = [f"{len(part.names)} {name}" for name, part in counts.parts().items()]
    if about := "; ".join(filter(None, (where, ", ".join(parts)))):
        images += f" ({about})"
    scored = f"{int(counts.scored.sum())} of {len(counts.classes)} classes"
    if counts.unscored:
        scored += f" (without {', '.join(counts.unscored)})"
    pixels = counts.counts.sum((1, 2, 3), dtype=np.int64)
    ends = dict.fromkeys(f"{int(end):,}" for end in (pixels.min(), pixels.max()))
    yield (
        f"*: protocol of the other tables: one confusion matrix over {images}, mean over {scored}. "
        f"{absent_rule(counts.absent)} Labelled pixels that count in an image: {' to '.join(ends)}."
    )
    if background:
        yield f"Background: {', '.join(background)}."
    else:
        yield "No class is known as background; background=NAME adds the lines without it."
    yield (
        "By image: the mean over images of the mean over the classes of each image, as some "
        "published codes compute it."
    )
