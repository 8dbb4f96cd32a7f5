"""Count pairs of frames, and compute temporal consistency (TC) and consistent accuracy (CA).

Counts of pairs are ordinary `rgbt.metrics.counts.Counts` of shape (N, S (K + 1), K, K): entry
``[s (K + 1) + y, p1, p2]`` is the number of pixels that set s of second frames labels y (K: no
class), and that are p1 in the prediction of the first and p2 in that of the second frame. Their
partition, e.g. "aligned3", is the protocol and S:

    "aligned": the first prediction is warped to the second frame; pixels count that the first
                frame shows and that have a label (Temporal, Fig. 4).
    "released": the first prediction stays where it is, every pixel counts (Temporal release).
    "next":     as "aligned", between a frame and the one that was taken after it.
    "flow":     as "next", along an estimated flow; pixels count whose flow is reliable. Labels may
                be missing: TC is over all these pixels, CA over the labelled ones.
    "triples":  three frames A, B, C along two estimated flows: y is the class of A, p1 that of B
                and p2 that of C, at the pixels of C that are reliable in both.

Scores read sums of them: `frames` and `triples` are (..., S, 3, K), `changed` and `flickered`
(..., 2, K). These add up over images. Scores are (..., K) by class.
"""

from __future__ import annotations

import re
from typing import Literal, get_args

import numpy as np

from rgbt.metrics import names
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import Matrices, Scores, class_mean, iou, ratio, rows, tally

Protocol = Literal["aligned", "released", "next", "flow", "triples"]
PROTOCOLS: tuple[Protocol, ...] = get_args(Protocol)

# The main scores of a protocol, TC and CA first: CA of the paper, or that of its release.
HEADLINES: dict[Protocol, tuple[str, ...]] = {
    "aligned": (names.TC, names.CA),
    "released": (names.TC, names.CA_RELEASED),
    "next": (names.TC, names.CA),
    "flow": (names.TC, names.CA, names.WARPING_ERROR),
    "triples": (names.FLICKER,),
}


def partition_name(protocol: Protocol, sets: int, views: str = "") -> str:
    """Name the partition of counts of pairs: "aligned3"; `views` marks other than the published."""
    return f"{protocol}{sets}-{views}".rstrip("-")


def protocol_of(partition: str) -> Protocol | None:
    """Return the protocol of a partition; None: the counts are of single frames."""
    found = re.fullmatch(r"([a-z]+)\d+(-[0-9a-f]+)?", partition)
    return next((known for known in PROTOCOLS if found and found[1] == known), None)


def frames(pairs: Matrices) -> Scores:
    """Count pixels of a class in both, in the first and in the second frame: (..., S, 3, K)."""
    return tally(_by_set(pairs).sum(-3))


def tc(frames: Scores, absent: Absent) -> Scores:
    """Compute temporal consistency of each class, 0..1: IoU of the two predictions.

        |P1 = P2 = c| / |P1 = c or P2 = c|,  of every set alone, then the mean over the S sets

    Source: Temporal, Fig. 4; release, evaluation code, whose denominator has 1e-10 more. By
    `absent`, a class that neither frame of a set shows is left out of the mean over the sets.
    """
    return _over_sets(iou(frames, absent))


def triples(pairs: Matrices, *, only_labelled: bool = False) -> Scores:
    """Count what all three say, the sum of three sizes, and of overlaps of two: (..., S, 3, K).

    With `only_labelled`, pixels without a label are left out.
    """
    by_set = _by_set(pairs)
    labelled = by_set[..., :-1, :, :]
    both = (labelled if only_labelled else by_set).sum(-3)
    three = np.einsum("...ccc->...c", labelled)
    sizes = both.sum(-1) + both.sum(-2) + labelled.sum((-1, -2))
    twos = (both, labelled.sum(-1), labelled.sum(-2))
    overlaps: Scores = np.sum([np.diagonal(x, axis1=-2, axis2=-1) for x in twos], axis=0)
    return np.stack((three, sizes, overlaps), axis=-2)


def ca(triples: Scores, absent: Absent) -> Scores:
    """Compute consistent accuracy, as `tc`. Source: Temporal, Fig. 4 (E over A + ... + G).

    |P1 = P2 = Y2 = c| / |P1 = c or P2 = c or Y2 = c|
    """
    three, sizes, overlaps = rows(triples)
    return _over_sets(ratio(three, sizes - overlaps + three, absent))


def ca_released(triples: Scores, absent: Absent) -> Scores:
    """Compute `ca` as coded (Temporal release), which counts what two of three share twice.

    |P1 = P2 = Y2 = c| / (|P1 = c| + |P2 = c| + |Y2 = c| - 2 |P1 = P2 = Y2 = c|)
    """
    three, sizes, _ = rows(triples)
    return _over_sets(ratio(three, sizes - 2 * three, absent))


def changed(pairs: Matrices) -> Scores:
    """Count pixels by class of the first frame: with another class in the second, and all.

    The result is (..., 2, K), summed over the S sets. Source: Lai et al. (ECCV 2018), with classes
    in place of colours.
    """
    both = _by_set(pairs).sum((-4, -3))
    every = both.sum(-1)
    return np.stack((every - np.diagonal(both, axis1=-2, axis2=-1), every), axis=-2)


def flickered(triples: Matrices) -> Scores:
    """Count pixels by the class of frame A: those with it in A and C but not in B, and all.

    The result is (..., 2, K), summed over the S sets.
    """
    by_class = _by_set(triples).sum(-4)[..., :-1, :, :]
    outer = np.einsum("...aba->...a", by_class)
    part = outer - np.einsum("...aaa->...a", by_class)
    return np.stack((part, by_class.sum((-2, -1))), axis=-2)


def _by_set(pairs: Matrices) -> Scores:
    """Split counts by set, (..., S, K + 1, K, K); float64: its sums of whole numbers are exact."""
    *leading, rows, classes, _ = pairs.shape
    if rows % (classes + 1):
        raise ValueError(f"pairs: expected S x {classes + 1} rows, got {rows}.")
    return np.asarray(pairs, np.float64).reshape(*leading, -1, classes + 1, classes, classes)


def _over_sets(scores: Scores) -> Scores:
    return class_mean(np.swapaxes(scores, -1, -2))
