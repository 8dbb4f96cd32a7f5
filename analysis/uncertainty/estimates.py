"""Scores of one method with intervals, differences between two methods, and their sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.uncertainty.blocks import Resampling
from analysis.uncertainty.contrasts import Evidence, Resampler, Term
from analysis.uncertainty.intervals import (
    Interval,
    corrected,
    holm,
    images_and_seeds,
    of_gaps,
    student,
    student_p,
)
from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import FEWEST, Counts
from rgbt.metrics.named import images_of, parse


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A contrast with its uncertainty; percent points, the variance in squared percent points.

    Attributes:
        value: mean over seeds; NaN where there is nothing to score.
        sd: standard deviation over seeds (n - 1); NaN for one.
        seeds: their number S.
        images: interval over the draw of the images, trainings as they are; None with too few
            images or nothing to score.
        trainings: interval over seeds, images as they are; None for one seed.
        both: interval over images and seeds; None where one of the two is.
        p: two-sided p-value of `interval` against 0; NaN without one.
        p_corrected: the same, corrected for the number of estimates that are shown together (Holm);
            NaN where it was not corrected.
    """

    value: float
    sd: float
    seeds: int
    images: Interval | None
    trainings: Interval | None
    both: Interval | None
    p: float
    evidence: Evidence
    p_corrected: float = math.nan

    @property
    def interval(self) -> Interval | None:
        """The interval to go by: over images and seeds, else over images."""
        return self.both or self.images

    def is_shown(self, level: float = 0.95) -> bool:
        """Say whether it differs from 0, corrected for the number of estimates."""
        return self.p_corrected < 1 - level


def estimate_of(evidence: Evidence, level: float, metric: str = "") -> Estimate:
    """Compute Student's intervals of a contrast, or of a score called `metric`.

    Variances over regions and calibration errors are never negative, and chance alone raises them
    and raises each resample again.
    """
    value, used = float(np.mean(evidence.values)), evidence.images
    parsed = parse(metric) if metric else None
    around = over_seeds = both = None
    if used is not None and not math.isnan(value):
        around = student(value, used, level)
        if parsed is not None and parsed.score == names.VAR:
            bias = float(np.nanmean(evidence.drawn)) - value
            around = corrected(value, bias, used, level)
        elif parsed is not None and parsed.details == "calibration":
            around = of_gaps(value, evidence.drawn, used, level)
    if evidence.trainings is not None:
        over_seeds = student(value, evidence.trainings, level)
        if around is not None and used is not None:
            used = images_and_seeds(used, evidence.trainings, level)
            both = student(value, used, level)
    if metric:  # no score is negative
        around, over_seeds, both = map(_not_negative, (around, over_seeds, both))
    return Estimate(
        value=value,
        sd=float(np.std(evidence.values, ddof=1)) if len(evidence.values) > 1 else math.nan,
        seeds=len(evidence.values),
        images=around,
        trainings=over_seeds,
        both=both,
        p=math.nan if around is None or used is None else student_p(value, used),
        evidence=evidence,
    )


def _not_negative(interval: Interval | None) -> Interval | None:
    return None if interval is None else Interval(max(0.0, interval.low), interval.high)


def estimate(
    seeds: Sequence[Counts], metrics: Sequence[str], settings: Resampling
) -> dict[str, Estimate]:
    """Estimate scores of one method, by counts of one or more trainings on the same images.

    Returns:
        metric (`rgbt.metrics.named`) -> estimate, in the requested order.

    Raises:
        InputError: no such metric, class or region; seeds on different images; blocks that cannot
            be made.
    """
    engine, found = Resampler(settings, "pixels"), {}
    for metric in metrics:
        evidence = engine.contrast([_term(1.0, metric, seeds, "a")])
        found[metric] = estimate_of(evidence, settings.level, metric)
    return found


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Method b less method a in one score.

    Attributes:
        difference: the estimate of ``b - a``, corrected for the number of scores compared.
    """

    metric: str
    a: Estimate
    b: Estimate
    difference: Estimate

    @property
    def value(self) -> float:
        """``b - a``, means over seeds."""
        return self.difference.value

    @property
    def interval(self) -> Interval | None:
        """The interval of the difference, see `Estimate.interval`."""
        return self.difference.interval


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Two methods compared.

    Attributes:
        differences: in the order of the requested metrics.
        images: number of images of the first metric.
        partition: of the regions, e.g. "ring5".
        unlike: what differs between their measurements beside the networks
            (`rgbt.metrics.measurement.Measurement.unlike`).
    """

    differences: tuple[Difference, ...]
    images: int
    partition: str
    level: float
    unlike: tuple[str, ...] = ()

    @property
    def evidence(self) -> Evidence:
        """The evidence of the first metric; it says how the images were drawn, and why."""
        return self.differences[0].difference.evidence


