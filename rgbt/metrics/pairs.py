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

Scores take counts (..., S (K + 1), K, K), summed over images, and return (..., K) by class.
"""

from __future__ import annotations

import re
from typing import Literal, get_args

import numpy as np

from rgbt.metrics import names
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import Matrices, Scores, class_mean, iou, ratio

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


def tc(pairs: Matrices, absent: Absent) -> Scores:
    """Compute temporal consistency of each class, 0..1: IoU of the two predictions.

        |P1 = P2 = c| / |P1 = c or P2 = c|,  of every set alone, then the mean over the S sets

    Source: Temporal, Fig. 4; release, evaluation code, whose denominator has 1e-10 more. By
    `absent`, a class that neither frame of a set shows is left out of the mean over the sets.
    """
    return _over_sets(iou(_by_set(pairs).sum(-3), absent))


def ca(pairs: Matrices, absent: Absent) -> Scores:
    """Compute consistent accuracy, as `tc`. Source: Temporal, Fig. 4 (E over A + ... + G).

    |P1 = P2 = Y2 = c| / |P1 = c or P2 = c or Y2 = c|
    """
    three, sizes, overlaps = _triples(pairs)
    return _over_sets(ratio(three, sizes - overlaps + three, absent))


def ca_released(pairs: Matrices, absent: Absent) -> Scores:
    """Compute `ca` as coded (Temporal release), which counts what two of three share twice.

    |P1 = P2 = Y2 = c| / (|P1 = c| + |P2 = c| + |Y2 = c| - 2 |P1 = P2 = Y2 = c|)
    """
    three, sizes, _ = _triples(pairs)
    return _over_sets(ratio(three, sizes - 2 * three, absent))


def only_labelled(pairs: Matrices) -> Scores:
    """Remove pixels without a label from counts; NaN where no pixel has one."""
    by_set = _by_set(pairs).copy()
    by_set[..., -1, :, :] = 0
    known = by_set.any((-4, -3, -2, -1), keepdims=True)
    return np.where(known, by_set, np.nan).reshape(pairs.shape)


def changed(pairs: Matrices) -> tuple[Scores, Scores]:
    """Count pixels by class of the first frame: with another class in the second, and all.

    Source: Lai et al. (ECCV 2018), with classes in place of colours. Summed over the S sets.
    """
    frames = _by_set(pairs).sum((-4, -3))
    every = frames.sum(-1)
    return every - np.diagonal(frames, axis1=-2, axis2=-1), every


def flickered(triples: Matrices) -> tuple[Scores, Scores]:
    """Count pixels by the class of frame A: those with it in A and C but not in B, and all."""
    rows = _by_set(triples).sum(-4)[..., :-1, :, :]
    outer = np.einsum("...aba->...a", rows)
    return outer - np.einsum("...aaa->...a", rows), rows.sum((-2, -1))


def _triples(pairs: Matrices) -> tuple[Scores, Scores, Scores]:
    """Count what all three say, the sum of three sizes, and of overlaps of two: (..., S, K)."""
    by_set = _by_set(pairs)
    labelled = by_set[..., :-1, :, :]
    frames = by_set.sum(-3)
    three = np.einsum("...ccc->...c", labelled)
    sizes = frames.sum(-1) + frames.sum(-2) + labelled.sum((-1, -2))
    twos = (frames, labelled.sum(-1), labelled.sum(-2))
    overlaps: Scores = np.sum([np.diagonal(x, axis1=-2, axis2=-1) for x in twos], axis=0)
    return three, sizes, overlaps


def _by_set(pairs: Matrices) -> Scores:
    """Split counts by set, (..., S, K + 1, K, K); float64: its sums of whole numbers are exact."""
    *leading, rows, classes, _ = pairs.shape
    if rows % (classes + 1):
        raise ValueError(f"pairs: expected S x {classes + 1} rows, got {rows}.")
    return np.asarray(pairs, np.float64).reshape(*leading, -1, classes + 1, classes, classes)


def _over_sets(scores: Scores) -> Scores:
    return class_mean(np.swapaxes(scores, -1, -2))
