"""Compute scores from counts by the names that tables and comparisons use.

``[day/ or night/]`` and then one of ``mIoU Var mAcc mPrecision mF1 pixel_accuracy``, ``region/<n>``
(mIoU of region n), ``class/<name>`` (IoU), ``class/<name>/acc``, ``class/<name>/region/<n>``; of
counts of pairs of frames (`rgbt.metrics.pairs`) ``TC CA CA_released`` and ``class/<name>/TC`` etc.;
``warping_error`` and ``class/<name>/warping_error``, of three frames ``flicker``;
of details (`rgbt.metrics.details`) ``boundary_mIoU ECE distance/<bin> size/<bin>``, each also after
``region/<n>/`` and ``class/<name>/`` (there ``boundary_IoU``), as in
``class/car/region/1/size/64-256``.
Means are over the scored classes (`Counts.scored`); every single class is available by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, nearest
from rgbt.metrics import names, pairs
from rgbt.metrics.boundary import boundary_iou
from rgbt.metrics.calibration import ece
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import DetailKind, Details, details_of, parse_detail
from rgbt.metrics.metric import Absent
from rgbt.metrics.scene_counts import object_recall
from rgbt.metrics.scores import MEANS, Matrices, Scores, class_mean, iou, miou, recall, variance

OF_PAIRS: dict[str, Callable[[Matrices, Absent], Scores]] = {
    names.TC: pairs.tc,
    names.CA: pairs.ca,
    names.CA_RELEASED: pairs.ca_released,
}
"""Scores by class of (..., S (K + 1), K, K) counts of pairs of frames as fractions (..., K)."""

CHANGES: dict[str, Callable[[Matrices], tuple[Scores, Scores]]] = {
    names.WARPING_ERROR: pairs.changed,
    names.FLICKER: pairs.flickered,
}
"""Pixels that change and all pixels (..., K), by the class of the first frame."""

SCORES_OF: dict[pairs.Protocol, tuple[str, ...]] = {
    "aligned": (*OF_PAIRS, names.WARPING_ERROR),
    "released": tuple(OF_PAIRS),
    "next": (*OF_PAIRS, names.WARPING_ERROR),
    "flow": (*OF_PAIRS, names.WARPING_ERROR),
    "triples": (names.FLICKER,),
}
"""Protocol of pairs of frames -> the scores of its counts."""

FORMS = (
    *("region/<n>", "class/<name>", "class/<name>/acc", "class/<name>/region/<n>"),
    *(names.of_class("<name>", score) for score in (*OF_PAIRS, *CHANGES)),
    *(names.BOUNDARY_MIOU, names.ECE, f"class/<name>/{names.BOUNDARY_IOU}"),
    *(names.in_bin(kind, "<low>-<high>") for kind in (names.DISTANCE, names.SIZE)),
)


@dataclass(frozen=True)
class ParsedMetric:
    """A metric name, taken apart.

    Attributes:
        part: "day", "night", or None for all images.
        score: a mean over classes, "Var", "IoU", "acc", one of `OF_PAIRS` or `CHANGES`, or the
            kind of details.
        class_name: of one class alone, or None.
        region: number from 1, or None for the whole image.
        details: kind of details that have the score; None: other counts.
        bin: of distance and size, e.g. "10-20".
    """

    metric: str
    part: str | None
    score: str
    class_name: str | None = None
    region: int | None = None
    details: DetailKind | None = None
    bin: str = ""


def parse(metric: str) -> ParsedMetric:
    """Take a metric name apart.

    Raises:
        InputError: it is not a metric name; the message contains the nearest one.
    """
    words = metric.split("/")
    part = words.pop(0) if words[0] in (names.DAY, names.NIGHT) else None
    detail = parse_detail(words)
    if detail is not None:
        kind = detail.kind
        return ParsedMetric(metric, part, kind, detail.class_name, detail.region, kind, detail.bin)
    match words:
        case [score] if score in {*MEANS, *OF_PAIRS, *CHANGES, names.VAR}:
            return ParsedMetric(metric, part, score)
        case ["region", number] if _is_number(number):
            return ParsedMetric(metric, part, names.MIOU, region=int(number))
        case ["class", name] if name:
            return ParsedMetric(metric, part, "IoU", name)
        case ["class", name, "acc"] if name:
            return ParsedMetric(metric, part, "acc", name)
        case ["class", name, score] if name and score in {*OF_PAIRS, *CHANGES}:
            return ParsedMetric(metric, part, score, name)
        case ["class", name, "region", number] if name and _is_number(number):
            return ParsedMetric(metric, part, "IoU", name, int(number))
    known = nearest("/".join(words), [*MEANS, names.VAR, *OF_PAIRS, *CHANGES, *FORMS])
    raise InputError(
        f"'{metric}' is not a metric; {known}; each may have the prefix day/ or night/."
    )


def value(metric: str, counts: Counts, absent: Absent) -> float:
    """The score called `metric`: percent 0..100; the variance in squared percent points.

    NaN: nothing to score. `absent`: how a class without pixels counts, see `rgbt.metrics.scores`.

    Raises:
        InputError: no such metric, class or region, a metric that such counts do not have, or
            images without a time of day.
    """
    parsed = parse(metric)
    by_region = images_of(parsed, counts).by_region()
    return float(values(parsed, by_region, counts, absent))


def values(
    parsed: ParsedMetric, by_region: Matrices, like: Counts, absent: Absent
) -> NDArray[np.float64]:
    """The score of many summed counts at once, e.g. one per resample.

    Args:
        parsed: the score; its part (day, night) has been taken by `images_of` before summing.
        by_region: (..., R, K, K), summed over images; of details (..., R G, M, K).
        like: counts of the same classes, scored ones and partition; nothing else of it is used.
        absent: see `value`.

    Returns:
        (...), units as of `value`.

    Raises:
        InputError: no such class or region, or a metric that such counts do not have.
    """
    check_kind(parsed, like.partition)
    details = details_of(like.partition)
    if details is not None:
        return _of_details(parsed, details, by_region, like, absent)
    if parsed.score in CHANGES:
        return 100.0 * _share(parsed, *CHANGES[parsed.score](by_region), like.classes)
    if parsed.score in OF_PAIRS:
        by_class = 100.0 * pair_scores(parsed.score, by_region, like.partition, absent)
        if parsed.class_name is None:
            return class_mean(by_class, like.scored)
        return _of_class(parsed, by_class, like.classes)
    if parsed.score == names.VAR:
        return variance(miou(by_region, absent, like.scored))
    if parsed.region is None:
        matrices = by_region.sum(-3)
    else:
        matrices = by_region[..., _row(parsed, by_region.shape[-3]), :, :]
    if parsed.class_name is None:
        return 100.0 * MEANS[parsed.score](matrices, absent, like.scored)
    score = recall if parsed.score == "acc" else iou
    return _of_class(parsed, 100.0 * score(matrices, absent), like.classes)


def pair_scores(score: str, by_region: Matrices, partition: str, absent: Absent) -> Scores:
    """A score of `OF_PAIRS` by class, fractions (..., K).

    CA along an estimated flow is over labelled pixels; NaN without any.
    """
    if pairs.protocol_of(partition) == "flow" and score != names.TC:
        known = pairs.only_labelled(by_region)
        without = np.isnan(known[..., :1, 0, 0])
        return np.where(without, np.nan, OF_PAIRS[score](np.nan_to_num(known), absent))
    return OF_PAIRS[score](by_region, absent)


def _share(
    parsed: ParsedMetric, part: Scores, every: Scores, classes: tuple[str, ...]
) -> NDArray[np.float64]:
    """Share (...) of pixels (..., K), of all classes or of one; NaN without pixels."""
    if parsed.class_name is None:
        part, every = part.sum(-1), every.sum(-1)
    else:
        part, every = (_of_class(parsed, each, classes) for each in (part, every))
    return np.divide(part, every, out=np.full_like(every, np.nan), where=every > 0)


def check_kind(parsed: ParsedMetric, partition: str) -> None:
    """Refuse a score of pairs of frames or of details from other counts, and the other way round.

    Raises:
        InputError: such counts do not have it.
    """
    details = details_of(partition)
    kind = None if details is None else details.kind
    if parsed.details != kind:
        counted = f"these counts ({partition})"
        if parsed.details is not None:
            raise InputError(
                f"'{parsed.metric}' is a score of {parsed.details}, which {counted} do not have. "
                f"Count it with rgbt evaluate run=... details={parsed.details}"
            )
        raise InputError(
            f"'{parsed.metric}' is no score of {counted}. Use scores of {kind}, or name counts "
            "without details."
        )
    if details is not None:
        if parsed.bin and parsed.bin not in details.bins:
            raise InputError(
                f"'{parsed.metric}': the counts have the bins {', '.join(details.bins)}; use one "
                "of these, or count again with other edges (rgbt evaluate)."
            )
        return
    protocol = pairs.protocol_of(partition)
    is_of_pairs = parsed.score in OF_PAIRS or parsed.score in CHANGES
    if protocol and is_of_pairs and parsed.score not in SCORES_OF[protocol]:
        raise InputError(
            f"'{parsed.metric}' is no score of counts by {partition}; use "
            f"{', '.join(SCORES_OF[protocol])}."
        )
    if protocol and not is_of_pairs:
        raise InputError(
            f"'{parsed.metric}' is a score of single frames, but these counts ({partition}, of "
            "rgbt consistency run=...) are of pairs of frames. Use "
            f"{', '.join(SCORES_OF[protocol])}, or name counts of single frames."
        )
    if not protocol and is_of_pairs:
        raise InputError(
            f"'{parsed.metric}' is a score of pairs of frames, but these counts ({partition}) are "
            "of single frames. Count pairs with rgbt consistency run=..."
        )


def images_of(parsed: ParsedMetric, counts: Counts) -> Counts:
    """The images that a metric is over: all, those of the day or those of the night.

    Raises:
        InputError: the split does not hold both, the data set does not distinguish them, or such
            counts do not have the metric.
    """
    check_kind(parsed, counts.partition)
    if parsed.part is None:
        return counts
    parts = counts.parts()
    if parsed.part not in parts:
        raise InputError(
            f"'{parsed.metric}': split '{counts.split}' of the run's data set does not contain "
            "both images marked as day and images marked as night."
        )
    return parts[parsed.part]


def _of_details(
    parsed: ParsedMetric, details: Details, by_row: Matrices, like: Counts, absent: Absent
) -> NDArray[np.float64]:
    """Percent of counts of details (..., R G, M, K)."""
    *leading, rows, measures, classes = by_row.shape
    groups = details.groups
    by_region = by_row.reshape(*leading, rows // groups, groups, measures, classes)
    if parsed.region is None:
        chosen = by_region.sum(-4)
    else:
        chosen = by_region[..., _row(parsed, rows // groups), :, :, :]
    if details.kind == "calibration":
        if parsed.class_name is not None:
            at = _class_index(parsed, like.classes)
            chosen = chosen[..., at : at + 1]
        return 100.0 * ece(chosen)
    group = chosen[..., details.bins.index(parsed.bin) if parsed.bin else 0, :, :]
    if details.kind == "boundary":
        by_class = boundary_iou(group, absent)
    elif details.kind == "distance":
        by_class = iou(group, absent)
    else:
        by_class = object_recall(group)
    if parsed.class_name is None:
        return 100.0 * class_mean(by_class, like.scored)
    return _of_class(parsed, 100.0 * by_class, like.classes)


def _row(parsed: ParsedMetric, regions: int) -> int:
    """Index of the region of a metric."""
    if parsed.region is not None and 1 <= parsed.region <= regions:
        return parsed.region - 1
    raise InputError(
        f"'{parsed.metric}': the counts have the regions 1 to {regions}; use counts of more "
        "regions (another file of conf/metric)."
    )


def _is_number(text: str) -> bool:
    return text.isdecimal() and int(text) >= 1


def _of_class(
    parsed: ParsedMetric, by_class: NDArray[np.float64], classes: tuple[str, ...]
) -> NDArray[np.float64]:
    """(..., K) -> (...)."""
    return np.asarray(by_class[..., _class_index(parsed, classes)])


def _class_index(parsed: ParsedMetric, classes: tuple[str, ...]) -> int:
    if parsed.class_name not in classes:
        raise InputError(
            f"'{parsed.metric}': the data set of the run has no class '{parsed.class_name}'; "
            f"{nearest(str(parsed.class_name), classes)}."
        )
    return classes.index(parsed.class_name)
