"""The qualitative claims of SpatialSeg, Sec. III-B and III-C, decided on a data set.

Each function here is one claim in numbers; how numbers become a verdict is in `judging`. Claims
that need a network's predictions are not here.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from analysis.statistics.data import ALL, MODALITIES, SpatialStatistics
from analysis.statistics.derive import (
    AVERAGES,
    class_occupancy_of,
    entropy_of,
    normalised,
    occupancy_of,
    snr_of,
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
from analysis.statistics.resampling import MOST_RESAMPLES, ConsecutiveBlocks, ValueInterval
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
        in the order of the paper; those about noise once per estimator and average.

    Raises:
        InputError: a number out of range.
    """
    check_resampling(blocks, resamples, level)
    judge = Judge(
        stats, ConsecutiveBlocks(stats, size=blocks, resamples=resamples, seed=seed), level
    )
    found: list[Claim] = []
    if judge.has_centre:
        found += [_occupancy(judge), *_classes(judge)]
    if stats.partition.startswith("horizontal") and stats.num_regions > 2:
        found.append(_middle(judge))
    found += _laplacian(judge)
    for estimator in stats.noise:
        for average in AVERAGES:
            found += _snr(judge, estimator, average)
    if judge.has_centre:
        found += [_entropy(judge, background=True), _entropy(judge, background=False)]
    return tuple(found)


def check_resampling(blocks: int, resamples: int, level: float) -> None:
    """Raise InputError where a number of `claims` is out of range."""
    check_range("blocks", blocks, 1, 1_000_000)
    check_range("resamples", resamples, 100, MOST_RESAMPLES)
    check_range("level", level, 0.5, 0.999)


def _occupancy(judge: Judge) -> Claim:
    values = 100 * occupancy_of(judge.blocks.mean(judge.stats.labels))
    difference = judge.centre(values) - judge.edge(values)
    findings = [
        judge.finding("centre - edge, points", difference, ABOVE_0),
        judge.largest_step("largest step outwards, points", values),
    ]
    return Claim(
        "occupancy/falls",
        "sample occupancy falls from the inner to the outer regions",
        "III-B.1",
        every([each.verdict for each in findings]),
        tuple(findings),
    )


def _classes(judge: Judge) -> list[Claim]:
    """Fig. 3, each class as (centre - edge) / (centre + edge): 1 central, 0 even, -1 outside."""
    labels = judge.stats.labels
    occupancy = class_occupancy_of(judge.blocks.mean(labels))
    occurs = [k for k in range(1, len(judge.stats.classes)) if labels[..., k].any()]
    by_class: dict[str, Finding] = {}
    for index in occurs:
        centre, edge = judge.centre(occupancy[:, index]), judge.edge(occupancy[:, index])
        with np.errstate(invalid="ignore"):
            samples = (centre - edge) / (centre + edge)
        name = judge.stats.classes[index]
        what = f"{name}: (centre - edge) / (centre + edge)"
        present = labels[..., index].sum(1) > 0
        wanted = BELOW_0 if name == EXCEPT else ABOVE_0
        by_class[name] = _within_one(judge.rare(what, samples, wanted, present))
    others = tuple(found for name, found in by_class.items() if name != EXCEPT)
    found = [
        Claim(
            "classes/central",
            f"most classes are concentrated in the centre ({EXCEPT} apart)",
            "III-B.2",
            most([each.verdict for each in others]),
            others,
        )
    ]
    if EXCEPT in by_class:
        statement = f"{EXCEPT} is not concentrated in the centre"
        finding = by_class[EXCEPT]
        found.append(Claim("classes/except", statement, "III-B.2", finding.verdict, (finding,)))
    if EVEN in by_class and len(by_class) > 1:
        found.append(_even_class(judge, occupancy, occurs))
    return found


def _within_one(finding: Finding) -> Finding:
    """`finding` with the ends of its interval cut to what an index can be, -1..1."""
    low, high = np.clip(finding.interval[1:], -1.0, 1.0)
    interval = finding.interval._replace(low=float(low), high=float(high))
    return replace(finding, interval=interval)


