"""The qualitative claims of SpatialSeg, Sec. III-B and III-C, decided on a data set.

Each function here is one claim in numbers; how numbers become a verdict is in `judging`. Claims
that need a network's predictions are not here.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np

from analysis.statistics.data import ALL, MODALITIES, SpatialStatistics
from analysis.statistics.derive import (
    AVERAGES,
    class_occupancy_of,
    entropies,
    entropy_of,
    normalised,
    occupancy_of,
)
from analysis.statistics.judging import (
    ABOUT_TEN,
    ABOVE_0,
    ABOVE_1,
    BELOW_0,
    BELOW_1,
    OPEN,
    Claim,
    Finding,
    Floats,
    Judge,
    every,
    most,
)
from analysis.statistics.resampling import (
    MOST_RESAMPLES,
    ConsecutiveBlocks,
    ValueInterval,
    snr_samples,
)
from rgbt.checks import check_range
from rgbt.metrics.names import DAY, NIGHT

EXCEPT = "bump"
"""The class that the paper excepts from "most classes are concentrated in the centre"."""

EVEN = "curve"
"""The class that it names as more evenly distributed."""


def claims(
    stats: SpatialStatistics,
    *,
    blocks: int = 10,
    resamples: int = 2000,
    level: float = 0.95,
    seed: int = 0,
) -> tuple[Claim, ...]:
    """Every claim that the statistics can speak to, decided.

    Args:
        stats: of a split; claims about centre and edge need rings, two of them or more.
        blocks: images per block of neighbouring frames (`resampling.Blocks`).
        resamples: how many, 100..100 000.
        level: of confidence, 0.5..0.999.
        seed: of the draws.

    Returns:
        in the order of the paper; those about noise once per estimator and average. Those about
        sample occupancy, and about entropy without background, need a background class.

    Raises:
        InputError: a number out of range.
    """
    check_resampling(blocks, resamples, level)
    drawn = ConsecutiveBlocks(stats, size=blocks, resamples=resamples, seed=seed)
    judge = Judge(stats, drawn, level)
    labels = drawn.mean(stats.labels)
    found = _occupancy(judge, labels) if stats.background else []
    if judge.has_centre:
        found += _classes(judge, class_occupancy_of(labels))
    found += _laplacian(judge)
    for estimator, average in product(stats.noise, AVERAGES):
        found += _snr(judge, estimator, average)
    for word, background in entropies(stats) if judge.has_centre else ():
        entropy = entropy_of(labels if background else labels[..., ~stats.is_background])
        difference = judge.centre(entropy) - judge.edge(entropy)
        statement = " ".join(["label entropy", *word.split(), "is higher in the centre"])
        finding = judge.finding("centre - edge, bits", difference, ABOVE_0)
        key = "_".join(word.split()) or "all_classes"
        found.append(_claim(f"entropy/{key}", "III-C.1", statement, finding))
    return tuple(found)


def _occupancy(judge: Judge, labels: Floats) -> list[Claim]:
    """Sample occupancy from the centre outwards, and of horizontal strips."""
    stats = judge.stats
    found: list[Claim] = []
    occupancy = 100 * occupancy_of(labels, stats.is_background)
    if judge.has_centre:
        difference = judge.centre(occupancy) - judge.edge(occupancy)
        statement = "sample occupancy falls from the inner to the outer regions"
        finding = judge.finding("centre - edge, points", difference, ABOVE_0)
        steps = judge.largest_step("largest step outwards, points", occupancy)
        found.append(_claim("occupancy/falls", "III-B.1", statement, finding, steps))
    if stats.partition.startswith("horizontal") and stats.num_regions > 2:
        ends = (occupancy[:, 0] + occupancy[:, -1]) / 2
        above = occupancy[:, stats.num_regions // 2] - ends
        statement = "of horizontal strips the middle has the highest occupancy"
        finding = judge.finding("middle - mean of the ends, points", above, ABOVE_0)
        found.append(_claim("occupancy/middle", "III-B.1", statement, finding))
    return found


def check_resampling(blocks: int, resamples: int, level: float) -> None:
    """Raise InputError where a number of `claims` is out of range."""
    check_range("blocks", blocks, 1, 1_000_000)
    check_range("resamples", resamples, 100, MOST_RESAMPLES)
    check_range("level", level, 0.5, 0.999)


def _claim(
    key: str, source: str, statement: str, *findings: Finding, way: tuple[str, str] = ("", "")
) -> Claim:
    """A claim that holds where all findings do; `way`: estimator and average of the noise."""
    verdict = every([each.verdict for each in findings])
    return Claim(key, statement, source, verdict, findings, *way)


def _classes(judge: Judge, occupancy: Floats) -> list[Claim]:
    """Fig. 3, each class as (centre - edge) / (centre + edge): 1 central, 0 even, -1 outside.

    Evenness: mean over regions of the occupancy as Fig. 3 normalises it, 1 where all equal.
    """
    labels, classes = judge.stats.labels, judge.stats.classes
    present = np.asarray(labels.any(1))
    occurs = [index for index in judge.stats.objects if present[:, index].any()]
    by_class: dict[str, Finding] = {}
    for index in occurs:
        centre, edge = judge.centre(occupancy[:, index]), judge.edge(occupancy[:, index])
        with np.errstate(invalid="ignore"):
            samples = (centre - edge) / (centre + edge)
        name = classes[index]
        what = f"{name}: (centre - edge) / (centre + edge)"
        wanted = BELOW_0 if name == EXCEPT else ABOVE_0
        finding = judge.rare(what, samples, wanted, present[:, index])
        low, high = np.clip(finding.interval[1:], -1.0, 1.0)  # what such an index can be
        interval = finding.interval._replace(low=float(low), high=float(high))
        by_class[name] = replace(finding, interval=interval)
    others = tuple(found for name, found in by_class.items() if name != EXCEPT)
    statement = f"most classes are concentrated in the centre ({EXCEPT} apart)"
    verdict = most([each.verdict for each in others])
    found = [Claim("classes/central", statement, "III-B.2", verdict, others)]
    if EXCEPT in by_class:
        statement = f"{EXCEPT} is not concentrated in the centre"
        found.append(_claim("classes/except", "III-B.2", statement, by_class[EXCEPT]))
    if EVEN in by_class and len(by_class) > 1:
        evenness = normalised(occupancy).mean(-1)
        even = classes.index(EVEN)
        others_evenness = evenness[:, [index for index in occurs if index != even]].mean(-1)
        what = f"evenness of {EVEN} - mean evenness of the others"
        difference = evenness[:, even] - others_evenness
        finding = judge.rare(what, difference, ABOVE_0, present[:, even])
        statement = f"{EVEN} is distributed more evenly than the other classes"
        found.append(_claim("classes/even", "III-B.2", statement, finding))
    return found


def _laplacian(judge: Judge) -> list[Claim]:
    by_part = {part: judge.blocks.mean(judge.stats.laplacian, part) for part in judge.parts}
    everything = by_part[ALL]
    claims_of: dict[str, tuple[str, list[Finding]]] = {}
    if judge.has_centre:
        claims_of["centre"] = (
            "is higher in the centre (rgb, thermal)",
            [
                judge.centre_edge(modality, everything[:, index], ABOVE_1)
                for index, modality in enumerate(MODALITIES)
            ],
        )
    ratio = judge.ratio("rgb / thermal", everything[:, 0], everything[:, 1], ABOVE_1)
    claims_of["modality"] = "of rgb is above that of thermal", [ratio]
    for index, word, wanted in ((0, "above", ABOVE_1), (1, "below", BELOW_1)):
        statement = f"of {MODALITIES[index]} by day is {word} that at night"
        finding = _day_over_night(judge, by_part, index, wanted)
        claims_of[f"day_{MODALITIES[index]}"] = statement, [finding]
    return [
        _claim(f"laplacian/{key}", "III-B.3", f"Laplacian variance {statement}", *findings)
        for key, (statement, findings) in claims_of.items()
    ]


def _snr(judge: Judge, estimator: str, average: str) -> list[Claim]:
    by_part = {
        part: snr_samples(judge.stats, judge.blocks, part, estimator, average)
        for part in judge.parts
    }
    everything = by_part[ALL]
    claims_of: dict[str, tuple[str, list[Finding]]] = {}
    if judge.has_centre:
        parts = judge.parts[1:] or (ALL,)
        claims_of["centre"] = (
            "is lower in the centre (rgb and thermal, day and night)",
            [
                judge.centre_edge(f"{modality}, {part}", by_part[part][:, index], BELOW_1, part)
                for index, modality in enumerate(MODALITIES)
                for part in parts
            ],
        )
    ratio = judge.ratio("thermal / rgb", everything[:, 1], everything[:, 0], ABOUT_TEN)
    claims_of["modality"] = "of thermal is about ten times that of rgb", [ratio]
    by_day = [_day_over_night(judge, by_part, index, ABOVE_1) for index in range(len(MODALITIES))]
    claims_of["day"] = "by day is above that at night (rgb, thermal)", by_day
    way = estimator, average
    return [
        _claim(f"snr/{key}", "III-B.4", f"signal to noise {statement}", *findings, way=way)
        for key, (statement, findings) in claims_of.items()
    ]


def _day_over_night(
    judge: Judge, by_part: dict[str, Floats], index: int, wanted: tuple[float, float]
) -> Finding:
    what = f"{MODALITIES[index]}: day / night"
    if DAY not in by_part:
        nothing = ValueInterval(math.nan, math.nan, math.nan)
        return Finding(what, wanted, nothing, OPEN, "no images of both day and night")
    return judge.ratio(what, by_part[DAY][:, index], by_part[NIGHT][:, index], wanted)
