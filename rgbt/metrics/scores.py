"""Compute all scores from counts.

Counts are (..., K, K), rows = label, columns = prediction. A score reads their `tally`: three
numbers of pixels by class (..., 3, K), which add up over images and regions. Those of boundaries
(`rgbt.metrics.details`) are tallies already. Scores of classes are (..., K), means over the scored
ones (`rgbt.metrics.counts.Counts.scored`) are (...): fractions 0..1; variances are in squared
percent points, as the papers print them.

A score whose denominator has no pixel (0 / 0) is, by `absent`:
    "released": 0 and takes part in means, as in the CRM and SpatialSeg releases and their tables,
                and in the averages that the RTFNet and Temporal releases report.
    "exclude":  NaN and is left out of means, as in the CMX release. Where labels hold one scored
                class of several, nothing is separated: a mean over classes is NaN as well.
The denominator decides, by score and by region: IoU and F1 lack one where the class is neither
labelled nor predicted, recall where it is not labelled, precision where it is not predicted. One
false pixel of a class that no label holds makes its IoU 0 with either convention.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import UNITS
from rgbt.metrics.metric import Absent

Scores = NDArray[np.float64]
Matrices = NDArray[np.integer] | NDArray[np.float64]
Scored = NDArray[np.bool_] | None  # (K,): which classes means are over; None: all
ByClass = Callable[[Scores, Absent], Scores]  # sums of counts -> fractions (..., K)


def tally(counts: Matrices) -> Scores:
    """Count right, labelled and predicted pixels by class: (..., K, K) -> (..., 3, K) float64.

    That is TP, TP + FN and TP + FP. Sums of whole numbers are exact in float64.
    """
    right = np.diagonal(counts, axis1=-2, axis2=-1)
    sums = (right, counts.sum(-1, dtype=np.float64), counts.sum(-2, dtype=np.float64))
    return np.stack(sums, axis=-2, dtype=np.float64)


def rows(sums: Scores) -> tuple[Scores, ...]:
    """Split sums (..., M, K) into M arrays (..., K)."""
    return tuple(sums[..., row, :] for row in range(sums.shape[-2]))


def iou(tallies: Scores, absent: Absent) -> Scores:
    """Compute intersection over union: ``TP / (TP + FP + FN)`` (SpatialSeg, Eq. 18).

    Of counts of boundaries it is ``|G_d and P_d| / |G_d or P_d|``, the boundary IoU.
    """
    right, labelled, predicted = rows(tallies)
    return ratio(right, labelled + predicted - right, absent)


def recall(tallies: Scores, absent: Absent) -> Scores:
    """Compute ``TP / (TP + FN)`` of each class, "Acc" in the papers' tables."""
    right, labelled, _ = rows(tallies)
    return ratio(right, labelled, absent)


def precision(tallies: Scores, absent: Absent) -> Scores:
    """Compute ``TP / (TP + FP)`` of each class."""
    right, _, predicted = rows(tallies)
    return ratio(right, predicted, absent)


def f1(tallies: Scores, absent: Absent) -> Scores:
    """Compute ``2 TP / (2 TP + FP + FN)``; released (Temporal): NaN for a class never found."""
    right, labelled, predicted = rows(tallies)
    return ratio(2 * right, labelled + predicted, absent)


def class_mean(scores: Scores, scored: Scored = None) -> Scores:
    """Average scored classes without NaN, (..., K) -> (...); NaN where nothing is left."""
    known = ~np.isnan(scores)
    chosen = known if scored is None else known & scored
    return _divide(np.where(chosen, scores, 0.0).sum(-1), chosen.sum(-1), np.nan)


def miou(tallies: Scores, absent: Absent, scored: Scored) -> Scores:
    """Average `iou` over the scored classes; that of the tables is of the regions summed."""
    return _mean(iou, tallies, absent, scored)


def _mean(score: ByClass, tallies: Scores, absent: Absent, scored: Scored) -> Scores:
    """Average a score over the scored classes; NaN where labels are of one class alone."""
    _, labelled, _ = rows(tallies)
    is_alone = _is_alone(labelled > 0, scored, absent)
    return np.where(is_alone, np.nan, class_mean(score(tallies, absent), scored))


def _is_alone(labelled: NDArray[np.bool_], scored: Scored, absent: Absent) -> NDArray[np.bool_]:
    """Return whether one of several scored classes is labelled, and absent ones left out."""
    labelled = labelled if scored is None else labelled[..., scored]
    several = absent == "exclude" and labelled.shape[-1] > 1
    return np.asarray((labelled.sum(-1) == 1) & several)


def variance(region_scores: ArrayLike) -> Scores:
    """Compute ``10^4 / R  sum_r (s_r - mean s)^2`` without NaN: fractions (..., R) -> (...).

    Source: SpatialSeg, Eq. 19.
    """
    percents = 100 * np.asarray(region_scores, dtype=np.float64)
    distances = percents - class_mean(percents)[..., None]
    return class_mean(distances**2)


def pixel_accuracy(tallies: Scores) -> Scores:
    """Compute the share of valid pixels, of unscored classes too, that are right; NaN: none."""
    right, labelled, _ = rows(tallies)
    return _divide(right.sum(-1), labelled.sum(-1), np.nan)


