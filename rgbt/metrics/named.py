"""Compute scores from counts by the names that tables and comparisons use.

A name is ``[day/ or night/][class/<name>/][region/<n>/][score]``, where the score is one of
`SCORES`; distance and size are followed by a bin: ``class/car/region/1/size/64-256``. Without a
score, ``region/<n>`` is the mIoU of region n, and ``class/<name>`` the IoU of a class. Means are
over the scored classes (`Counts.scored`); every single class is available by name.
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

PAIR_SCORES: dict[str, ByClass] = {
    names.TC: pairs.tc,
    names.CA: pairs.ca,
    names.CA_RELEASED: pairs.ca_released,
}
# Pixels that change and all pixels (..., K), by the class of the first frame.
CHANGES: dict[str, Callable[[Matrices], tuple[Scores, Scores]]] = {
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
    **dict.fromkeys((names.BOUNDARY_MIOU, names.BOUNDARY_IOU), scores.boundary_iou),
    names.SIZE: lambda counts, _: scores.object_recall(counts),
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
    return float(values(parsed, by_region, counts, absent))


def values(
    parsed: ParsedMetric, by_region: Matrices, like: Counts, absent: Absent
) -> NDArray[np.float64]:
    """Compute a score (...) of many summed counts, e.g. one per resample; see also `value`.

    Args:
        parsed: the score; its part (day, night) has been taken by `images_of` before summing.
        by_region: (..., R, K, K), summed over images; of details (..., R G, M, K).
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
        part, every = CHANGES[parsed.score](by_region)
        if index is None:
            part, every = part.sum(-1), every.sum(-1)
        else:
            part, every = part[..., index], every[..., index]
        return 100.0 * np.divide(part, every, out=np.full_like(every, np.nan), where=every > 0)
    if parsed.score in PAIR_SCORES:
        return mean_or_class(100.0 * pair_scores(parsed.score, by_region, like.partition, absent))
    if parsed.score == names.VAR:
        return scores.variance(scores.miou(by_region, absent, like.scored))
    groups = 1 if details is None else details.groups
    *leading, _, measures, classes = by_region.shape
    chosen = _of_region(parsed, by_region.reshape(*leading, -1, groups, measures, classes))
    if parsed.score == names.ECE:
        return 100.0 * scores.ece(chosen if index is None else chosen[..., index : index + 1])
    group = chosen[..., details.bins.index(parsed.bin) if details and parsed.bin else 0, :, :]
    if parsed.score in MEANS:
        return 100.0 * MEANS[parsed.score](group, absent, like.scored)
    return 100.0 * mean_or_class(CLASS_SCORES[parsed.score](group, absent))


def pair_scores(score: str, by_region: Matrices, partition: str, absent: Absent) -> Scores:
    """Compute one of `PAIR_SCORES` by class (..., K); along estimated flow CA is of labels."""
    if pairs.protocol_of(partition) == "flow" and score != names.TC:
        known = pairs.only_labelled(by_region)
        without = np.isnan(known[..., :1, 0, 0])
        return np.where(without, np.nan, PAIR_SCORES[score](np.nan_to_num(known), absent))
    return PAIR_SCORES[score](by_region, absent)


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


def _of_region(parsed: ParsedMetric, by_region: Matrices) -> Matrices:
    """Take the region of a metric, or add all: (..., R, G, M, K) -> (..., G, M, K)."""
    regions = by_region.shape[-4]
    if parsed.region is None:
        return np.asarray(by_region.sum(-4))
    if parsed.region > regions:
        raise InputError(f"'{parsed.metric}': the counts have the regions 1 to {regions}.")
    return by_region[..., parsed.region - 1, :, :, :]
