"""Verdicts of claims as text: a grid for the terminal, Markdown, tidy CSV."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from rgbt.tables import ABSENT, TextTable, csv_text, number
from sweeps.verdicts.judge import JudgedClaim

HEADER = (
    *("claim", "verdict", "contrast", "difference", "95 % interval", "printed", "can show"),
    *("seeds", "would decide"),
)
CSV_HEADER = (
    *("table", "claim", "source", "says", "verdict", "contrast", "estimate", "low", "high"),
    *("covers", "printed", "as_printed", "smallest", "seeds", "seeds_needed", "missing", "reason"),
)
NOTES = (
    "difference: mean over paired seeds; interval over images and seeds, of one seed over images "
    "alone. can show: the smallest difference that these seeds could have shown; would decide: "
    "seeds with which a difference as large as ours would be decided.",
    "A verdict is about the direction and the bounds of a claim, not about a size in its words. "
    "Each interval holds the truth in 95 % of cases by itself; of many claims without an effect, "
    "2.5 % are called holding.",
)
IMAGES = "images alone"
"""In the column of seeds: the difference of two evaluations without seeds."""


def claims_grid(judged: Sequence[JudgedClaim], title: str, *, tables: bool = False) -> TextTable:
    """One line per claim.

    Args:
        judged: claims of one or several tables.
        title: shown above.
        tables: name the table of each claim.
    """
    rows = tuple(
        (f"{each.table} {each.claim.name}" if tables else each.claim.name, *_fields(each))
        for each in judged
    )
    return TextTable(title, HEADER, rows, NOTES if any(each.verdict for each in judged) else ())


def counted(judged: Sequence[JudgedClaim]) -> str:
    """How many claims there are by verdict, in a sentence."""
    words = Counter(each.word for each in judged)
    parts = [f"{words[word]} {_plural(word, words[word])}" for word in WORDS if words[word]]
    return f"{len(judged)} claims: {', '.join(parts)}." if judged else "The table has no claims."


WORDS = ("holds", "contradicted", "undecided", "not run")


def _plural(word: str, count: int) -> str:
    return "hold" if word == "holds" and count > 1 else word


def claims_markdown(judged: Sequence[JudgedClaim], *, tables: bool = False) -> str:
    """The claims in Markdown: a table, then each statement with its place and its reason.

    Args:
        judged: claims of one or several tables.
        tables: name the table of each claim.
    """
    grid = claims_grid(judged, "Claims of the paper", tables=tables)
    lines = [grid.to_markdown(), ""]
    for each in judged:
        reason = f" {each.reason}" if each.reason else ""
        name = f"{each.table} `{each.claim.name}`" if tables else f"`{each.claim.name}`"
        lines.append(
            f"- {name}, **{each.word}**: {each.claim.says} ({each.claim.source}) "
            f"{printed_sentence(each)}{reason}".rstrip()
        )
        lines += [f"    - {remark}" for remark in each.claim.remarks]
    return "\n".join(lines) + "\n"


def printed_sentence(judged: JudgedClaim) -> str:
    """Whether the printed numbers agree with the statement."""
    if judged.as_printed is None:
        return "The printed values do not tell."
    agree = "agree" if judged.as_printed else "do not agree"
    return f"The printed values {agree}."


def claims_csv(judged: Sequence[JudgedClaim]) -> str:
    """One line per claim; columns: `CSV_HEADER`, empty where there is no value."""
    rows: list[tuple[object, ...]] = [CSV_HEADER]
    for each in judged:
        claim = each.claim
        about = (each.table, claim.name, claim.source, claim.says, each.word, each.contrast)
        printed = (_plain(each.printed), "" if each.as_printed is None else each.as_printed)
        numbers = ("", "", "", "", *printed, "", 0, "")
        if each.verdict is not None:
            found = each.verdict
            interval = found.interval
            ends = ("", "") if interval is None else (_plain(interval.low), _plain(interval.high))
            numbers = (
                *(_plain(found.estimate), *ends, found.covers, *printed),
                *(_plain(found.smallest), found.seeds, _plain(found.seeds_needed)),
            )
        rows.append((*about, *numbers, " | ".join(each.missing), each.reason))
    return csv_text(rows)


def _fields(judged: JudgedClaim) -> tuple[str, ...]:
    printed = ABSENT if judged.printed is None else f"{judged.printed:+.2f}"
    found = judged.verdict
    if found is None:
        return (judged.word, judged.contrast, ABSENT, ABSENT, printed, ABSENT, "0", ABSENT)
    interval = found.interval
    shown = ABSENT if interval is None else f"[{interval.low:+.2f}, {interval.high:+.2f}]"
    seeds = IMAGES if found.covers == "images" and not found.seeds else str(found.seeds)
    needed = {True: "never", False: ABSENT}.get(math.isinf(found.seeds_needed), ABSENT)
    if math.isfinite(found.seeds_needed):
        needed = f"{found.seeds_needed:.0f}"
    return (
        *(judged.word, judged.contrast, f"{found.estimate:+.2f}", shown, printed),
        *(number(found.smallest) if found.seeds != 1 else ABSENT, seeds, needed),
    )


def _plain(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.6g}"
