"""Verdicts about contrasts: holds, contradicted, or undecided with the number of seeds needed.

`e_value` and `half_width` are a confidence sequence for the mean of normal values with unknown
variance. It may be looked at after every value, and the collection may stop at any time, for any
reason:

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
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from analysis.uncertainty.blocks import Values
from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.intervals import Interval, Spread, images_and_seeds, student

Combine = Literal["all", "most", "any", "mean"]
Kind = Literal["holds", "contradicted", "undecided"]
Covers = Literal["images and seeds", "images", "none"]

# Largest number of seeds that is searched for `Verdict.seeds_needed`.
MOST_SEEDS = 1000

# Warning of a verdict on one common start; rates of fixed seeds in simulations.
ONE_START = (
    "All seeds began from one start, and the interval does not contain the spread between starts. "
    "If a start shifts a difference by two standard deviations of the seeds, 18 % of claims about "
    "no difference hold with 3 seeds and 29 % with 5, and as many are contradicted."
)

# Precision of the prior over the effect size, whose standard deviation is 1 / sqrt(0.25) = 2. A
# table of few seeds can show differences of about two standard deviations. At an alpha of 0.025
# these need 7.1 seeds on average with a precision of 0.1 or 0.25, 7.3 with 0.5 and 7.9 with 1.
# Differences of one standard deviation need 16.7 (0.1), 15.8 (0.25), 15.5 and 15.5 seeds
# (tests/benchmarks/simulate_claims.py).
PRECISION = 0.25


def e_value(t: float, count: int, precision: float = PRECISION) -> float:
    """Return the evidence of `count` values against the mean that `t` is measured from.

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
    """Return half of the width of the interval after `count` values.

    It is the condition ``e_value < 1 / alpha`` solved for the tested mean; infinite with too few
    values. `sd`: their standard deviation (n - 1). `alpha`, 0..1, bounds the rate of sequences that
    ever miss the mean.
    """
    if count < 2:
        return math.inf
    shrunk = precision / (count + precision)
    limit = math.exp(2 / count * -math.log(alpha * math.sqrt(shrunk)))
    if limit * shrunk >= 1:
        return math.inf
    ratio = (limit - 1) / (1 - limit * shrunk)
    return sd * math.sqrt(ratio * (count - 1) / count)


@dataclass(frozen=True, kw_only=True)
class Rule:
    """How the seeds were chosen, which decides how wide an interval is.

    Attributes:
        any_time: False: the number of seeds was chosen before any result was known. The interval is
            that of `analysis.uncertainty.compare` for paired trainings: Student over images and
            seeds, never narrower than over seeds alone. Few seeds cannot show whether they are
            normal: with 3 to 10 lognormal ones (sd 1 of the logarithm), 14 to 18 % of the verdicts
            about no difference are wrong instead of 5 %.
            True: seeds are added until the verdict is clear. Seeds: a confidence sequence, see
            `half_width`. Images: Student's interval. Each has half of the error rate, and the
            squares of their half widths add up. At a `level` of 95 % for all intervals together,
            at most 4.8 % of simulated sequences ever missed the truth (2 to 3,000 seeds). With the
            whole error rate for each it was up to 9.8 %.
        level: confidence level of all intervals together.
    """

    any_time: bool = False
    level: float = 0.95

    def half(self, trainings: Spread, images: Spread, level: float) -> float:
        """Return half of the width of an interval; degrees of freedom of `trainings`: n - 1.

        Infinite where seeds are too few for a confidence sequence.
        """
        if not self.any_time:
            return student(0.0, images_and_seeds(images, trainings, level), level).half
        alpha = (1 - level) / 2
        count = round(trainings.freedom) + 1
        of_seeds = half_width(trainings.error * math.sqrt(count), count, alpha)
        return math.hypot(of_seeds, student(0.0, images, 1 - alpha).half)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What the data say about one claim, with the numbers of one of its contrasts.

    Attributes:
        estimate: the contrast, mean over paired seeds.
        interval: of the contrast, of a level that is corrected for the number of contrasts
            (`decide`); None where images or seeds are too few for one.
        covers: what was drawn anew: the trainings of fixed terms are not.
        smallest: smallest difference that could have been shown, half of the width of the interval.
        seeds: number of paired seeds used; 0 where all terms are fixed.
        seeds_needed: total number of paired seeds with which the present estimates would be
            decided; `seeds` where they are; inf: more than `MOST_SEEDS`, or the images alone leave
            it open; NaN: unknown.
        decisive: index of the contrast whose numbers are shown (the weakest for "all").
        reason: of "undecided", or which limit a verdict has; a short sentence.
        starts: number of starts from which the seeds were trained; None: no common ones.
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
    starts: int | None = None

    @property
    def warning(self) -> str:
        """What has to be printed beside the verdict; "" where it needs none."""
        return ONE_START if self.starts == 1 and self.seeds > 1 else ""


