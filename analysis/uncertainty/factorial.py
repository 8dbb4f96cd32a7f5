"""Effects of a two-level factorial design, with intervals over seeds and images.

An effect is the mean of the cells at the high level less the mean of those at the low level. An
interaction is half of the difference between the effects of one factor at the two levels of the
other. Every effect uses every cell, so that few seeds per cell suffice.

Source: Box, Hunter and Hunter, Statistics for Experimenters (2nd ed., 2005), chapters 5 and 6.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.uncertainty.blocks import FEWEST, make_blocks
from analysis.uncertainty.estimate import block_spread
from analysis.uncertainty.intervals import (
    Interval,
    Spread,
    holm,
    student,
    student_p,
    together,
    widest,
)
from analysis.uncertainty.run_scores import RunScores
from analysis.uncertainty.settings import Resampling
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts, check_same_means, convention

Floats = NDArray[np.float64]

Noise = Literal["cells", "effects"]
"""Whose spread over seeds is the error: "cells", what is left of all cells after their means and
those of the seeds (every cell is a training of its own, so all cells tell of the same noise);
"effects", that of the effect itself over seeds (all cells are tests of one network)."""


@dataclass(frozen=True, kw_only=True)
class CellScores:
    """An outcome in every cell of a design.

    Attributes:
        values: (S, C) of each seed in each cell, percent points.
        drawn: (resamples, C) mean over seeds with images drawn anew; every cell has the same draws.
            (0, C) with too few images.
        images: number of images B.
        seeds: the S seeds.
    """

    values: Floats
    drawn: Floats
    images: int
    seeds: tuple[int, ...]

    def less(self, other: CellScores) -> CellScores:
        """The difference of two methods in every cell, paired by seed and image.

        Raises:
            ValueError: other seeds or images.
        """
        if self.seeds != other.seeds or self.images != other.images:
            raise ValueError("cells: expected the same seeds and images in both methods.")
        return CellScores(
            values=self.values - other.values,
            drawn=self.drawn - other.drawn,
            images=self.images,
            seeds=self.seeds,
        )


@dataclass(frozen=True, kw_only=True)
class EffectEstimate:
    """One effect.

    Attributes:
        value: percent points; of the variance squared percent points.
        interval: over images and seeds; None with one seed or too few images.
        of_seeds: standard error over seeds, NaN for one.
        of_images: standard error over the draw of the images, NaN with too few.
        p: two-sided, against 0; NaN without an interval.
        corrected: `p` corrected for all effects that were estimated together (Holm).
        seeds: their number.
    """

    value: float
    interval: Interval | None
    of_seeds: float
    of_images: float
    p: float
    corrected: float
    seeds: int

    def is_shown(self, level: float = 0.95) -> bool:
        """Whether the effect differs from 0, corrected for the number of effects."""
        return self.corrected < 1 - level


class CellScorer:
    """Scores of cells from counts; scores of a run are resampled once.

    Labels may differ between cells, because a factor may change the scenes. Images are paired by
    name: image n of every cell is drawn together, so what scene n does to all cells cancels.

    Args:
        settings: of the resampling; images are drawn by ``blocks``.
    """

    def __init__(self, settings: Resampling) -> None:
        self._settings = settings
        self._scores = RunScores(settings)

    def cells(
        self,
        weights: Mapping[str, float],
        runs: Sequence[Mapping[int, tuple[str, Counts]]],
        seeds: Sequence[int],
    ) -> CellScores:
        """A weighted sum of metrics in every cell.

        Args:
            weights: metric (`rgbt.metrics.named`) -> its weight.
            runs: of each cell, seed -> (identity of the counts, counts).
            seeds: one or more that every cell has.

        Raises:
            InputError: other images or classes in one of the cells, or nothing to score.
        """
        every = [run for cell in runs for run in cell.values()]
        order = _same_images([counts for _, counts in every])
        absent = self._settings.absent or convention(counts for _, counts in every)
        blocks = make_blocks(order, self._settings.blocks, np.zeros((1, len(order))))
        by_key = {cell[seed][0]: _ordered(cell[seed][1], order) for cell in runs for seed in seeds}
        keys = [[cell[seed][0] for cell in runs] for seed in seeds]
        resamples = 0 if blocks.count < FEWEST else self._settings.resamples
        values = np.zeros((len(seeds), len(runs)))
        drawn = np.zeros((resamples, len(runs)))
        for metric, weight in weights.items():  # of all runs at once: draws are the slow part
            points = self._scores.points(metric, by_key, absent)
            values += weight * np.array([[points[key] for key in row] for row in keys])
            if resamples:
                found = self._scores.resampled(metric, by_key, blocks, absent)
                drawn += weight * np.mean([[found[key] for key in row] for row in keys], axis=0).T
        if np.isnan(values).any():
            seed, cell = np.argwhere(np.isnan(values))[0]
            raise InputError(
                f"{', '.join(weights)}: {keys[seed][cell]} has nothing to score: no pixel is "
                "labelled or predicted so. Use absent=released."
            )
        return CellScores(values=values, drawn=drawn, images=blocks.count, seeds=tuple(seeds))


def estimate_effects(
    cells: CellScores, contrasts: Floats, noise: Noise, level: float = 0.95
) -> list[EffectEstimate]:
    """Effects with intervals over seeds and images (Student, Satterthwaite's degrees of freedom).

    Args:
        cells: an outcome of C cells.
        contrasts: (E, C) signs, -1 or 1, each row with as many of one as of the other.
        noise: see `Noise`.
        level: of the intervals.

    Returns:
        E estimates, whose p-values are corrected for E.

    Raises:
        ValueError: contrasts of another number of cells, or unbalanced ones.
    """
    count = cells.values.shape[1]
    if contrasts.shape[1:] != (count,) or (contrasts.sum(1) != 0).any():
        raise ValueError(f"contrasts: expected balanced rows of {count} signs.")
    weights = contrasts * (2.0 / count)
    values = cells.values @ weights.T
    pooled = _left_over(cells.values)
    found = []
    for number, weight in enumerate(weights):
        spread = _spread_of(values[:, number])
        if noise == "cells" and pooled is not None:
            scale = math.sqrt(float((weight**2).sum()) / len(values))
            spread = Spread(pooled.error * scale, pooled.freedom)
        found.append(
            _estimate(values[:, number], cells.drawn @ weight, cells.images, spread, level)
        )
    return _corrected(found)


def estimate_mean(cells: CellScores, level: float = 0.95) -> EffectEstimate:
    """The mean over all cells; what a seed does to all cells does not cancel in it."""
    values = cells.values.mean(1)
    found = _estimate(values, cells.drawn.mean(1), cells.images, _spread_of(values), level)
    return _corrected([found])[0]


def _estimate(
    values: Floats, drawn: Floats, images: int, seeds: Spread | None, level: float
) -> EffectEstimate:
    """One estimate from its (S,) values and its resamples."""
    value = float(values.mean())
    of_images = block_spread(drawn, images) if len(drawn) else None
    whole = None
    if seeds is not None and of_images is not None:
        whole = widest(level, together(of_images, seeds), seeds)
    return EffectEstimate(
        value=value,
        interval=None if whole is None else student(value, whole, level),
        of_seeds=math.nan if seeds is None else seeds.error,
        of_images=math.nan if of_images is None else of_images.error,
        p=math.nan if whole is None else student_p(value, whole),
        corrected=math.nan,
        seeds=len(values),
    )


def _corrected(found: Sequence[EffectEstimate]) -> list[EffectEstimate]:
    ps = holm([each.p for each in found])
    return [replace(each, corrected=p) for each, p in zip(found, ps, strict=True)]


def _spread_of(values: Floats) -> Spread | None:
    """Standard error of the mean of (S,) values; None for one."""
    if len(values) < 2:
        return None
    return Spread(float(values.std(ddof=1)) / math.sqrt(len(values)), len(values) - 1)


def _left_over(values: Floats) -> Spread | None:
    """Standard deviation of (S, C) values around the means of their cells and seeds.

    Each seed is a block: initial weights and the order of the data are the same in all its cells.
    None for one seed.
    """
    seeds, cells = values.shape
    if seeds < 2:
        return None
    left = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    freedom = (seeds - 1) * (cells - 1)
    return Spread(math.sqrt(float((left**2).sum()) / freedom), freedom)


def _same_images(every: Sequence[Counts]) -> tuple[str, ...]:
    """Names of the images in order.

    Raises:
        InputError: counts of other images, classes, scored classes or regions.
    """
    first = every[0]
    for other in every[1:]:
        check_same_means(first, other)
        for what, one, two in (
            ("classes", first.classes, other.classes),
            ("regions", first.partition, other.partition),
            ("images", sorted(first.names), sorted(other.names)),
        ):
            if one != two:
                raise InputError(
                    f"the cells of a design need counts of the same {what}; train and test all "
                    "cells with the same settings."
                )
    return tuple(sorted(first.names))


def _ordered(counts: Counts, order: tuple[str, ...]) -> Counts:
    return counts if counts.names == order else counts.select(order)
