"""The variance budget of a table: standard deviations by source, from its finished runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import stdev

from analysis.uncertainty import Interval
from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.intervals import Spread
from analysis.uncertainty.variance import sd_interval, smallest_difference
from rgbt.checks import InputError
from sweeps.point import Outcome
from sweeps.verdicts.contrasts import Contrast
from sweeps.verdicts.judge import CellRunId, TableJudge

NUMBERS = (2, 3, 4, 6, 8, 12, 16)
"""Numbers of paired seeds for which the smallest difference is computed."""


@dataclass(frozen=True, kw_only=True)
class SourceSpread:
    """How far a score varies by one source.

    Attributes:
        source: its name.
        sd: standard deviation in percent points; NaN where it is not known.
        interval: of `sd`; None where it is not known.
        count: number of runs, or of blocks of images.
        reason: why `sd` is not known, or "".
    """

    source: str
    sd: float = math.nan
    interval: Interval | None = None
    count: int = 0
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class Smallest:
    """The smallest difference that a number of paired seeds shows; percent points.

    Attributes:
        seeds: the number.
        value: with the test images as they are.
        interval: of `value`, from that of the standard deviation of the difference.
        with_images: with the test images drawn anew; NaN where their error is not known.
    """

    seeds: int
    value: float
    interval: Interval
    with_images: float


@dataclass(frozen=True, kw_only=True)
class VarianceBudget:
    """Standard deviations of a score by source, and what follows for comparisons.

    Attributes:
        column: name of the score.
        sources: one line per source.
        total: root of the sum of the sources' variances; NaN where one is not known.
        all: of runs that differ in all sources.
        images: error of the score over the draw of the test images.
        difference: of two runs with the same seed; its source names the rows.
        smallest: by number of paired seeds; () where `difference` is not known.
    """

    column: str
    sources: tuple[SourceSpread, ...]
    total: float
    all: SourceSpread
    images: SourceSpread
    difference: SourceSpread
    smallest: tuple[Smallest, ...]


def variance_budget(judge: TableJudge, runs: Mapping[CellRunId, Outcome]) -> VarianceBudget | None:
    """The variance budget that a table declares, from the finished ones of `runs`.

    Returns:
        None where the table declares none.
    """
    wanted = judge.table.variance
    if wanted is None:
        return None

    def spread(source: str, contrast: Contrast) -> tuple[SourceSpread, Evidence | None]:
        try:
            found = judge.evidence([(1.0, contrast)], runs)
        except InputError as error:
            return SourceSpread(source=source, reason=str(error)), None
        return _spread(source, found), found

    sources = tuple(
        spread(source, Contrast(label, None, wanted.column))[0]
        for source, label in wanted.sources.items()
    )
    every, evidence = spread("all", Contrast(wanted.all, None, wanted.column))
    if wanted.against is None:
        difference, of_images = _unpaired(every), None
    else:
        contrast = Contrast(wanted.all, wanted.against, wanted.column)
        difference, of_pairs = spread(contrast.label, contrast)
        of_images = None if of_pairs is None else _image_spread(of_pairs)
    return VarianceBudget(
        column=wanted.column,
        sources=sources,
        total=math.sqrt(sum(each.sd**2 for each in sources)),
        all=every,
        images=_of_images(evidence),
        difference=difference,
        smallest=tuple(_smallest(difference, of_images)),
    )


def _spread(source: str, found: Evidence) -> SourceSpread:
    count = len(found.values)
    if count < 2:
        return SourceSpread(source=source, count=count, reason="It needs two seeds or more.")
    sd = stdev(found.values)
    return SourceSpread(source=source, sd=sd, interval=sd_interval(sd, count - 1), count=count)


def _image_spread(found: Evidence) -> Spread | None:
    return None if math.isnan(found.error) else Spread(found.error, found.blocks - 1)


def _of_images(found: Evidence | None) -> SourceSpread:
    """The error of the mean over the runs: what another draw of test images would change."""
    spread = None if found is None else _image_spread(found)
    if found is None or spread is None:
        return SourceSpread(source="test images", reason="There are no runs, or too few images.")
    interval = sd_interval(spread.error, spread.freedom)
    return SourceSpread(
        source="test images", sd=spread.error, interval=interval, count=found.blocks
    )


def _unpaired(every: SourceSpread) -> SourceSpread:
    """The difference of two runs that have nothing in common."""
    name, factor = f"two runs of {every.source}", math.sqrt(2)
    if every.interval is None:
        return SourceSpread(source=name, count=every.count, reason=every.reason)
    interval = Interval(factor * every.interval.low, factor * every.interval.high)
    return SourceSpread(source=name, sd=factor * every.sd, interval=interval, count=every.count)


def _smallest(difference: SourceSpread, images: Spread | None) -> list[Smallest]:
    ends = difference.interval
    if ends is None:
        return []
    return [
        Smallest(
            seeds=seeds,
            value=smallest_difference(difference.sd, seeds),
            interval=Interval(*(smallest_difference(sd, seeds) for sd in (ends.low, ends.high))),
            with_images=math.nan
            if images is None
            else smallest_difference(difference.sd, seeds, images),
        )
        for seeds in NUMBERS
    ]
