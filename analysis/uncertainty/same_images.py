"""Whether counts are of the same images and labels, and the same counts in one order."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts, check_same_means
from rgbt.metrics.details import LABEL, NUMBER, details_of
from rgbt.metrics.pairs import protocol_of

# What counts must have in common beside the names of images and the classes: the labelled pixels
# of each region; those of the whole image where the regions differ, if both are of single frames or
# of the same pairs; or nothing else.
Alike = Literal["pixels", "labels", "names"]


def in_order(first: Counts, other: Counts, alike: Alike) -> Counts:
    """Return `other` with its images in the order of `first`.

    Raises:
        InputError: other images, classes, scored classes, labels or regions.
    """
    check_same_kind(first, other, alike)
    only = sorted(set(first.names) ^ set(other.names))
    if only:
        raise InputError(
            f"the counts are not of the same images: {len(first.names)} of split '{first.split}' "
            f"against {len(other.names)} of split '{other.split}', '{only[0]}' is in only one; "
            "score both on one split."
        )
    same = other if other.names == first.names else other.select(first.names)
    if None not in (first.night, same.night) and first.night != same.night:
        raise InputError("the counts do not agree about which images were taken at night.")
    if alike != "names":
        _check_labels(first, same)
    return same


def check_same_kind(first: Counts, other: Counts, alike: Alike) -> None:
    """Refuse counts of other classes, scored classes or, unless `alike` is "labels", regions."""
    if other.classes != first.classes:
        raise InputError(
            f"counts of the classes {', '.join(first.classes)} cannot be compared with counts of "
            f"{', '.join(other.classes)}; score both on one data set."
        )
    check_same_means(first, other)
    if alike != "labels" and other.partition != first.partition:
        raise InputError(
            f"counts by {first.partition} cannot be compared with counts by {other.partition}: "
            "the regions, or the second frames of pairs, differ. Measure both in the same way."
        )


def _check_labels(first: Counts, same: Counts) -> None:
    """Compare the labelled pixels of every image, by region where both have the same regions."""
    if first.partition == same.partition:
        labelled, of_same = _labelled(first), _labelled(same)
    elif _kind(first) is None and _kind(same) is None:
        labelled = first.counts.sum((1, -1), dtype=np.int64)
        of_same = same.counts.sum((1, -1), dtype=np.int64)
    else:
        return
    differs = (labelled != of_same).reshape(len(first.names), -1)
    unequal = np.flatnonzero(differs.any(1))
    if len(unequal):
        raise InputError(
            f"'{first.names[unequal[0]]}' has different labels in the two counts "
            f"({len(unequal)} images do); score both on the same labels at the same size."
        )


def _kind(counts: Counts) -> str | None:
    """Return the protocol of pairs or the kind of details; None: confusion matrices of regions."""
    details = details_of(counts.partition)
    return protocol_of(counts.partition) if details is None else details.kind


def _labelled(counts: Counts) -> NDArray[np.int64]:
    """Return the numbers of pixels (N, ...) that depend on the labels alone."""
    array, kind = counts.counts, _kind(counts)
    if kind == "boundary":
        return array[:, :, LABEL].astype(np.int64)
    if kind == "calibration":
        # Bins and classes are those of the prediction; only their sum over a region is not.
        details = details_of(counts.partition)
        groups = details.groups if details else 1
        number = array[:, :, NUMBER].sum(-1).reshape(len(array), -1, groups)
        return np.asarray(number.sum(-1, dtype=np.int64))
    # Labels are rows; of pairs of frames a matrix each; of triples every index is a prediction.
    axes = {None: (-1,), "distance": (-1,), "size": (-1,), "triples": (-3, -2, -1)}
    return np.asarray(array.sum(axes.get(kind, (-2, -1)), dtype=np.int64))