def ece(counts: Matrices) -> Scores:
    """Compute ``sum_b |correct_b - confidence_b| / sum_b number_b`` of counts (..., M, 3, K).

    That is the mean over pixels of ``|acc(B_m) - conf(B_m)|``, those of unscored classes included;
    NaN without pixels. Source: Guo et al.: "On Calibration of Modern Neural Networks", ICML 2017,
    Eq. 3, with M equal bins (0, 1/M], (1/M, 2/M], ... of the highest probability of each pixel.
    """
    number, correct, confidence = np.moveaxis(counts.sum(-1, dtype=np.float64), -1, 0)
    gaps = np.abs(correct - confidence / UNITS).sum(-1)
    return _divide(gaps, number.sum(-1), np.nan)


def object_recall(tallies: Scores) -> Scores:
    """Compute recall among the pixels of objects; NaN without an object of that size."""
    return recall(tallies, "exclude")


# Tallies -> means over the scored classes (...).
MEANS: dict[str, Callable[[Scores, Absent, Scored], Scores]] = {
    names.MIOU: miou,
    names.MACC: partial(_mean, recall),
    names.MPRECISION: partial(_mean, precision),
    names.MF1: partial(_mean, f1),
    names.PIXEL_ACCURACY: lambda tallies, _, __: pixel_accuracy(tallies),
}


def summary(counts: Counts, absent: Absent) -> dict[str, float]:
    """Compute every score that is followed over a run, by its name in `rgbt.metrics.names`."""
    by_region, scored = tally(counts.by_region()), counts.scored
    whole = by_region.sum(0)
    result = _mean_and_variance(counts, absent)
    result |= {name: float(mean(whole, absent, scored)) for name, mean in MEANS.items()}
    for number, score in enumerate(miou(by_region, absent, scored), start=1):
        result[names.region(number)] = float(score)
    for name, score in zip(counts.classes, iou(whole, absent), strict=True):
        result[names.class_iou(name)] = float(score)
    for part, subset in counts.parts().items():
        for name, value in _mean_and_variance(subset, absent).items():
            result[names.subset(part, name)] = value
    return result


def extremes(counts: Counts) -> dict[str, tuple[str, float]]:
    """Name the "best", "median" and "worst" image, each with its mIoU in percent.

    It is over the scored classes that its label or prediction hold, because a single image lacks
    most classes. Of an even number of images the median is the upper one of the two in the middle;
    of fewer than three images there are fewer entries.
    """
    scores = 100 * miou(tally(counts.counts.sum(1)), "exclude", counts.scored)
    ranked = np.argsort(scores, kind="stable")[: np.count_nonzero(~np.isnan(scores))]
    if not len(ranked):
        return {}
    words = {0: "worst", len(ranked) // 2: "median", len(ranked) - 1: "best"}
    found = {}
    for place in sorted(words, reverse=True):
        image = ranked[place]
        found[words[place]] = counts.names[image], float(scores[image])
    return found


def _mean_and_variance(counts: Counts, absent: Absent) -> dict[str, float]:
    by_region = tally(counts.by_region())
    return {
        names.MIOU: float(miou(by_region.sum(0), absent, counts.scored)),
        names.VAR: float(variance(miou(by_region, absent, counts.scored))),
    }


def absent_rule(absent: Absent) -> str:
    """Say below a table how classes without a pixel count."""
    counted = {"released": "counts as 0", "exclude": "is left out of means"}[absent]
    return f"A class without a pixel {counted} (absent={absent})."


def absent_notes(
    by_region: NDArray[np.integer],
    classes: Sequence[str],
    scored: NDArray[np.bool_],
    split: str,
    absent: Absent,
) -> tuple[str, ...]:
    """Write footnotes of a class table from (R, K, K) counts: absent classes change the means.

    Classes that are neither labelled nor predicted, that are predicted only, and that some regions
    lack; and where means are undefined.
    """
    counted = {"released": "counted as 0", "exclude": "left out of the mean"}[absent]
    labelled = by_region.sum(-1) > 0
    there = labelled | (by_region.sum(-2) > 0)
    gone, unlabelled = ~there.any(0), there.any(0) & ~labelled.any(0)
    lacks = []
    for index in np.flatnonzero(scored & there.any(0) & ~there.all(0)).tolist():
        regions = [str(number) for number in (np.flatnonzero(~there[:, index]) + 1)]
        lacks.append(f"{classes[index]} (region{'s' * (len(regions) > 1)} {', '.join(regions)})")
    named = {
        f"absent from the {split} split: {{}} ({counted})": np.array(classes)[scored & gone],
        f"predicted, but not labelled in the {split} split: {{}} (IoU 0)": np.array(classes)[
            scored & unlabelled
        ],
        f"absent from some regions: {{}}; {counted} there": lacks,
    }
    notes = [note.format(", ".join(found)) for note, found in named.items() if len(found)]
    places = (labelled.any(0), *labelled)  # the whole image, then its regions
    alone = [n for n, classes_of in enumerate(places) if _is_alone(classes_of, scored, absent)]
    if alone:
        where = ", ".join(f"region {place}" for place in alone)
        where = f"the {split} split" if alone[0] == 0 else where
        notes.append(f"labels of a single class in {where}: a mean over classes is undefined")
    return tuple(notes)


def ratio(part: Scores, whole: Scores, absent: Absent) -> Scores:
    """Divide ``part / whole``; where that is 0 / 0 as `absent` says. Shapes are kept."""
    return _divide(part, whole, 0.0 if absent == "released" else np.nan)


def _divide(part: Scores, whole: NDArray[np.generic], undefined: float) -> Scores:
    """Divide ``part / whole``, with `undefined` where the denominator is 0."""
    quotient: Scores = np.full(np.shape(part), undefined)
    np.divide(part, whole, out=quotient, where=np.asarray(whole) > 0)
    return quotient
