"""Verdicts about contrasts: holds, contradicted, or undecided with the number of seeds needed."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.intervals import Interval, Spread, student, together, widest
from analysis.uncertainty.sequence import half_width

Combine = Literal["all", "most", "any", "mean"]
Kind = Literal["holds", "contradicted", "undecided"]
Covers = Literal["images and seeds", "images", "none"]

MOST_SEEDS = 1000
"""Largest number of seeds that is searched for `Verdict.seeds_needed`."""


@dataclass(frozen=True, kw_only=True)
class FixedSeeds:
    """Rule for a number of seeds that was chosen before any result was known.

    The interval is that of `analysis.uncertainty.compare` for paired trainings: Student over images
    and seeds, never narrower than over seeds alone.

    Attributes:
        level: confidence level of the interval.
    """

    level: float = 0.95

    def half(self, trainings: Spread, images: Spread, level: float) -> float:
        """Half of the width of the interval; degrees of freedom of `trainings`: n - 1."""
        whole = together(images, trainings)
        return student(0.0, widest(level, whole, trainings), level).half


@dataclass(frozen=True, kw_only=True)
class AnyTime:
    """Rule for seeds that are added until the verdict is clear.

    Seeds: a confidence sequence, see `analysis.uncertainty.sequence`. Images: Student's interval.
    Each has half of the error rate, and the squares of their half widths add up. In quadrature at
    the full rate, up to 7.5 % of sequences missed a difference at a level of 95 %.

    Attributes:
        level: confidence level of the whole sequence of intervals.
    """

    level: float = 0.95

    def half(self, trainings: Spread, images: Spread, level: float) -> float:
        """As in `FixedSeeds`; infinite where the seeds are too few for a confidence sequence."""
        alpha = (1 - level) / 2
        count = round(trainings.freedom) + 1
        of_seeds = half_width(trainings.error * math.sqrt(count), count, alpha)
        return math.hypot(of_seeds, student(0.0, images, 1 - alpha).half)


Rule = FixedSeeds | AnyTime


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What the data say about one claim.

    The numbers are of one contrast, `decisive`. With several contrasts the level of its interval
    is corrected for their number, see `decide`.

    Attributes:
        estimate: the contrast, mean over paired seeds.
        interval: of the contrast; None where images or seeds are too few for one.
        covers: what was drawn anew: the trainings of fixed terms are not.
        smallest: smallest difference that these seeds and images could have shown, half of the
            width of the interval; NaN without an interval.
        seeds: number of paired seeds used; 0 where all terms are fixed.
        seeds_needed: total number of paired seeds with which the present estimates would be
            decided; `seeds` where they are; inf: more than `MOST_SEEDS`, or the images alone leave
            it open; NaN: unknown.
        decisive: index of the contrast whose numbers are shown (the weakest for "all").
        reason: of "undecided", or which limit a verdict has; a short sentence.
    """

    kind: Kind
    estimate: float
    interval: Interval | None
    covers: Covers
    smallest: float
    seeds: int
    seeds_needed: float
    decisive: int
    reason: str = ""
