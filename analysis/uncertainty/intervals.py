"""Intervals and p-values from resampled scores and from the spread over seeds. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.uncertainty.settings import Method

Values = NDArray[np.float64]


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
    """A mean with its standard error.

    Attributes:
        error: standard error, >= 0.
        freedom: degrees of freedom, > 0.
    """

    error: float
    freedom: float


def over_images(
    value: float, resampled: Values, without_each: Values, *, method: Method, level: float
) -> Interval | None:
    """Interval of a score over the draw of the images.

    Source: Efron, "Better Bootstrap Confidence Intervals", JASA 82 (1987).

    Args:
        value: the score itself.
        resampled: (resamples,) scores; NaN (nothing to score) is left out.
        without_each: (B,) scores without one block each; read by "bca" alone.
        method: see `Resampling.method`; "auto" is "percentile".
        level: of the interval.

    Returns:
        holds `value`; None where there is nothing to score.
    """
    known = resampled[~np.isnan(resampled)]
    if math.isnan(value) or not known.size:
        return None
    tails = np.array([(1 - level) / 2, (1 + level) / 2])
    if method == "bca":
        from scipy.special import ndtr, ndtri

        # How far the resampled scores lie to one side of the score itself.
        below = (known < value).sum() + 0.5 * (known == value).sum()
        share = min(max(below, 0.5), known.size - 0.5) / known.size
        bias = float(ndtri(share))
        moved = bias + ndtri(tails)
        tails = ndtr(bias + moved / (1.0 - _acceleration(without_each) * moved))
    low, high = np.quantile(known, np.sort(tails))
    # Resampling raises a variance over regions; where that is all there is, quantiles miss it.
    return Interval(min(float(low), value), max(float(high), value))


def corrected(value: float, bias: float, spread: Spread, level: float) -> Interval:
    """Student's interval of a score that is never negative, without the bias of its estimate.

        value - bias -+ t error,  cut at 0

    For the variance over regions: regions that are equally good in truth differ in a sample, so
    that the estimate is too high by the mean error variance of their scores, and each resample is
    too high by as much again. Quantiles of the resamples lie above the truth, even above the
    estimate.

    Source: Davison and Hinkley, Bootstrap Methods and their Application (1997), Sec. 5.2.1, with
    Student's quantile.

    Args:
        value: the estimate, >= 0.
        bias: mean of the resamples less `value`; 0 for other scores.
        spread: standard error of the estimate.
        level: of the interval.

    Returns:
        at least 0; contains `value`; `value` is the upper end where the estimate is all bias.
    """
    around = student(value - bias, spread, level)
    return Interval(min(max(0.0, around.low), value), max(around.high, value))


def of_gaps(value: float, bias: float, spread: Spread, around: Interval, level: float) -> Interval:
    """Interval of a sum of absolute differences, such as a calibration error.

        from  value - (1 + sqrt 2) bias - t error,  cut at 0,  to the upper end of `around`

    Chance makes differences of 0 positive. If s is the standard deviation of such an error, the
    estimate has the mean ``s sqrt(2 / pi)``. A resample adds another error of the same size and has
    the mean ``sqrt(2) s sqrt(2 / pi)``. So if all differences are chance, the true bias is
    ``bias / (sqrt(2) - 1) = (1 + sqrt 2) bias``; if they are large, both are near 0. The lower end
    allows for the first, the upper end for the second.

    Args:
        value: the estimate, >= 0.
        bias: mean of the resamples less `value`.
        spread: standard error of the estimate.
        around: quantiles of the resamples.
        level: of the interval.
    """
    low = student(value - (1 + math.sqrt(2)) * max(bias, 0.0), spread, level).low
    return Interval(min(max(0.0, low), around.low), around.high)


def _acceleration(without_each: Values) -> float:
    """How fast the standard error changes with the score; from the jackknife."""
    known = without_each[~np.isnan(without_each)]
    moved = known.mean() - known if known.size else known
    squares = float((moved**2).sum())
    return float((moved**3).sum()) / (6.0 * squares**1.5) if squares > 0 else 0.0


def over_seeds(*methods: Values) -> Spread | None:
    """Standard error of the mean over seeds, or of the difference of two such means (Welch).

    Args:
        methods: (S,) scores of the seeds of each method.

    Returns:
        None where one of them has a single seed or a score is missing.
    """
    if any(len(each) < 2 or np.isnan(each).any() for each in methods):
        return None
    return together(
        *(Spread(float(each.std(ddof=1)) / math.sqrt(len(each)), len(each) - 1) for each in methods)
    )


def together(*parts: Spread) -> Spread:
    """Independent sources of error added up; degrees of freedom of Welch and Satterthwaite."""
    squares = sum(part.error**2 for part in parts)
    if squares == 0:
        return Spread(0.0, min(part.freedom for part in parts))
    freedom = squares**2 / sum(part.error**4 / part.freedom for part in parts)
    return Spread(math.sqrt(squares), freedom)


def widest(level: float, *spreads: Spread) -> Spread:
    """The one with the widest interval.

    With two or three seeds the sum of two sources may have so many more degrees of freedom that its
    interval is narrower than that of the seeds alone; it then covers too rarely.
    """
    return max(spreads, key=lambda spread: student(0.0, spread, level).half)


def student(value: float, spread: Spread, level: float) -> Interval:
    """``value -+ t error``."""
    from scipy.special import stdtrit  # what `scipy.stats.t.ppf` calls, 50 times faster

    half = float(stdtrit(spread.freedom, (1 + level) / 2)) * spread.error
    return Interval(value - half, value + half)


def student_p(value: float, spread: Spread) -> float:
    """Two-sided p-value of `value` against 0."""
    from scipy.stats import t

    if spread.error == 0:
        return 1.0 if value == 0 else 0.0
    return float(2.0 * t.sf(abs(value) / spread.error, spread.freedom))


def swap_p(value: float, swapped: Values) -> float:
    """Two-sided p-value of a difference against differences with methods exchanged at random.

    The observed arrangement is one of them, so that p is never 0. Differences that are equal but
    for rounding count as equal. NaN where `value` is.
    """
    if math.isnan(value):
        return math.nan
    known = swapped[~np.isnan(swapped)]
    as_far = (np.abs(known) >= abs(value) - 1e-9).sum()
    return float((as_far + 1) / (known.size + 1))


def holm(ps: Sequence[float]) -> list[float]:
    """P-values corrected for their number (family-wise error rate).

    Source: Holm, Scandinavian Journal of Statistics 6 (1979). NaN stays NaN and is not counted.
    """
    order = sorted((p, place) for place, p in enumerate(ps) if not math.isnan(p))
    corrected, highest = [math.nan] * len(ps), 0.0
    for rank, (p, place) in enumerate(order):
        highest = max(highest, min(1.0, (len(order) - rank) * p))
        corrected[place] = highest
    return corrected
