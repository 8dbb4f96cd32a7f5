"""A judged claim: its contrasts, what runs say about them, and in which words that is said.

A claim has two answers. The direction: as the claim says, the opposite, or not shown. The size: the
printed difference beside our interval. *holds* and *contradicted* are said of runs with the paper's
recipes on the paper's images alone, see `JudgedClaim.word`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from analysis.uncertainty.verdicts import Verdict
from sweeps.judge.seeds import Scores
from sweeps.plan.claim import Claim, Range
from sweeps.score.reader import REAL

# Words for the kinds of verdicts: on the paper's images with its recipes, and elsewhere.
OF_PAPER = {"holds": "holds", "contradicted": "contradicted", "undecided": "undecided"}
ELSEWHERE = {
    "holds": "same direction",
    "contradicted": "opposite direction",
    "undecided": "not shown",
}
NOT_COMPARABLE, JUDGED_ONCE, NOT_RUN = "not comparable", "judged once", "not run"
WORDS = (*OF_PAPER.values(), *ELSEWHERE.values(), NOT_COMPARABLE, JUDGED_ONCE, NOT_RUN)

# What a verdict rests on: the seeds that the table declared before they were run; other seeds,
# whose number may depend on results; networks that were evaluated alone; sizes that are counted.
Basis = Literal["confirmation", "exploration", "evaluation", "counted"]


@dataclass(frozen=True, kw_only=True)
class JudgedClaim:
    """A claim, or one of its contrasts by itself, with its verdict and what that is about.

    Attributes:
        table: its name, e.g. "spatialseg/table3".
        label: of the contrast whose numbers are shown.
        contrasts: those of different runs, in the order of the claim, each judged by itself.
        scores: of one contrast: the scores and runs that it is made of.
        printed: the contrast of the printed values; None where one is missing.
        as_printed: whether the printed values agree with the claim; None: some are missing.
        exploration: by all seeds but those that the table declares, valid at any time.
        confirmation: by the declared seeds alone; None where a row lacks one of them.
        rows: labels of the rows that it is about, in the order of the table.
        missing: those without a finished run.
        complete: whether every contrast of it could be computed.
        reason: why there is no verdict, or why it is open; one sentence, or "".
        images: "synthetic scenes", "real images of mfnet", ...; of several kinds all; "": no runs.
        scale: of the runs, in the same way.
        of_paper: whether the runs are the paper's: scale=paper, real images, no changed setting.
        is_level: whether it is about how high a score is.
        same_as: the claim before it that asks the same of the same runs, or "".
        warnings: rows of different lists; rows of one seed that were trained on different machines;
            contrasts that are the same runs.
    """

    table: str
    claim: Claim
    label: str
    contrasts: tuple[JudgedClaim, ...] = ()
    scores: Scores = frozenset()
    printed: float | None = None
    as_printed: bool | None = None
    exploration: Verdict | None = None
    confirmation: Verdict | None = None
    rows: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    complete: bool = False
    reason: str = ""
    images: str = ""
    scale: str = ""
    of_paper: bool = False
    is_level: bool = False
    same_as: str = ""
    warnings: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict | None:
        """The confirmation, or what was explored; None: there are no runs for it."""
        return self.confirmation or self.exploration

    @property
    def basis(self) -> Basis | None:
        """What `verdict` rests on; None without one."""
        if self.verdict is None:
            return None
        if self.confirmation is not None:
            return "confirmation"
        if self.verdict.seeds:
            return "exploration"
        return "counted" if self.verdict.covers == "none" else "evaluation"

    @property
    def size(self) -> str:
        """Our interval beside the printed difference: "includes it", "larger", ...; "": unknown."""
        if self.printed is None or self.verdict is None or self.verdict.interval is None:
            return ""
        # Papers print two decimals: -9.797 is the printed -9.80.
        interval = self.verdict.interval
        low, high = round(interval.low, 2), round(interval.high, 2)
        if low <= self.printed <= high:
            return "includes it"
        if low <= 0 <= high or self.printed * (low + high) > 0:
            return "larger" if min(abs(low), abs(high)) > abs(self.printed) else "smaller"
        return "other sign"

    @property
    def wanted(self) -> Range:
        """Open range of its contrasts: as claimed; not on the paper's images: its direction."""
        return self.claim.range if self.of_paper else self.claim.direction

    @property
    def requirement(self) -> tuple[Range, str]:
        """What it requires of `compared`: that A is above B is as much as that B is below A."""
        low, high = self.wanted
        is_lower = self.claim.expected == "lower"
        return ((-high, -low) if is_lower else (low, high)), self.claim.combine

    @property
    def compared(self) -> frozenset[Scores]:
        """What it compares: claims of the same runs and scores have the same."""
        return frozenset(single.scores for single in self.contrasts)

    @property
    def word(self) -> str:
        """One of `WORDS`."""
        if self.verdict is None:
            return NOT_RUN
        if self.basis == "counted":
            return OF_PAPER[self.verdict.kind]
        if self.is_level and not self.of_paper:
            return NOT_COMPARABLE
        if self.same_as:
            return JUDGED_ONCE
        return (OF_PAPER if self.of_paper else ELSEWHERE)[self.verdict.kind]

    @property
    def is_decided(self) -> bool:
        """Whether its direction is known."""
        return self.word in ("holds", "contradicted", "same direction", "opposite direction")


def are_of_paper(images: str, scale: str, *, is_changed: bool) -> bool:
    """Whether runs of one kind of images and scale are those of the paper."""
    return scale == "paper" and images.startswith(REAL) and " and " not in images and not is_changed