def similar(margin: float) -> tuple[float, float]:
    """Return the range of "does as well as": the whole interval must be inside the margin.

    Two one-sided tests, each with half of the error rate; that no difference was shown is no
    evidence for none. ValueError: the margin is no number above 0.

    Source: Schuirmann, Journal of Pharmacokinetics and Biopharmaceutics 15 (1987).
    """
    if not 0 < margin < math.inf:
        raise ValueError(f"margin: expected the largest difference that is none, got {margin}.")
    return -margin, margin


def decide(
    evidences: Sequence[Evidence],
    wanted: tuple[float, float],
    rule: Rule,
    combine: Combine,
    *,
    starts: int | None = None,
    missing: str = "",
) -> Verdict:
    """Decide a claim about one contrast or more.

    A contrast is as claimed where its whole interval is inside the open range `wanted`, and against
    the claim where the whole interval is outside. Where `u` of J contrasts must be as claimed, the
    claim holds if `u` intervals are inside, each with the error rate ``1 - level`` divided by
    ``J - u + 1`` (partial conjunction). It is contradicted if ``J - u + 1`` are outside, each with
    the error rate divided by `u`. So "all" needs no correction to hold (intersection-union test).

    Source: Benjamini and Heller, "Screening for Partial Conjunction Hypotheses", Biometrics 64
    (2008), with Bonferroni's combination.

    Args:
        evidences: one or more; of "mean" exactly one, whose terms already have the weights of the
            mean contrast.
        wanted: open range of a contrast that is as claimed; of "does as well as", see `similar`.
        rule: by whether the number of seeds depends on results.
        combine: how many contrasts must be as claimed: "all"; "most", more than half; "any", one.
        starts: see `Verdict`.
        missing: why further contrasts of the claim are not among `evidences`, such as rows that
            were not run; "": they all are. What is missing may be as claimed or not: "all" can then
            only be contradicted, "any" can only hold, and "most" stays undecided.

    Raises:
        ValueError: no evidence, or several for "mean".
    """
    if not evidences or (combine == "mean" and len(evidences) > 1):
        expected = "one evidence, of the mean contrast" if combine == "mean" else "evidence"
        raise ValueError(f"{combine}: expected {expected}, got {len(evidences)}.")
    needed = _needed(len(evidences), combine)
    against = len(evidences) - needed + 1  # so many outside the range contradict the claim
    kind = _kind(evidences, wanted, rule, needed)
    level = _level(rule, needed if kind == "contradicted" else against)
    # The contrast that is the last one to make the verdict, or the first one to prevent it.
    standings = _standings(evidences, wanted, rule, level)
    if kind == "contradicted":
        standings = -standings
    order = np.argsort(-standings, kind="stable")
    decisive = int(order[(against if kind == "contradicted" else needed) - 1])
    shown, estimate = evidences[decisive], float(np.mean(evidences[decisive].values))
    half, seeds = _half_width(shown, rule, level), len(shown.seeds)
    if seeds == 1 and shown.images is not None:
        half = student(0.0, shown.images, level).half
    known, seeds_needed = math.isfinite(half), float(seeds)
    if kind == "undecided":
        seeds_needed = _seeds_needed(evidences, wanted, rule, needed)
    covers: Covers = "none"
    if known:
        covers = "images and seeds" if seeds > 1 else "images"
    verdict = Verdict(
        kind=kind,
        estimate=estimate,
        interval=Interval(estimate - half, estimate + half) if known else None,
        covers=covers,
        smallest=half if known else math.nan,
        seeds=seeds,
        seeds_needed=seeds_needed,
        decisive=decisive,
        reason=_reason(kind, shown, half, seeds_needed),
        starts=starts,
    )
    if missing and kind != {"all": "contradicted", "any": "holds"}.get(combine):
        return replace(verdict, kind="undecided", seeds_needed=math.nan, reason=missing)
    return verdict


