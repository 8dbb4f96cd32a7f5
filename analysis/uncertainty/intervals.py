"""Intervals and p-values from standard errors over images and over seeds. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from analysis.uncertainty.blocks import Values


@dataclass(frozen=True)
class Interval:
    """Both ends, in the unit of the score."""

    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    @property
    def half(self) -> float:
        """Half of the width."""
        return (self.high - self.low) / 2


@dataclass(frozen=True)
class Spread:
    """A standard error, >= 0, with its degrees of freedom, > 0."""

    error: float
    freedom: float


def over_images(drawn: Values, *blocks: int) -> Spread | None:
    """Compute the standard error of a score over the draw of the images.

    Drawing B blocks from B blocks gives their mean ``sqrt((B - 1) / B)`` of its standard error. The
    same holds for B blocks with images of the metric among more blocks: where all are drawn, the
    number of those B that are drawn varies by as much as makes up for it.

    `drawn` are (resamples,) scores, of which NaN (nothing to score) is left out. `blocks` are B of
    each stratum of images, of which the smallest decides. None where there is nothing to score, or
    a stratum has one block.
    """
    known, least = drawn[~np.isnan(drawn)], min(blocks)
    if not known.size or least < 2:
        return None
    error = float(known.std()) * math.sqrt(least / (least - 1))
    return Spread(error, sum(blocks) - len(blocks))


def over_seeds(*methods: Values) -> Spread | None:
    """Compute the standard error of a mean of (S,) scores over seeds, or of a sum of means (Welch).

    None where one of them has a single seed or a score is missing.
    """
    parts = []
    for scores in methods:
        count = len(scores)
        if count < 2 or np.isnan(scores).any():
            return None
        parts.append(Spread(float(scores.std(ddof=1)) / math.sqrt(count), count - 1))
    return together(*parts)


def together(*parts: Spread) -> Spread:
    """Add up independent sources of error; degrees of freedom of Welch and Satterthwaite."""
    squares = sum(part.error**2 for part in parts)
    if squares == 0:
        return Spread(0.0, min(part.freedom for part in parts))
    freedom = squares**2 / sum(part.error**4 / part.freedom for part in parts)
    return Spread(math.sqrt(squares), freedom)


def images_and_seeds(images: Spread, seeds: Spread, level: float) -> Spread:
    """Add up both sources of error, but return no less than the seeds alone.

    With two or three seeds the sum of both may have so many more degrees of freedom that its
    interval is narrower than that of the seeds; it then covers too rarely.
    """
    whole = together(images, seeds)
    return max(whole, seeds, key=lambda spread: student(0.0, spread, level).half)


def student(value: float, spread: Spread, level: float) -> Interval:
    """Return the interval ``value -+ t error``."""
    from scipy.special import stdtrit  # what `scipy.stats.t.ppf` calls, 50 times faster

    half = float(stdtrit(spread.freedom, (1 + level) / 2)) * spread.error
    return Interval(value - half, value + half)


def student_p(value: float, spread: Spread) -> float:
    """Return the two-sided p-value of `value` against 0."""
    from scipy.stats import t

    if spread.error == 0:
        return 1.0 if value == 0 else 0.0
    return float(2.0 * t.sf(abs(value) / spread.error, spread.freedom))


def corrected(value: float, bias: float, spread: Spread, level: float) -> Interval:
    """Return Student's interval of a score that is never negative, without its bias.

        value - bias -+ t error,  cut at 0,  and containing `value`

    The variance over regions needs it: regions that are equally good in truth differ in a sample,
    so that the estimate is too high by the mean error variance of their scores, and each resample
    is too high by as much again (`bias`, the mean of the resamples less `value`).

    Source: Davison and Hinkley, Bootstrap Methods and their Application (1997), Sec. 5.2.1, with
    Student's quantile.
    """
    around = student(value - bias, spread, level)
    return Interval(min(max(0.0, around.low), value), max(around.high, value))


def of_gaps(value: float, drawn: Values, spread: Spread, level: float) -> Interval:
    """Return the interval of a sum of absolute differences, such as a calibration error.

        from  value - (1 + sqrt 2) bias - t error,  cut at 0,  to a quantile of the resamples

    Chance makes differences of 0 positive. If s is the standard deviation of such an error, the
    estimate has the mean ``s sqrt(2 / pi)``. A resample adds another error of the same size and has
    the mean ``sqrt(2) s sqrt(2 / pi)``. So if all differences are chance, the true bias is
    ``bias / (sqrt(2) - 1) = (1 + sqrt 2) bias``; if they are large, both are near 0. The lower end
    allows for the first, the upper end for the second.
    """
    low, high = np.nanquantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    bias = max(float(np.nanmean(drawn)) - value, 0.0)
    below = student(value - (1 + math.sqrt(2)) * bias, spread, level).low
    return Interval(min(max(0.0, below), float(low), value), max(float(high), value))


def holm(ps: Sequence[float]) -> list[float]:
    """Correct p-values for their number (family-wise error rate).

    Source: Holm, Scandinavian Journal of Statistics 6 (1979). NaN stays NaN and is not counted.
    """
    order = sorted((p, place) for place, p in enumerate(ps) if not math.isnan(p))
    corrected, highest = [math.nan] * len(ps), 0.0
    for rank, (p, place) in enumerate(order):
        highest = max(highest, min(1.0, (len(order) - rank) * p))
        corrected[place] = highest
    return corrected
