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

# Warning of a verdict on one common start; rates of `FixedSeeds` in simulations.
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


@dataclass(frozen=True, kw_only=True)
class FixedSeeds:
    """Rule for a number of seeds that was chosen before any result was known.

    The interval of `level` is that of `analysis.uncertainty.compare` for paired trainings: Student
    over images and seeds, never narrower than over seeds alone. Few seeds cannot show whether they
    are normal: with 3 to 10 lognormal ones (sd 1 of the logarithm), 14 to 18 % of the verdicts
    about no difference are wrong instead of 5 %.
    """

    level: float = 0.95

    def half(self, trainings: Spread, images: Spread, level: float) -> float:
        """Half of the width of the interval; degrees of freedom of `trainings`: n - 1."""
        return student(0.0, images_and_seeds(images, trainings, level), level).half


@dataclass(frozen=True, kw_only=True)
class AnyTime:
    """Rule for seeds that are added until the verdict is clear.

    Seeds: a confidence sequence, see `half_width`. Images: Student's interval.
    Each has half of the error rate, and the squares of their half widths add up. At a `level` of
    95 % for all intervals together, at most 4.8 % of simulated sequences ever missed the truth (2
    to 3,000 seeds). With the whole error rate for each it was up to 9.8 %.
    """

    level: float = 0.95

    def half(self, trainings: Spread, images: Spread, level: float) -> float:
        """The rule of `FixedSeeds`; infinite where seeds are too few for a confidence sequence."""
        alpha = (1 - level) / 2
        count = round(trainings.freedom) + 1
        of_seeds = half_width(trainings.error * math.sqrt(count), count, alpha)
        return math.hypot(of_seeds, student(0.0, images, 1 - alpha).half)


Rule = FixedSeeds | AnyTime


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
    """The range of "does as well as": it holds where the whole interval is inside the margin.

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
    count = len(evidences)
    needed = {"all": count, "most": count // 2 + 1, "any": 1, "mean": 1}[combine]
    claim = _Claim(evidences, wanted, rule, needed)
    kind = claim.kind()
    decisive = claim.decisive(kind)
    shown, estimate = evidences[decisive], float(claim.estimates[decisive])
    half, seeds = float(claim.halves(kind)[decisive]), len(shown.seeds)
    if seeds == 1 and shown.images is not None:
        half = student(0.0, shown.images, claim.level(kind)).half
    known = math.isfinite(half)
    seeds_needed = claim.seeds_needed() if kind == "undecided" else float(seeds)
    verdict = Verdict(
        kind=kind,
        estimate=estimate,
        interval=Interval(estimate - half, estimate + half) if known else None,
        covers="none" if not known else "images and seeds" if seeds > 1 else "images",
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


class _Claim:
    """Contrasts of which at least `needed` must be as claimed."""

    def __init__(
        self,
        evidences: Sequence[Evidence],
        wanted: tuple[float, float],
        rule: Rule,
        needed: int,
    ) -> None:
        self.evidences, self.rule, self.needed = evidences, rule, needed
        self.estimates = np.array([np.mean(each.values) for each in evidences])
        self.margins = np.minimum(self.estimates - wanted[0], wanted[1] - self.estimates)
        self.sds = [np.std(e.values, ddof=1) if len(e.values) > 1 else math.nan for e in evidences]
        self.against = len(evidences) - needed + 1  # outside the range, they contradict the claim

    def level(self, kind: Kind) -> float:
        """Level of each interval; of an open claim that with which it would hold."""
        others = self.needed if kind == "contradicted" else self.against
        return 1.0 - (1.0 - self.rule.level) / others

    def halves(self, kind: Kind, seeds: int = 0) -> list[float]:
        """Half widths of the intervals that give `kind`, with `seeds` seeds where they are more.

        Infinite or NaN where there is no interval.
        """
        level, found = self.level(kind), []
        for each, sd in zip(self.evidences, self.sds, strict=True):
            count = max(len(each.seeds), seeds)
            if each.images is None:
                found.append(math.nan)
            elif not each.seeds:  # all terms are fixed
                found.append(student(0.0, each.images, level).half)
            elif math.isnan(sd):
                found.append(math.inf)
            else:
                trainings = Spread(float(sd) / math.sqrt(count), count - 1)
                found.append(self.rule.half(trainings, each.images, level))
        return found

    def standings(self, kind: Kind, seeds: int = 0) -> Values:
        """Margins in half widths, above 1 inside the range ("contradicted": outside).

        0 where there is no interval, or neither a margin nor a width.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            found = self.margins / np.array(self.halves(kind, seeds))
        return np.where(np.isnan(found), 0.0, -found if kind == "contradicted" else found)

    def kind(self, seeds: int = 0) -> Kind:
        """The verdict, by the present seeds or as if there were `seeds`."""
        if (self.standings("holds", seeds) > 1).sum() >= self.needed:
            return "holds"
        if (self.standings("contradicted", seeds) > 1).sum() >= self.against:
            return "contradicted"
        return "undecided"

    def decisive(self, kind: Kind) -> int:
        """The contrast that is the last one to make the verdict, or the first one to prevent it."""
        order = np.argsort(-self.standings(kind), kind="stable")
        return int(order[(self.against if kind == "contradicted" else self.needed) - 1])

    def seeds_needed(self) -> float:
        """See `Verdict.seeds_needed`; more seeds never make an interval wider."""
        if self.kind(MOST_SEEDS) != "undecided":
            counts = range(2, MOST_SEEDS)
            found = bisect_left(counts, True, key=lambda seeds: self.kind(seeds) != "undecided")
            return float(2 + found)
        unknown = any(each.images is None or len(each.seeds) == 1 for each in self.evidences)
        return math.nan if unknown else math.inf


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
