"""The difference between two methods on the same images, and whether it means anything."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from analysis.uncertainty.blocks import FEWEST
from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.estimate import Estimate, by_part, estimate_of, image_spread
from analysis.uncertainty.images import CommonImages, prepare
from analysis.uncertainty.intervals import (
    Interval,
    Spread,
    Values,
    holm,
    over_images,
    over_seeds,
    student,
    student_p,
    swap_p,
    together,
    widest,
)
from analysis.uncertainty.settings import Resampling
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import ParsedMetric, parse


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Method b less method a in one score; percent points (variance: squared percent points).

    Attributes:
        value: b - a, means over seeds.
        p_images: two-sided p-value with the methods exchanged at random on each block of images;
            NaN where there is nothing to score.
        images: interval over the draw of the images, trainings as they are.
        both: interval over images and seeds (Student); None unless both methods have two seeds.
        p_both: its p-value.
        evidence: of paired trainings, for `analysis.uncertainty.verdicts.decide`; None without.
        p_corrected: `p`, corrected for the number of scores compared (Holm); NaN without p.
    """

    metric: str
    a: Estimate
    b: Estimate
    value: float
    p_images: float
    images: Interval | None = None
    both: Interval | None = None
    p_both: float = math.nan
    evidence: Evidence | None = None
    p_corrected: float = math.nan

    @property
    def interval(self) -> Interval | None:
        """The interval to go by: over images and seeds, else over images."""
        return self.both or self.images

    @property
    def p(self) -> float:
        """The p-value that belongs to `interval`."""
        return self.p_images if self.both is None else self.p_both


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Two methods compared.

    Attributes:
        differences: in the order of the requested metrics.
        said: how they were drawn, e.g. "393 single images".
        reason: why so, see `analysis.uncertainty.blocks.ImageBlocks.reason`.
        partition: of the regions, e.g. "ring5".
    """

    differences: tuple[Difference, ...]
    images: int
    said: str
    partition: str
    level: float
    reason: str = ""


def compare(
    a: Sequence[Counts],
    b: Sequence[Counts],
    metrics: Sequence[str],
    settings: Resampling,
    *,
    paired: bool = False,
    same_pixels: bool = True,
) -> Comparison:
    """Compare two methods on the same images.

    Intervals over images resample blocks of images, the same for both methods. p-values over
    images exchange the predictions of the methods on every block with probability 1/2: under the
    hypothesis that the methods are alike all these are equally likely. Seeds of two methods are not
    paired (Welch); two evaluations of the same trainings are.

    Args:
        a: counts of the trainings of the first method, one or more.
        b: of the second, on the same images.
        metrics: names, see `rgbt.metrics.named`.
        settings: of the resampling.
        paired: counts i of `a` and of `b` are of the same training, evaluated in two ways. What
            images and trainings do together is then in both parts of the interval over both, which
            holds the true difference in at least `level` of all cases.
        same_pixels: whether both must count the same pixels of every image, by the same partition.

    Raises:
        InputError: other images, classes, scored classes, regions or labels; fewer than `FEWEST`
            blocks; no such metric.
        ValueError: paired, but not as many.
    """
    if paired and len(a) != len(b):
        raise ValueError(f"paired: expected as many counts in a and b, got {len(a)} and {len(b)}.")
    found: dict[str, Difference] = {}
    described: dict[str | None, CommonImages] = {}
    for group in by_part(metrics):
        images = prepare([a, b], group[0], settings, same_pixels=same_pixels)
        if images.blocks.count < FEWEST:
            raise InputError(
                f"{images.blocks.said} are too few to compare two methods; {FEWEST} are the least."
            )
        described[group[0].part] = images
        every = _differences(images, group, paired=paired)
        found |= {difference.metric: difference for difference in every}
    ordered = [found[metric] for metric in dict.fromkeys(metrics)]
    corrected = holm([difference.p for difference in ordered])
    main = described[parse(metrics[0]).part]
    return Comparison(
        differences=tuple(
            replace(difference, p_corrected=p)
            for difference, p in zip(ordered, corrected, strict=True)
        ),
        images=main.images,
        said=main.blocks.said,
        partition=a[0].partition,
        level=settings.level,
        reason=main.blocks.reason,
    )


def _differences(
    images: CommonImages, parsed: Sequence[ParsedMetric], *, paired: bool
) -> Iterator[Difference]:
    settings = images.settings
    a, b = images.drawn(parsed)
    swapped_a, swapped_b = images.swapped(parsed)
    every = zip(parsed, a.rows(), b.rows(), swapped_b - swapped_a, strict=True)
    for each, rows_a, rows_b, swapped in every:
        first, second = (estimate_of(images, each, *rows) for rows in (rows_a, rows_b))
        value = second.value - first.value
        resampled, without = rows_b[1] - rows_a[1], rows_b[2] - rows_a[2]
        around = over_images(
            value, resampled, without, method=settings.method, level=settings.level
        )
        spread = over_seeds(*((rows_b[0] - rows_a[0],) if paired else (rows_a[0], rows_b[0])))
        both, p_both, evidence = None, math.nan, None
        over_draws = None if around is None else image_spread(images, resampled)
        if over_draws is not None and paired:
            evidence = _evidence(images, rows_b[0] - rows_a[0], over_draws)
        if over_draws is not None and spread is not None:
            whole = together(over_draws, spread)
            used = widest(settings.level, whole, spread)
            both, p_both = student(value, used, settings.level), student_p(value, used)
        yield Difference(
            metric=each.metric,
            a=first,
            b=second,
            value=value,
            p_images=swap_p(value, swapped),
            images=around,
            both=both,
            p_both=p_both,
            evidence=evidence,
        )


def _evidence(images: CommonImages, values: Values, over_draws: Spread) -> Evidence:
    return Evidence(
        values=tuple(values.tolist()),
        seeds=tuple(range(len(values))),
        error=over_draws.error,
        blocks=images.blocks.count,
        said=images.blocks.said,
    )
