"""How images are resampled: one choice for every interval and test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from rgbt.checks import InputError, check_choice, check_range
from rgbt.metrics.metric import Absent

Method = Literal["auto", "percentile", "bca"]
NamedBlocks = Literal["auto", "none", "sequence"]

MOST = 1_000_000
"""Most resamples: more take time without a visible effect."""


@dataclass(frozen=True, kw_only=True)
class Resampling:
    """Settings of intervals and tests.

    Attributes:
        resamples: number of resamples, 100..`MOST`.
        level: confidence level of the intervals, 0.5..0.999.
        method: of intervals over images. "percentile": quantiles of the resampled scores; "bca":
            bias-corrected and accelerated (Efron, 1987); "auto": percentile, except for the
            variance over regions, whose bias is removed
            (`analysis.uncertainty.intervals.corrected`;
            docs/explanation/counts-and-intervals.md).
        blocks: what is drawn together, because neighbouring frames show nearly the same:
            "none" single images; a number: that many neighbours; "sequence": whole sequences (names
            that are equal but for one number); "auto": runs of consecutively numbered frames, cut
            where one is too long for that at the distance over which the scores of the images are
            correlated (Politis and White, 2004).
        absent: how a class without pixels scores, see `rgbt.metrics.scores`; None: as the counts
            say (`rgbt.metrics.counts.Counts.absent`).

    Raises:
        InputError: a value out of range.
    """

    resamples: int = 10_000
    level: float = 0.95
    method: Method = "auto"
    blocks: NamedBlocks | int = "auto"
    seed: int = 0
    absent: Absent | None = None

    def __post_init__(self) -> None:
        check_range("resamples", self.resamples, 100, MOST)
        check_range("level", self.level, 0.5, 0.999)
        check_choice("method", self.method, get_args(Method))
        if self.absent is not None:
            check_choice("absent", self.absent, get_args(Absent))
        if isinstance(self.blocks, int):
            check_range("blocks", self.blocks, 1, MOST)
        elif self.blocks not in get_args(NamedBlocks):
            known = ", ".join(get_args(NamedBlocks))
            raise InputError(f"blocks={self.blocks}: expected {known} or a number of images.")
