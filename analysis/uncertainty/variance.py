"""How well a standard deviation is known, and which difference paired seeds show with it."""

from __future__ import annotations

import math

from analysis.uncertainty.intervals import Interval, Spread, student
from analysis.uncertainty.verdicts import FixedSeeds


def sd_interval(sd: float, freedom: float, level: float = 0.95) -> Interval:
    """Interval of a standard deviation of normal values (chi-square).

        sd sqrt(f / chi2(1 - a/2, f)) .. sd sqrt(f / chi2(a/2, f)),  a = 1 - level

    Args:
        sd: estimated, >= 0.
        freedom: degrees of freedom f of the estimate, > 0: n - 1 for n runs.
        level: of the interval, in (0, 1).
    """
    from scipy.special import chdtri  # the argument of a probability in the upper tail

    tail = (1 - level) / 2
    low, high = (sd * math.sqrt(freedom / float(chdtri(freedom, p))) for p in (tail, 1 - tail))
    return Interval(low, high)


def smallest_difference(
    sd: float, seeds: int, images: Spread | None = None, level: float = 0.95
) -> float:
    """Smallest difference that paired seeds show: half the width of the interval of a claim.

    Args:
        sd: standard deviation of the difference of two runs with the same seed.
        seeds: number n of paired seeds, >= 2.
        images: error of the difference over the draw of the test images; None: they are fixed.
        level: of the interval.
    """
    trainings = Spread(sd / math.sqrt(seeds), seeds - 1)
    if images is None:
        return student(0.0, trainings, level).half
    return FixedSeeds().half(trainings, images, level)