def _needed(count: int, combine: Combine) -> int:
    """Return how many of `count` contrasts must be as claimed."""
    return {"all": count, "most": count // 2 + 1, "any": 1, "mean": 1}[combine]


def _level(rule: Rule, others: int) -> float:
    """Return the level of each interval where `others` of them share the error rate."""
    return 1.0 - (1.0 - rule.level) / others


def _half_width(evidence: Evidence, rule: Rule, level: float, seeds: int = 0) -> float:
    """Return half of the width of an interval, with `seeds` seeds where they are more.

    Infinite or NaN where there is no interval.
    """
    if evidence.images is None:
        return math.nan
    if not evidence.seeds:  # all terms are fixed
        return student(0.0, evidence.images, level).half
    sd = float(np.std(evidence.values, ddof=1)) if len(evidence.values) > 1 else math.nan
    if math.isnan(sd):
        return math.inf
    count = max(len(evidence.seeds), seeds)
    return rule.half(Spread(sd / math.sqrt(count), count - 1), evidence.images, level)


def _standings(
    evidences: Sequence[Evidence],
    wanted: tuple[float, float],
    rule: Rule,
    level: float,
    seeds: int = 0,
) -> Values:
    """Return margins in half widths: above 1 inside the range, below -1 outside.

    0 where there is no interval, or neither a margin nor a width.
    """
    estimates = np.array([np.mean(evidence.values) for evidence in evidences])
    margins = np.minimum(estimates - wanted[0], wanted[1] - estimates)
    halves = np.array([_half_width(evidence, rule, level, seeds) for evidence in evidences])
    with np.errstate(divide="ignore", invalid="ignore"):
        found = margins / halves
    return np.where(np.isnan(found), 0.0, found)


def _kind(
    evidences: Sequence[Evidence],
    wanted: tuple[float, float],
    rule: Rule,
    needed: int,
    seeds: int = 0,
) -> Kind:
    """Decide by the present seeds, or as if there were `seeds`."""
    against = len(evidences) - needed + 1
    to_hold = _standings(evidences, wanted, rule, _level(rule, against), seeds)
    if (to_hold > 1).sum() >= needed:
        return "holds"
    to_contradict = _standings(evidences, wanted, rule, _level(rule, needed), seeds)
    if (to_contradict < -1).sum() >= against:
        return "contradicted"
    return "undecided"


def _seeds_needed(
    evidences: Sequence[Evidence], wanted: tuple[float, float], rule: Rule, needed: int
) -> float:
    """Search `Verdict.seeds_needed`; more seeds never make an interval wider."""

    def is_decided(seeds: int) -> bool:
        return _kind(evidences, wanted, rule, needed, seeds) != "undecided"

    if is_decided(MOST_SEEDS):
        found = bisect_left(range(2, MOST_SEEDS), True, key=is_decided)
        return float(2 + found)
    for evidence in evidences:
        if evidence.images is None or len(evidence.seeds) == 1:
            return math.nan
    return math.inf


def _reason(kind: Kind, shown: Evidence, half: float, seeds_needed: float) -> str:
    if kind != "undecided":
        return "" if shown.seeds else "As trained: other trainings are not covered."
    if shown.images is None:
        return "There are too few images for an interval."
    if len(shown.seeds) == 1:
        return "It needs two seeds or more."
    if not math.isfinite(half):
        return f"{len(shown.seeds)} seeds are too few for an interval that is valid at any time."
    if half == 0:
        return "The estimate is the limit of the claimed range, on every draw of the images."
    if math.isinf(seeds_needed):
        return "These images leave it open with any number of seeds."
    return f"Below {half:.2f}, nothing can be shown with these seeds and images."