def _even_class(judge: Judge, occupancy: Floats, occurs: list[int]) -> Claim:
    """Evenness: mean over regions of the occupancy as Fig. 3 normalises it, 1 where all equal."""
    evenness = normalised(occupancy).mean(-1)
    even = judge.stats.classes.index(EVEN)
    others = evenness[:, [index for index in occurs if index != even]]
    finding = judge.rare(
        f"evenness of {EVEN} - mean evenness of the others",
        evenness[:, even] - others.mean(-1),
        ABOVE_0,
        judge.stats.labels[..., even].sum(1) > 0,
    )
    statement = f"{EVEN} is distributed more evenly than the other classes"
    return Claim("classes/even", statement, "III-B.2", finding.verdict, (finding,))


def _middle(judge: Judge) -> Claim:
    values = 100 * occupancy_of(judge.blocks.mean(judge.stats.labels))
    middle = judge.stats.num_regions // 2
    ends = (values[:, 0] + values[:, -1]) / 2
    finding = judge.finding("middle - mean of the ends, points", values[:, middle] - ends, ABOVE_0)
    statement = "of horizontal strips the middle has the highest occupancy"
    return Claim("occupancy/middle", statement, "III-B.1", finding.verdict, (finding,))


def _laplacian(judge: Judge) -> list[Claim]:
    by_part = {part: judge.blocks.mean(judge.stats.laplacian, part) for part in judge.parts}
    everything = by_part[ALL]
    found = []
    if judge.has_centre:
        findings = [
            judge.centre_edge(modality, everything[:, index], ABOVE_1)
            for index, modality in enumerate(MODALITIES)
        ]
        found.append(_laplacian_claim("centre", "is higher in the centre (rgb, thermal)", findings))
    ratio = judge.ratio("rgb / thermal", everything[:, 0], everything[:, 1], ABOVE_1)
    found.append(_laplacian_claim("modality", "of rgb is above that of thermal", [ratio]))
    for index, (modality, word, wanted) in enumerate(
        (("rgb", "above", ABOVE_1), ("thermal", "below", BELOW_1))
    ):
        findings = [_day_over_night(judge, modality, by_part, index, wanted)]
        statement = f"of {modality} by day is {word} that at night"
        found.append(_laplacian_claim(f"day_{modality}", statement, findings))
    return found


def _laplacian_claim(key: str, statement: str, findings: list[Finding]) -> Claim:
    verdict = every([each.verdict for each in findings])
    text = f"Laplacian variance {statement}"
    return Claim(f"laplacian/{key}", text, "III-B.3", verdict, tuple(findings))


def _snr(judge: Judge, estimator: str, average: str) -> list[Claim]:
    by_part = {part: _snr_samples(judge, part, estimator, average) for part in judge.parts}
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
    claims_of["day"] = (
        "by day is above that at night (rgb, thermal)",
        [
            _day_over_night(judge, modality, by_part, index, ABOVE_1)
            for index, modality in enumerate(MODALITIES)
        ],
    )
    return [
        Claim(
            key=f"snr/{key}",
            statement=f"signal to noise {statement}",
            source="III-B.4",
            verdict=every([each.verdict for each in findings]),
            findings=tuple(findings),
            estimator=estimator,
            average=average,
        )
        for key, (statement, findings) in claims_of.items()
    ]


def _snr_samples(judge: Judge, part: str, estimator: str, average: str) -> Floats:
    """(1 + B, 2, R)."""
    stats, blocks = judge.stats, judge.blocks
    if average == "pooled":
        return snr_of(blocks.mean(stats.mean, part), blocks.mean(stats.noise[estimator], part))
    return blocks.mean(snr_of(stats.mean, stats.noise[estimator]), part)


def _day_over_night(
    judge: Judge, modality: str, by_part: dict[str, Floats], index: int, wanted: tuple[float, float]
) -> Finding:
    what = f"{modality}: day / night"
    if DAY not in by_part:
        nothing = ValueInterval(math.nan, math.nan, math.nan)
        return Finding(what, wanted, nothing, OPEN, "no images of both day and night")
    return judge.ratio(what, by_part[DAY][:, index], by_part[NIGHT][:, index], wanted)


def _entropy(judge: Judge, *, background: bool) -> Claim:
    values = entropy_of(judge.blocks.mean(judge.stats.labels), background=background)
    word = "with" if background else "without"
    finding = judge.finding(
        "centre - edge, bits", judge.centre(values) - judge.edge(values), ABOVE_0
    )
    return Claim(
        f"entropy/{word}_background",
        f"label entropy {word} background is higher in the centre",
        "III-C.1",
        finding.verdict,
        (finding,),
    )
