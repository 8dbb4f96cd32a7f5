"""Compute scores from counts by the names that tables and comparisons use.

A name is ``[day/ or night/][class/<name>/][region/<n>/][score]``, where the score is one of
`SCORES`; distance and size are followed by a bin: ``class/car/region/1/size/64-256``. Without a
score, ``region/<n>`` is the mIoU of region n, and ``class/<name>`` the IoU of a class. Means are
over the scored classes (`Counts.scored`); every single class is available by name.

A score is computed in two steps: `sums_of` is linear in the counts, so that it may be taken before
images are added; `values` is the rest.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, nearest
from rgbt.metrics import names, pairs, scores
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import KINDS, DetailKind, details_of
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import MEANS, ByClass, Matrices, Scores

Sums = Callable[[Matrices], Scores]  # linear

PAIR_SCORES: dict[str, tuple[Sums, ByClass]] = {
    names.TC: (pairs.frames, pairs.tc),
    names.CA: (pairs.triples, pairs.ca),
    names.CA_RELEASED: (pairs.triples, pairs.ca_released),
}
# Pixels that change and all pixels (..., 2, K), by the class of the first frame.
CHANGES: dict[str, Sums] = {
    names.WARPING_ERROR: pairs.changed,
    names.FLICKER: pairs.flickered,
}
SCORES_OF: dict[pairs.Protocol, tuple[str, ...]] = {
    "aligned": (*PAIR_SCORES, names.WARPING_ERROR),
    "released": tuple(PAIR_SCORES),
    "next": (*PAIR_SCORES, names.WARPING_ERROR),
    "flow": (*PAIR_SCORES, names.WARPING_ERROR),
    "triples": (names.FLICKER,),
}
CLASS_SCORES: dict[str, ByClass] = {
    "IoU": scores.iou,
    "acc": scores.recall,
    names.DISTANCE: scores.iou,
    **dict.fromkeys((names.BOUNDARY_MIOU, names.BOUNDARY_IOU), scores.iou),
    names.SIZE: lambda tallies, _: scores.object_recall(tallies),
}
SINGLE, PAIRS = "single frames", "pairs of frames"
EVERYWHERE = ("", "region", "class", "class region")
# Score -> the counts that have it, and what may be named before it.
SCORES: dict[str, tuple[str, tuple[str, ...]]] = {
    **dict.fromkeys((*MEANS, names.VAR), (SINGLE, ("",))),
    "acc": (SINGLE, ("class",)),
    **dict.fromkeys((*PAIR_SCORES, *CHANGES), (PAIRS, ("", "class"))),
    names.BOUNDARY_MIOU: ("boundary", ("", "region")),
    names.BOUNDARY_IOU: ("boundary", ("class", "class region")),
    names.ECE: ("calibration", EVERYWHERE),
    names.DISTANCE: ("distance", EVERYWHERE),
    names.SIZE: ("size", EVERYWHERE),
}

NAME = re.compile(
    r"((?P<part>day|night)/)?(class/(?P<name>[^/]+)(/|$))?(region/(?P<region>[1-9]\d*)(/|$))?"
    r"(?P<score>[A-Za-z]\w*)?(/(?P<bin>\d+(\.\d+)?-(\d+(\.\d+)?|inf)))?"
)


@dataclass(frozen=True)
class ParsedMetric:
    """A metric name, taken apart: None for all images, classes, regions (from 1); "" for no bin."""

    metric: str
    part: str | None
    score: str
    class_name: str | None = None
    region: int | None = None
    bin: str = ""

    @property
    def needs(self) -> str:
        """Return the counts that have the score, in words."""
        return SCORES.get(self.score, (SINGLE,))[0]

    @property
    def details(self) -> DetailKind | None:
        """Return the kind of details that have the score; None: other counts."""
        return self.needs if self.needs in KINDS else None

    @property
    def sums(self) -> tuple[str | None, bool, Sums]:
        """Return what it reads of counts: part, whether by region, and how; see `sums_of`."""
        pair_score, _ = PAIR_SCORES.get(self.score, (scores.tally, None))
        by_region = self.region is not None or self.score == names.VAR
        return self.part, by_region, CHANGES.get(self.score, pair_score)


def parse(metric: str) -> ParsedMetric:
    """Take a metric name apart; InputError: it is none, with the nearest one."""
    if (found := NAME.fullmatch(metric)) and not metric.endswith("/"):
        scope = f"{'class ' * bool(found['name'])}{'region' * bool(found['region'])}".strip()
        score, which = found["score"], found["bin"] or ""
        is_binned = score in (names.DISTANCE, names.SIZE)
        is_known = scope in SCORES.get(score, ("", ()))[1] if score else bool(scope)
        if is_known and bool(which) == is_binned:
            region = int(found["region"]) if found["region"] else None
            score = score or ("IoU" if found["name"] else names.MIOU)
            return ParsedMetric(metric, found["part"], score, found["name"], region, which)
    known = nearest(re.sub("^(day|night)/", "", metric), [*SCORES, "region/<n>", "class/<name>"])
    raise InputError(f"'{metric}' is not a metric; {known}; each also as day/ or night/...")


def value(metric: str, counts: Counts, absent: Absent) -> float:
    """Compute the score called `metric`: percent 0..100; the variance in squared percent points.

    NaN: nothing to score. `absent`: how a class without pixels counts, see `rgbt.metrics.scores`.

    Raises:
        InputError: no such metric, class or region, or one that such counts do not have.
    """
    parsed = parse(metric)
    by_region = images_of(parsed, counts).by_region()
    return float(values(parsed, sums_of(parsed, by_region, counts.partition), counts, absent))


def sums_of(parsed: ParsedMetric, counts: Matrices, partition: str) -> Scores:
    """Return all that a score reads of counts, float64; scores with equal `sums` read the same.

    It is linear: the sums of several images add up to those of the images together, exactly.

    Args:
        parsed: the score; its part (day, night) is that of the images, see `images_of`.
        counts: (..., R, K, K), of details (..., R G, M, K).
        partition: of the counts, which have the score (`check_kind`).

    Returns:
        of single frames and details (..., R, G, 3, K), with R = 1 for the whole image; of pairs
        (..., S, 3, K), or (..., 2, K) of `CHANGES`.
    """
    _, by_region, sums = parsed.sums
    if protocol := pairs.protocol_of(partition):
        if protocol == "flow" and sums is pairs.triples:  # labels may be missing
            return pairs.triples(counts, only_labelled=True)
        return sums(counts)
    details = details_of(partition)
    *leading, _, measures, classes = counts.shape
    groups = 1 if details is None else details.groups
    grouped = counts.reshape(*leading, -1, groups, measures, classes)
    if not by_region:
        grouped = grouped.sum(-4, keepdims=True)
    is_tally = details is not None and details.kind in ("boundary", "calibration")
    return grouped.astype(np.float64) if is_tally else scores.tally(grouped)


def values(parsed: ParsedMetric, sums: Scores, like: Counts, absent: Absent) -> NDArray[np.float64]:
    """Compute a score (...) of many sums, e.g. one per resample; see also `value`.

    Args:
        parsed: the score.
        sums: what it reads of summed counts, see `sums_of`.
        like: counts of the same classes, scored ones and partition; nothing else of it is used.
        absent: see `value`.
    """
    check_kind(parsed, like.partition)
    name, details = parsed.class_name, details_of(like.partition)
    if name is not None and name not in like.classes:
        raise InputError(f"'{parsed.metric}': no class '{name}'; {nearest(name, like.classes)}.")
    index = None if name is None else like.classes.index(name)

    def mean_or_class(by_class: Scores) -> Scores:
        mean = scores.class_mean(by_class, like.scored) if index is None else by_class[..., index]
        return np.asarray(mean)

    if parsed.score in CHANGES:
        part, every = scores.rows(sums)
        if index is None:
            part, every = part.sum(-1), every.sum(-1)
        else:
            part, every = part[..., index], every[..., index]
        return 100.0 * np.divide(part, every, out=np.full_like(every, np.nan), where=every > 0)
    if parsed.score in PAIR_SCORES:
        return mean_or_class(100.0 * _pair_scores(parsed.score, sums, like.partition, absent))
    if parsed.score == names.VAR:
        return scores.variance(scores.miou(sums[..., 0, :, :], absent, like.scored))
    chosen = _of_region(parsed, sums)
    if parsed.score == names.ECE:
        return 100.0 * scores.ece(chosen if index is None else chosen[..., index : index + 1])
    group = chosen[..., details.bins.index(parsed.bin) if details and parsed.bin else 0, :, :]
    if parsed.score in MEANS:
        return 100.0 * MEANS[parsed.score](group, absent, like.scored)
    return 100.0 * mean_or_class(CLASS_SCORES[parsed.score](group, absent))


def pair_scores(score: str, counts: Counts, absent: Absent) -> Scores:
    """Compute one of `PAIR_SCORES` by class (K,); along estimated flow, CA of labelled pixels."""
    sums = sums_of(ParsedMetric(score, None, score), counts.by_region(), counts.partition)
    return _pair_scores(score, sums, counts.partition, absent)


def _pair_scores(score: str, sums: Scores, partition: str, absent: Absent) -> Scores:
    """Compute the same (..., K) of sums; NaN of CA where no pixel has a label."""
    _, by_class = PAIR_SCORES[score]
    found = by_class(sums, absent)
    if pairs.protocol_of(partition) == "flow" and score != names.TC:
        _, sizes, _ = scores.rows(sums)
        without = sizes.sum((-2, -1)) == 0
        return np.where(without[..., None], np.nan, found)
    return found


def check_kind(parsed: ParsedMetric, partition: str) -> None:
    """Refuse a score of other counts; InputError says how these are made."""
    details, protocol = details_of(partition), pairs.protocol_of(partition)
    has = details.kind if details else PAIRS if protocol else SINGLE
    these = f"these counts ({partition})"
    if has != parsed.needs:
        command = "consistency" if parsed.needs == PAIRS else "evaluate"
        option = f" details={parsed.details}" if parsed.details else ""
        said = f"'{parsed.metric}' is a score of {parsed.needs}, but {these} are of {has}"
        raise InputError(f"{said}; use counts of rgbt {command} run=...{option}")
    known = SCORES_OF[protocol] if protocol else details.bins if details else ()
    word = parsed.score if protocol else parsed.bin
    if word and known and word not in known:
        raise InputError(f"'{parsed.metric}': {these} have {', '.join(known)}; use one of these.")


def images_of(parsed: ParsedMetric, counts: Counts) -> Counts:
    """Return the images that a metric is over: all, day or night; InputError: not both."""
    check_kind(parsed, counts.partition)
    if parsed.part is None:
        return counts
    parts = counts.parts()
    if parsed.part not in parts:
        both = "both images marked as day and images marked as night"
        raise InputError(f"'{parsed.metric}': split '{counts.split}' does not contain {both}.")
    return parts[parsed.part]


def details_of_metric(metric: str) -> DetailKind | None:
    """Return the kind of details that a metric name needs; None: other counts, or no metric."""
    found = NAME.fullmatch(metric)
    return ParsedMetric(metric, None, found["score"] or "").details if found else None


def _of_region(parsed: ParsedMetric, sums: Scores) -> Scores:
    """Take the region of a metric, or add all: (..., R, G, M, K) -> (..., G, M, K)."""
    regions = sums.shape[-4]
    if parsed.region is None:
        return np.asarray(sums.sum(-4))
    if parsed.region > regions:
        raise InputError(f"'{parsed.metric}': the counts have the regions 1 to {regions}.")
    return sums[..., parsed.region - 1, :, :, :]