def compare(
    a: Sequence[Counts], b: Sequence[Counts], metrics: Sequence[str], settings: Resampling
) -> Comparison:
    """Compare two methods on the same images.

    `a` and `b` are counts of one or more trainings of each; `metrics` see `rgbt.metrics.named`.
    Seeds of two methods are not paired (Welch).

    Raises:
        InputError: other images, classes, scored classes, regions or labels; fewer than `FEWEST`
            blocks of images of every metric; no such metric.
    """
    engine = Resampler(settings, "pixels")
    found = []
    for metric in dict.fromkeys(metrics):
        terms = [_term(-1.0, metric, a, "a"), _term(1.0, metric, b, "b")]
        difference = estimate_of(engine.contrast(terms, paired=False), settings.level)
        sides = []
        for term in terms:
            evidence = engine.contrast([replace(term, weight=1.0)])
            sides.append(estimate_of(evidence, settings.level, metric))
        found.append(Difference(metric=metric, a=sides[0], b=sides[1], difference=difference))
    if all(compared.difference.evidence.blocks < FEWEST for compared in found):
        said = found[0].difference.evidence.said
        raise InputError(f"{said} are too few to compare two methods; {FEWEST} are the least.")
    ps = holm([compared.difference.p for compared in found])
    for index, p in enumerate(ps):
        estimated = replace(found[index].difference, p_corrected=p)
        found[index] = replace(found[index], difference=estimated)
    return Comparison(
        differences=tuple(found),
        images=len(images_of(parse(metrics[0]), a[0]).names),
        partition=a[0].partition,
        level=settings.level,
        unlike=a[0].measurement.unlike(b[0].measurement),
    )


def _term(weight: float, metric: str, seeds: Sequence[Counts], side: str) -> Term:
    for other in seeds[1:]:
        if unlike := seeds[0].measurement.unlike(other.measurement):
            raise InputError(
                f"seeds of one method are measured differently ({'; '.join(unlike)}); measure them "
                "in one way."
            )
    keys = {seed: f"{side}{seed}" for seed in range(len(seeds))}
    return Term(weight=weight, metric=metric, counts=dict(enumerate(seeds)), keys=keys)


def sentence(comparison: Comparison, label_a: str, label_b: str) -> str:
    """Say the first difference of a comparison, with everything that limits it."""
    found = comparison.differences[0]
    metric, difference, interval = found.metric, found.difference, found.interval
    if interval is None:
        return f"{metric} of {label_a} and {label_b} cannot be compared: nothing to score."
    images = f"{comparison.images} images"
    if found.value == 0 and interval.half == 0:
        same = f"{label_a} and {label_b} have the same {metric}, {found.a.value:.2f}"
        return f"{same}, on every draw of the {images}."
    if "blocks" in comparison.evidence.said or "sequences" in comparison.evidence.said:
        images += f" in {comparison.evidence.said}"
    trainings = f"{found.a.seeds} and {found.b.seeds} trainings"
    if found.a.seeds == found.b.seeds:
        trainings = f"{found.a.seeds} trainings each" if found.a.seeds > 1 else "one training each"
    # Words for what was not drawn anew, which may be all there is to the difference.
    start, basis = "As trained here, ", f"over {images}; with {trainings}, it says nothing about"
    basis += " other trainings of the two"
    if difference.both is not None:
        start, basis = "", f"over {trainings} and {images}"
    p, ends = _as_p(difference.p), f"{interval.low:+.2f} to {interval.high:+.2f}"
    evidence = (
        f"({found.b.value:.2f} against {found.a.value:.2f}; {100 * comparison.level:g} % interval "
        f"of the difference {ends}, {p})"
    )
    unit = "" if parse(metric).score == names.VAR else " points"
    if difference.p < 1 - comparison.level and 0.0 not in interval:
        more = f"{abs(found.value):.2f}{unit} {'higher' if found.value > 0 else 'lower'}"
        said = f"{start}the {metric} of {label_b} is {more} than that of {label_a} {evidence}"
        count = len(comparison.differences)
        corrected = f"corrected for all {count} scores compared, {_as_p(difference.p_corrected)}"
        end = f"; {corrected}" if count > 1 else ""
    else:
        said = f"{start}a difference in {metric} between {label_b} and {label_a} is not shown"
        said += f" {evidence}"
        end = f"; this data shows only differences above about {interval.half:.2f}{unit}"
    return f"{said[0].upper()}{said[1:]}, {basis}{end}."


def _as_p(value: float) -> str:
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"
