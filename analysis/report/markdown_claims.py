"""The claims of the papers as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from analysis.report.claim_views import (
    IMAGES,
    VERDICTS,
    PaperClaims,
    PlacedClaim,
    needed,
    printed_sentence,
    seeds,
    why,
)
from analysis.report.data import FormsEntry
from analysis.report.markdown_tables import markdown_table
from analysis.report.views import DASH, fixed, interval_text, with_sign

AGREES = {None: DASH, True: "yes", False: "no"}


@dataclass(frozen=True)
class ClaimTexts:
    """The claims of a table as Markdown.

    Attributes:
        claims: of one table.
    """

    claims: Sequence[PlacedClaim]

    def judged_table(self) -> str:
        """One line per claim with a verdict; "" without any."""
        header = [
            *("claim", "verdict", "contrast", "difference", "95 % interval", "printed"),
            *("can show", "seeds", "would decide"),
        ]
        rows = [_numbers(f"`{each.entry.name}`", each) for each in self._judged]
        return markdown_table(header, rows, (0, 1, 2)) if rows else ""

    def sentences(self) -> list[tuple[str, tuple[str, ...]]]:
        """Of every claim: verdict, statement, place, printed values; and its remarks."""
        return [
            (
                " ".join(
                    filter(
                        None,
                        (
                            f"`{entry.name}`, **{entry.verdict}**: {entry.says} ({entry.source})",
                            _printed(each),
                            why(entry),
                        ),
                    )
                ),
                entry.remarks,
            )
            for each in self.claims
            for entry in [each.entry]
        ]

    @property
    def _judged(self) -> list[PlacedClaim]:
        return [each for each in self.claims if each.entry.verdict != "not run"]


def _printed(claim: PlacedClaim) -> str:
    """Whether the printed values agree; of a claim without a line in the table, with the size."""
    entry = claim.entry
    sentence = printed_sentence(entry)
    if entry.verdict != "not run" or entry.printed is None:
        return sentence
    return f"{sentence.rstrip('.')}: {entry.contrast} is {with_sign(entry.printed)}."


def _numbers(name: str, claim: PlacedClaim) -> list[str]:
    entry = claim.entry
    alone = f" ({IMAGES})" if entry.covers == "images" else ""
    return [
        name,
        VERDICTS[entry.verdict],
        entry.contrast,
        with_sign(entry.estimate),
        interval_text(entry.low, entry.high) + alone,
        with_sign(entry.printed),
        fixed(entry.smallest),
        seeds(entry),
        needed(entry),
    ]


def counts_table(papers: Sequence[PaperClaims]) -> str:
    """One line per paper, scale and form: claims by verdict."""
    header = ["paper", "scale", "claims", *VERDICTS, "printed agree", "printed do not agree"]
    rows = [
        [
            ", ".join(filter(None, (f"[{paper.paper}]({paper.paper}.md)", paper.data, paper.form))),
            paper.scale or DASH,
            str(len(paper.claims)),
            *(str(paper.count(verdict)) for verdict in VERDICTS),
            str(paper.printed(True)),
            str(paper.printed(False)),
        ]
        for paper in papers
    ]
    return markdown_table(header, rows, (0, 1))


def judged_table(papers: Sequence[PaperClaims]) -> str:
    """The claims of all papers that have a verdict, with their statements; "" without any."""
    header = [
        *("claim", "verdict", "contrast", "difference", "95 % interval", "printed"),
        *("printed agrees", "can show", "seeds", "would decide"),
    ]
    rows = []
    for paper in papers:
        for each in paper.judged:
            number = each.view.entry.number
            name = f"{each.entry.says} ({paper.paper}, {number}; {paper.run_as})"
            numbers = _numbers(name, each)
            rows.append([*numbers[:6], AGREES[each.entry.as_printed], *numbers[6:]])
    return markdown_table(header, rows, (0, 1, 2, 6)) if rows else ""


def forms_table(entry: FormsEntry) -> str:
    """Released less paper, by row and column."""
    return markdown_table(entry.header, entry.rows, (0, len(entry.header) - 1))
