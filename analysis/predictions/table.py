"""Scores by region, class, day and night as one tidy list, from counts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import class_mean, iou, miou, recall, variance

ALL = "all"
CONVENTIONS: tuple[Absent, ...] = get_args(Absent)
Metric = Literal["IoU", "Acc", "Var"]


@dataclass(frozen=True, kw_only=True)
class ScoreKey:
    """Key of a score: two scores of a table differ in one of these attributes.

    Attributes:
        images: "all", "day" or "night".
        region: 1..R, or None for the whole image.
        class_name: of one class, or None for the mean over classes.
        metric: "IoU", "Acc" (recall, as the papers call it) or "Var" (of the regions' mean IoU).
        absent: how a class without a pixel counts, see `rgbt.metrics.scores`.
    """

    images: str = ALL
    region: int | None = None
    class_name: str | None = None
    metric: Metric = "IoU"
    absent: Absent = "released"

    @property
    def metric_name(self) -> str | None:
        """Its name in `rgbt.metrics.named`; None for those that have none."""
        if self.metric == "Var":
            name = names.VAR
        elif self.metric == "Acc" and self.region is not None:
            return None
        elif self.class_name is None:
            whole = names.MACC if self.metric == "Acc" else names.MIOU
            name = whole if self.region is None else names.region(self.region)
        else:
            name = names.class_iou(self.class_name)
            name += "/acc" if self.metric == "Acc" else ""
            name += "" if self.region is None else f"/region/{self.region}"
        return name if self.images == ALL else names.subset(self.images, name)


@dataclass(frozen=True)
class Score:
    """One score.

    Attributes:
        value: percent; the variance in squared percent points; NaN where nothing can be scored.
        low: lower end of its interval over images, NaN without one.
        high: upper end, same rule.
    """

    value: float
    low: float = float("nan")
    high: float = float("nan")


@dataclass(frozen=True)
class ScoreTable:
    """The scores of one method on one partition.

    Attributes:
        partition: e.g. "ring5".
        regions: R.
        classes: K names.
        num_images: number of images by "all" and, where both are there, "day" and "night".
        scores: of every cell, under both conventions for absent classes.
        intervals: what the intervals are, in a sentence; "" without them.
        unscored: names of the classes that are left out of means.
    """

    name: str
    partition: str
    split: str
    regions: int
    classes: tuple[str, ...]
    num_images: Mapping[str, int]
    scores: Mapping[ScoreKey, Score]
    intervals: str = ""
    unscored: tuple[str, ...] = ()
    absent: Absent = "released"

    def conventions(self, metric: Metric | None = None) -> tuple[Absent, ...]:
        """Both where a mean differs between them, that of the data set first; else that one alone.

        Args:
            metric: look at this one over all images; None: at all of them, day and night too.
        """
        same = all(
            score.value == self.scores[replace(cell, absent="exclude")].value
            for cell, score in self.scores.items()
            if cell.class_name is None
            and (metric is None or (cell.metric, cell.images) == (metric, ALL))
        )
        both = (self.absent, *(each for each in CONVENTIONS if each != self.absent))
        return both[:1] if same else both

    def absent_classes(self) -> tuple[str, ...]:
        """Scored classes without a pixel to count in a region, by day or by night."""
        gone = {
            cell.class_name
            for cell, score in self.scores.items()
            if cell.absent == "exclude" and np.isnan(score.value)
        }
        gone -= set(self.unscored)
        return tuple(name for name in self.classes if name in gone)


def score_table(counts: Counts, name: str) -> ScoreTable:
    """All scores of one method on one partition, without intervals.

    Returns:
        mIoU and mAcc of the scored classes, IoU and accuracy of each class, for each region and the
        whole image; variance over regions; all images, and day and night where the data set tells
        them apart.
    """
    parts = {ALL: counts, **counts.parts()}
    scores = {
        cell: Score(value)
        for images, subset in parts.items()
        for absent in CONVENTIONS
        for cell, value in _scores(subset, ScoreKey(images=images, absent=absent))
    }
    return ScoreTable(
        name=name,
        partition=counts.partition,
        split=counts.split,
        regions=counts.counts.shape[1],
        classes=counts.classes,
        num_images={images: len(subset.names) for images, subset in parts.items()},
        scores=scores,
        unscored=counts.unscored,
        absent=counts.absent,
    )


def interval_cells(table: ScoreTable, absent: Absent) -> dict[str, dict[str, ScoreKey]]:
    """The cells that are given intervals: mIoU, that of each region, and Var.

    Returns:
        part of the images -> metric name -> cell.
    """
    regions = (None, *range(1, table.regions + 1))
    found: dict[str, dict[str, ScoreKey]] = {}
    for images in table.num_images:
        plain = (*(ScoreKey(region=region) for region in regions), ScoreKey(metric="Var"))
        cells = [replace(cell, images=images, absent=absent) for cell in plain]
        found[images] = {str(cell.metric_name): cell for cell in cells}
    return found


def with_intervals(
    table: ScoreTable, intervals: Mapping[ScoreKey, tuple[float, float]], said: str
) -> ScoreTable:
    """The table with the given intervals.

    Args:
        table: see `score_table`.
        intervals: cell -> (low, high) in the unit of the score.
        said: what they are, in a sentence.
    """
    scores = dict(table.scores)
    for cell, (low, high) in intervals.items():
        scores[cell] = replace(scores[cell], low=low, high=high)
    return replace(table, scores=scores, intervals=said)


def _scores(counts: Counts, base: ScoreKey) -> Iterator[tuple[ScoreKey, float]]:
    by_region, scored = counts.by_region(), counts.scored
    matrices = np.concatenate([by_region, by_region.sum(0, keepdims=True)])
    regions: list[int | None] = [*range(1, len(by_region) + 1), None]
    ratios: dict[Metric, NDArray[np.float64]] = {
        "IoU": iou(matrices, base.absent),
        "Acc": recall(matrices, base.absent),
    }
    for metric, ratio in ratios.items():
        means = class_mean(ratio, scored)
        for region, by_class, mean in zip(regions, ratio, means, strict=True):
            cell = replace(base, metric=metric, region=region)
            yield cell, 100.0 * float(mean)
            for name, value in zip(counts.classes, by_class, strict=True):
                yield replace(cell, class_name=name), 100.0 * float(value)
    yield replace(base, metric="Var"), float(variance(miou(by_region, base.absent, scored)))
