"""Scores by the names that tables give them, from counts.

``[day/ or night/]`` and then one of ``mIoU Var mAcc mPrecision mF1 pixel_accuracy``, ``region/<n>``
(mIoU of region n), ``class/<name>`` (IoU), ``class/<name>/acc``, ``class/<name>/region/<n>``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rgbt.checks import InputError, nearest
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import (
    Matrices,
    class_mean,
    f1,
    iou,
    miou,
    pixel_accuracy,
    precision,
    recall,
    variance,
)

MEANS: dict[str, Callable[[Matrices, Absent], float]] = {
    names.MIOU: lambda counts, absent: float(miou(counts, absent)),
    names.MACC: lambda counts, absent: float(class_mean(recall(counts, absent))),
    names.MPRECISION: lambda counts, absent: float(class_mean(precision(counts, absent))),
    names.MF1: lambda counts, absent: float(class_mean(f1(counts, absent))),
    names.PIXEL_ACCURACY: lambda counts, _: float(pixel_accuracy(counts)),
}
"""Scores of a (K, K) matrix as a fraction."""

FORMS = ("region/<n>", "class/<name>", "class/<name>/acc", "class/<name>/region/<n>")


@dataclass(frozen=True)
class Asked:
    """A metric name, taken apart.

    Attributes:
        part: "day", "night", or None for all images.
        score: a mean over classes, "Var", "IoU" or "acc".
        class_name: of one class alone, or None.
        region: number from 1, or None for the whole image.
    """

    part: str | None
    score: str
    class_name: str | None = None
    region: int | None = None


def parse(metric: str) -> Asked:
    """Take a metric name apart.

    Raises:
        InputError: it is none, with the nearest one.
    """
    words = metric.split("/")
    part = words.pop(0) if words[0] in (names.DAY, names.NIGHT) else None
    match words:
        case [score] if score in MEANS or score == names.VAR:
            return Asked(part, score)
        case ["region", number] if _is_number(number):
            return Asked(part, names.MIOU, region=int(number))
        case ["class", name] if name:
            return Asked(part, "IoU", name)
        case ["class", name, "acc"] if name:
            return Asked(part, "acc", name)
        case ["class", name, "region", number] if name and _is_number(number):
            return Asked(part, "IoU", name, int(number))
    known = nearest("/".join(words), [*MEANS, names.VAR, *FORMS])
    raise InputError(
        f"'{metric}' is not a metric; {known}; day/ or night/ may stand before each of them."
    )


def value(metric: str, counts: Counts, absent: Absent) -> float:
    """The score called `metric`.

    Args:
        metric: a name, see the module docstring.
        counts: of one evaluation.
        absent: how a class without pixels counts, see `rgbt.metrics.scores`.

    Returns:
        percent 0..100; the variance in squared percent points. NaN: nothing to score.

    Raises:
        InputError: no such metric, class or region, or images that are not told apart.
    """
    asked = parse(metric)
    counts = _images(asked, counts, metric)
    by_region = counts.by_region()
    if asked.score == names.VAR:
        return variance(miou(by_region, absent))
    matrix = by_region.sum(0)
    if asked.region is not None:
        if not 1 <= asked.region <= len(by_region):
            raise InputError(
                f"'{metric}': the counts ({counts.partition}) have the regions 1 to "
                f"{len(by_region)}; set `regions` of the table to another file of conf/metric."
            )
        matrix = by_region[asked.region - 1]
    if asked.class_name is None:
        return 100.0 * MEANS[asked.score](matrix, absent)
    score = recall if asked.score == "acc" else iou
    return 100.0 * float(score(matrix, absent)[_class_index(asked.class_name, counts, metric)])


def _is_number(text: str) -> bool:
    return text.isdecimal() and int(text) >= 1


def _class_index(name: str, counts: Counts, metric: str) -> int:
    if name not in counts.classes:
        raise InputError(
            f"'{metric}': the data set of the run has no class '{name}'; "
            f"{nearest(name, counts.classes)}."
        )
    return counts.classes.index(name)


def _images(asked: Asked, counts: Counts, metric: str) -> Counts:
    if asked.part is None:
        return counts
    parts = counts.parts()
    if asked.part not in parts:
        raise InputError(
            f"'{metric}': split '{counts.split}' of the run's data set does not hold images of "
            "day and of night that are told apart."
        )
    return parts[asked.part]
