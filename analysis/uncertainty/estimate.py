"""Scores of one method with intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from analysis.uncertainty.images import CommonImages, prepare
from analysis.uncertainty.intervals import (
    Interval,
    Spread,
    Values,
    corrected,
    of_gaps,
    over_images,
    over_seeds,
    together,
    widest,
)
from analysis.uncertainty.settings import Resampling
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import ParsedMetric, parse


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A score with its uncertainty; percent, the variance in squared percent points.

    Attributes:
        value: mean over seeds; NaN where there is nothing to score.
        sd: standard deviation over seeds (n - 1); NaN for one.
        seeds: their number S.
        images: interval over the draw of the images, trainings as they are; None with too few
            images or nothing to score.
        trainings: interval over seeds (Student), images as they are; None for one seed.
        both: interval over images and seeds (Student with Satterthwaite's degrees of freedom, not
            narrower than `trainings`); None where one of the two is.
        said: what was drawn, e.g. "40 blocks of up to 10 neighbouring frames".
        reason: why so, see `analysis.uncertainty.blocks.ImageBlocks.reason`.
    """

    value: float
    sd: float
    seeds: int
    images: Interval | None
    trainings: Interval | None
    both: Interval | None
    said: str
    reason: str = ""


def estimate(
    seeds: Sequence[Counts], metrics: Sequence[str], settings: Resampling
) -> dict[str, Estimate]:
    """Scores of one method.

    Args:
        seeds: counts of its trainings on the same images, one or more.
        metrics: names, see `rgbt.metrics.named`.
        settings: of the resampling.

    Returns:
        metric -> estimate, in the requested order.

    Raises:
        InputError: no such metric, class or region; seeds on different images; blocks that cannot
            be made.
    """
    found: dict[str, Estimate] = {}
    for group in by_part(metrics):
        images = prepare([seeds], group[0], settings)
        (drawn,) = images.drawn(group)
        found |= {
            metric.metric: estimate_of(images, metric, *rows)
            for metric, rows in zip(group, drawn.rows(), strict=True)
        }
    return {metric: found[metric] for metric in metrics}


def by_part(metrics: Sequence[str]) -> list[list[ParsedMetric]]:
    """The metrics taken apart, those over the same images together."""
    every = sorted(map(parse, metrics), key=lambda metric: metric.part or "")
    return [list(group) for _, group in groupby(every, key=lambda metric: metric.part)]


def estimate_of(
    images: CommonImages, metric: ParsedMetric, points: Values, resampled: Values, without: Values
) -> Estimate:
    """The estimate that one row of `ResampledScores` gives."""
    settings, value = images.settings, float(points.mean())
    level = settings.level
    around = over_images(value, resampled, without, method=settings.method, level=level)
    if around is not None and settings.method == "auto":
        # Chance alone raises these scores, and each resample raises them again.
        bias = float(np.nanmean(resampled)) - value
        if metric.score == names.VAR:
            around = corrected(value, bias, image_spread(images, resampled), level)
        elif metric.details == "calibration":
            around = of_gaps(value, bias, image_spread(images, resampled), around, level)
    spread = over_seeds(points)
    trainings = both = None
    if spread is not None:
        trainings = corrected(value, 0.0, spread, level)
        if around is not None:
            whole = together(image_spread(images, resampled), spread)
            both = corrected(value, 0.0, widest(level, whole, spread), level)
    return Estimate(
        value=value,
        sd=float(points.std(ddof=1)) if len(points) > 1 else float("nan"),
        seeds=len(points),
        images=around,
        trainings=trainings,
        both=both,
        said=images.blocks.said,
        reason=images.blocks.reason,
    )


def image_spread(images: CommonImages, resampled: Values) -> Spread:
    """Standard error over the draw of the images, see `block_spread`."""
    return block_spread(resampled, images.blocks.count)


def block_spread(resampled: Values, count: int) -> Spread:
    """Standard error of a score from scores of `count` blocks drawn anew.

    Drawing B blocks from B blocks gives their mean ``sqrt((B - 1) / B)`` of its standard error. The
    same holds for B blocks with images of the metric among more blocks: where all are drawn, the
    number of those B that are drawn varies by as much as makes up for it.
    """
    return Spread(float(np.nanstd(resampled)) * math.sqrt(count / (count - 1)), count - 1)
