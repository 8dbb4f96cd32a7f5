"""A confidence sequence for the mean of normal values with unknown variance.

It may be looked at after every value, and the collection may stop at any time, for any reason:

    P(some interval of the sequence misses the mean) <= alpha

Each interval holds the means against which an e-process is below ``1 / alpha``. The e-process is
the Bayes factor of the t test with a normal prior over the effect size (mean over standard
deviation) and the right-Haar prior over the scale. It depends on the data through the t statistic
alone, and its expected value under the tested mean is 1 or less at any stopping time (Ville).

Source: Lai, "On Confidence Sequences", Annals of Statistics 4 (1976); Pérez-Ortiz, Lardy, de Heide
and Grünwald, "E-statistics, Group Invariance and Anytime-valid Testing", Annals of Statistics 52
(2024); Wang and Ramdas, "Anytime-valid t-tests and Confidence Sequences for Gaussian Means with
Unknown Variance", Sequential Analysis 44 (2025).
"""

from __future__ import annotations

import math

PRECISION = 0.25
"""Precision of the prior over the effect size: its standard deviation is ``1 / sqrt(0.25) = 2``.

Differences that a table of few seeds can show are of about two standard deviations. At an alpha of
0.025 these need 7.1 seeds on average with 0.1 and 0.25, 7.3 with 0.5 and 7.9 with 1. Differences of
one standard deviation need 16.7, 15.8, 15.5 and 15.5 (`tests/benchmarks/simulate_claims.py`)."""


def e_value(t: float, count: int, precision: float = PRECISION) -> float:
    """Evidence of `count` values against the mean that `t` is measured from.

        e = sqrt(r) ((1 + x) / (1 + r x))^(n / 2),  x = t^2 / (n - 1),  r = c / (n + c)

    with ``t = (mean - tested mean) sqrt(n) / s``, the standard deviation s of n - 1 and the
    precision c of the prior. 1 for one value, which says nothing where the variance is unknown.
    """
    if count < 2:
        return 1.0
    shrunk = precision / (count + precision)
    ratio = t * t / (count - 1)
    power = math.log1p(ratio) - math.log1p(shrunk * ratio)
    return math.sqrt(shrunk) * math.exp(count / 2 * power)


def half_width(sd: float, count: int, alpha: float, precision: float = PRECISION) -> float:
    """Half of the width of the interval after `count` values of standard deviation `sd` (n - 1).

    The condition ``e_value < 1 / alpha`` solved for the tested mean; infinite with too few values.
    `alpha`, 0..1, bounds the rate of sequences that ever miss the mean.
    """
    if count < 2:
        return math.inf
    shrunk = precision / (count + precision)
    limit = math.exp(2 / count * -math.log(alpha * math.sqrt(shrunk)))
    if limit * shrunk >= 1:
        return math.inf
    ratio = (limit - 1) / (1 - limit * shrunk)
    return sd * math.sqrt(ratio * (count - 1) / count)
