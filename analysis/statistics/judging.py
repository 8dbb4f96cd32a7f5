"""Decides claims: findings with intervals, and the verdicts that follow from them.

A claim is made of findings, each a number with an interval and the range that the claim puts it in.
A finding holds where the whole interval lies in the range, does not hold where all of it lies
outside, and is open otherwise. The claims themselves are in `claims`.

Centre and edge are the inner and the outer third of the regions (regions 1 to 3 and 7 to 9 of
nine): the paper says "central regions" and gives no number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.data import ALL, SpatialStatistics
from analysis.statistics.resampling import MIN_BLOCKS, ConsecutiveBlocks, Scale, ValueInterval

Verdict = Literal["holds", "does not hold", "cannot be decided on this sample"]
HOLDS: Verdict = "holds"
FAILS: Verdict = "does not hold"
OPEN: Verdict = "cannot be decided on this sample"

Range = tuple[float, float]
ABOVE_1: Range = (1.0, math.inf)
BELOW_1: Range = (0.0, 1.0)
ABOVE_0: Range = (0.0, math.inf)
BELOW_0: Range = (-math.inf, 0.0)
ABOUT_TEN: Range = (math.sqrt(10.0), 10.0 * math.sqrt(10.0))
"""Nearer to ten than to one or to a hundred, by order of magnitude."""

Floats = NDArray[np.float64]
"""Everywhere below with 1 + B rows: the sample, then its resamples."""


@dataclass(frozen=True)
class Finding:
    """One number that a claim depends on.

    Attributes:
        what: is measured, e.g. "rgb, day: centre / edge".
        wanted: (low, high), where the claim puts it.
        interval: NaN ends where the sample is too small for one.
        note: further information, e.g. "7 of 9 regions".
    """

    what: str
    wanted: Range
    interval: ValueInterval
    verdict: Verdict
    note: str = ""


@dataclass(frozen=True)
class Claim:
    """One claim of the paper.

    Attributes:
        key: short name, e.g. "snr/centre".
        statement: what the paper says, in its terms.
        source: section of SpatialSeg.
        verdict: "holds" if every finding holds, "does not hold" if one does not, else open (for
            "most classes" the majority counts). Levels are those of single findings: of m findings
            that all hold barely, one is refused in up to ``m (1 - level) / 2`` of all samples.
        estimator: of the noise; "" where the claim does not depend on it.
        average: of the signal-to-noise ratios; "" likewise.
    """

    key: str
    statement: str
    source: str
    verdict: Verdict
    findings: tuple[Finding, ...]
    estimator: str = ""
    average: str = ""


class Judge:
    """A sample with its resamples; turns resampled numbers into findings."""

    def __init__(self, stats: SpatialStatistics, blocks: ConsecutiveBlocks, level: float) -> None:
        self.stats = stats
        self.blocks = blocks
        self.level = level
        self.has_centre = stats.partition.startswith("ring") and stats.num_regions > 1
        self.third = max(1, stats.num_regions // 3)
        self.parts = stats.subsets()

    def ratio(self, what: str, above: Floats, below: Floats, wanted: Range) -> Finding:
        """Finding about the quotient of the means over regions; (1 + B, R) each, all images."""
        quotient = _quotient(above[0], below[0])
        agree = int(((quotient > wanted[0]) & (quotient < wanted[1])).sum())
        note = f"so in {agree} of {above.shape[1]} regions"
        samples = _quotient(above.mean(1), below.mean(1))
        found = self.finding(what, samples, wanted, scale="ratio")
        return replace(found, note=found.note or note)

    def centre_edge(self, what: str, values: Floats, wanted: Range, part: str = ALL) -> Finding:
        """Finding about the quotient of centre and edge of (1 + B, R) values."""
        samples = _quotient(self.centre(values), self.edge(values))
        return self.finding(f"{what}: centre / edge", samples, wanted, part, scale="ratio")

    def centre(self, values: Floats) -> Floats:
        """Mean of the inner third of the last axis."""
        return np.asarray(values[..., : self.third].mean(-1))

    def edge(self, values: Floats) -> Floats:
        """Mean of the outer third of the last axis."""
        return np.asarray(values[..., -self.third :].mean(-1))

    def largest_step(self, what: str, values: Floats) -> Finding:
        """Finding that (1 + B, R) values fall at every step from one region to the next.

        One of R - 1 steps may look like a rise by chance, so that each gets an interval of level
        ``1 - (1 - level) / (R - 1)`` (Bonferroni). The largest step is shown.
        """
        steps = np.diff(values)
        level = 1 - (1 - self.level) / steps.shape[1]
        findings = [self.finding(what, step, BELOW_0, level=level) for step in steps.T]
        verdict = every([each.verdict for each in findings])
        largest = int(np.argmax(steps[0]))
        note = f"{(steps[0] < 0).sum()} of {steps.shape[1]} steps fall; {findings[largest].note}"
        shown = replace(findings[largest], verdict=verdict, note=note.removesuffix("; "))
        return replace(shown, what=f"{what} ({largest + 1} to {largest + 2})")

    def finding(
        self,
        what: str,
        samples: Floats,
        wanted: Range,
        part: str = ALL,
        *,
        scale: Scale = "linear",
        level: float | None = None,
    ) -> Finding:
        """Finding about one number of `part`, (1 + B,) with its resamples.

        Args:
            what: says what it is.
            samples: see `ConsecutiveBlocks.interval`.
            wanted: where the claim puts it.
            part: that it comes from.
            scale: "ratio" for a positive quotient.
            level: of confidence; None: the one of all findings.
        """
        level = self.level if level is None else level
        interval = self.blocks.interval(samples, part, level=level, scale=scale)
        found = Finding(what, wanted, interval, decide(interval, wanted))
        return _if_enough(found, min(self.blocks.sizes(part)))

    def rare(
        self, what: str, samples: Floats, wanted: Range, present: NDArray[np.bool_]
    ) -> Finding:
        """Finding about something that only the images `present` (N,) say anything about."""
        return _if_enough(self.finding(what, samples, wanted), self.blocks.containing(present))


def decide(interval: ValueInterval, wanted: Range) -> Verdict:
    """Where the whole interval lies: in the range, outside it, or neither."""
    if interval.low >= wanted[0] and interval.high <= wanted[1]:
        return HOLDS
    return FAILS if interval.high < wanted[0] or interval.low > wanted[1] else OPEN


def every(verdicts: list[Verdict]) -> Verdict:
    """Verdict on "all of these"; open where there are none."""
    if FAILS in verdicts:
        return FAILS
    return HOLDS if verdicts and set(verdicts) == {HOLDS} else OPEN


def most(verdicts: list[Verdict]) -> Verdict:
    """Verdict on "more than half of these"."""
    half = len(verdicts) / 2
    if verdicts.count(HOLDS) > half:
        return HOLDS
    return FAILS if len(verdicts) - verdicts.count(FAILS) <= half and verdicts else OPEN


def _if_enough(finding: Finding, blocks: int) -> Finding:
    """`finding`, or its value alone where it rests on too few blocks."""
    if blocks >= MIN_BLOCKS:
        return finding
    nothing = ValueInterval(finding.interval.value, math.nan, math.nan)
    note = f"only {blocks} block{'' if blocks == 1 else 's'} of images"
    return replace(finding, interval=nothing, verdict=OPEN, note=note)


def _quotient(above: Floats, below: Floats) -> Floats:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(above / below)
