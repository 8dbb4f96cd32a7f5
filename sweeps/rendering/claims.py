"""Judged claims as one frame; terminal, Markdown, CSV and counts are views of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rgbt.tables import ABSENT, TextTable, csv_text
from sweeps.rendering.table import plain
from sweeps.verdicts.judge import JudgedClaim

if TYPE_CHECKING:
    import pandas as pd

WORDS = ("holds", "contradicted", "undecided", "not run")
NOTES = (
    "ours: mean over paired seeds, and its 95 % interval over images and seeds, of one seed over "
    "images alone. decides: seeds with which a difference as large as ours would be decided.",
    "A verdict is about the direction and the bounds of a claim, not about a size in its words. "
    "Each interval holds the truth in 95 % of cases by itself; of many claims without an effect, "
    "2.5 % are called holding. With seeds far from normal (lognormal, sd 1 of the logarithm) 14 to "
    "18 % of verdicts about no difference are wrong.",
)
IMAGES = "images alone"
"""In the column of seeds: the difference of two evaluations without seeds."""

FIRST = ["table", "paper", "claim", "verdict", "as_printed", "seeds", "covers"]
"""Columns of a frame without a claim, beside `BASIS`."""

BASIS = ["images", "scale", "start", "how"]
"""Claims that differ in one of these are never in one grid."""


def claims_frame(judged: Sequence[JudgedClaim], how: str = "") -> pd.DataFrame:
    """One claim a row; `how` names the form and overrides of all rows.

    Returns:
        the columns table, paper, claim, source, says, remarks (a tuple), verdict, contrast,
        estimate, low, high, covers, printed, as_printed (True, False or None), margin (of "does as
        well as"; NaN of others), smallest, seeds, seeds_needed, images, scale and start of the
        runs, how, starts (their number), warning, missing and reason. Without a value numbers are
        NaN, seeds 0 and texts "".
    """
    import pandas as pd

    rows = []
    for each in judged:
        claim, found, basis = each.claim, each.verdict, each.basis
        around = None if found is None else found.interval
        seeds = 0 if found is None else found.seeds
        one_start = basis is not None and basis.starts == 1 and seeds > 1
        margin = claim.at_most if claim.expected == "similar" else None
        words = ["", "", "", how]
        if basis is not None:
            start = "one start for all seeds" if one_start else "a start for each seed"
            words = [basis.images, basis.scale, start, how]
        rows.append(
            {
                **{"table": each.table, "paper": each.table.rpartition("/")[0] or "studies"},
                **{"claim": claim.name, "source": claim.source, "says": claim.says},
                **{"remarks": claim.remarks, "verdict": each.word, "contrast": each.contrast},
                "estimate": math.nan if found is None else found.estimate,
                "low": math.nan if around is None else around.low,
                "high": math.nan if around is None else around.high,
                "covers": "" if found is None else found.covers,
                "printed": math.nan if each.printed is None else each.printed,
                "as_printed": each.as_printed,
                "margin": math.nan if margin is None else margin,
                "smallest": math.nan if found is None else found.smallest,
                "seeds": seeds,
                "seeds_needed": math.nan if found is None else found.seeds_needed,
                **dict(zip(BASIS, words, strict=True)),
                "starts": 0 if basis is None else min(seeds, basis.starts),
                "warning": "" if found is None else found.warning,
                "missing": " | ".join(each.missing),
                "reason": each.reason,
            }
        )
    columns = list(rows[0]) if rows else [*FIRST, *BASIS]
    return pd.DataFrame(rows, columns=columns).astype({"as_printed": object})


def counted(frame: pd.DataFrame) -> str:
    """How many claims there are by verdict, in a sentence."""
    counts = frame["verdict"].value_counts()
    parts = [
        f"{counts[word]} {'hold' if word == 'holds' and counts[word] > 1 else word}"
        for word in WORDS
        if word in counts
    ]
    return f"{len(frame)} claims: {', '.join(parts)}." if parts else "The table has no claims."


def counts_grid(frame: pd.DataFrame) -> TextTable:
    """Claims of every paper by verdict, and with how many of them its printed values agree."""
    header = ("paper", "claims", *WORDS, "printed agree", "printed do not agree", "not printed")
    rows = []
    for paper, each in frame.groupby("paper", sort=True):
        verdicts = [int((each["verdict"] == word).sum()) for word in WORDS]
        printed = each["as_printed"].tolist()
        agree = [sum(value is word for value in printed) for word in (True, False, None)]
        rows.append((str(paper), *map(str, (len(each), *verdicts, *agree))))
    return TextTable("", header, tuple(rows))


def basis_of(images: str, scale: str, start: str, how: str) -> str:
    """What verdicts rest on: "synthetic images, scale=bench, a start for each seed"."""
    return ", ".join(filter(None, (f"{images} images", f"scale={scale}", start, how)))


def claim_grids(frame: pd.DataFrame, *, narrow: bool = False) -> list[TextTable]:
    """The judged claims, one grid for each kind of images, scale and start, the rest last.

    Args:
        frame: of `claims_frame`.
        narrow: the columns that fit into a terminal of 80 characters.
    """
    grids = []
    for key, each in frame.groupby(BASIS, sort=False):
        texts = [(row, shown(row)) for _, row in each.iterrows()]
        judged = each[each["verdict"] != "not run"]
        title = f"{counted(each)} {basis_of(*key).capitalize()}." if key[1] else counted(each)
        header: tuple[str, ...] = ("verdict", "claim", "contrast", "ours", "95 % interval")
        header += ("printed", "can show", "seeds", "starts", "decides")
        rows = [(row["verdict"], row["says"], *text.values()) for row, text in texts]
        if narrow:
            header = ("verdict", "claim", "ours", "seeds", "decides")
            rows = [
                (
                    row["verdict"],
                    f"{row['table']} {row['claim']}: {text['contrast']}",
                    f"{text['ours']} {text['interval']}".removesuffix(f" {ABSENT}"),
                    *(text["seeds"], text["decides"]),
                )
                for row, text in texts
            ]
        notes = NOTES[: 2 if narrow and len(judged) else 0]
        warnings = tuple(filter(None, judged["warning"].unique())) if len(judged) else ()
        grids.append(TextTable(title, header, tuple(rows), (*warnings, *notes)))
    return grids


def shown(row: pd.Series) -> dict[str, str]:
    """The numbers of a claim as text."""
    seeds, needed = int(row["seeds"]), float(row["seeds_needed"])
    alone = row["covers"] == "images" and not seeds
    interval = f"[{_signed(row['low'])}, {_signed(row['high'])}]"
    decides = "never" if math.isinf(needed) else ABSENT if math.isnan(needed) else f"{needed:.0f}"
    return {
        "contrast": row["contrast"],
        "ours": _signed(row["estimate"]),
        "interval": ABSENT if math.isnan(row["low"]) else interval,
        "printed": _signed(row["printed"]),
        "smallest": f"{row['smallest']:.2f}" if seeds != 1 and row["smallest"] >= 0 else ABSENT,
        "seeds": IMAGES if alone else str(seeds),
        "starts": str(row["starts"]) if seeds else ABSENT,
        "decides": decides if row["verdict"] == "undecided" else ABSENT,
    }


def _signed(value: float) -> str:
    return ABSENT if math.isnan(value) else f"{value:+.2f}"


def statement(row: pd.Series) -> str:
    """A claim with its verdict, its numbers and what these rest on, as Markdown."""
    text = shown(row)
    limit = "" if math.isnan(row["margin"]) else f" Alike means within {row['margin']:g}."
    if row["verdict"] == "not run":
        return f"{row['says']} **Not run.**"
    basis = ""
    if row["scale"]:
        seeds = IMAGES if text["seeds"] == IMAGES else f"{text['seeds']} seeds"
        basis = f" ({basis_of(*row[BASIS])}, {seeds})"
    warning = f" {row['warning']}" if row["warning"] else ""
    return (
        f"{row['says']} **{row['verdict'].capitalize()}**: {text['contrast']} "
        f"{text['ours']} {text['interval']}{basis}.{limit}{warning}"
    )


def claim_lines(frame: pd.DataFrame) -> list[str]:
    """Every claim as an item of a Markdown list: statement, place, printed values, reason."""
    lines = []
    for _, row in frame.iterrows():
        words = {True: "agree", False: "do not agree", None: "do not tell"}
        printed = f"The printed values {words[row['as_printed']]}"
        printed += "" if math.isnan(row["printed"]) else f" ({row['printed']:+.2f})"
        reason = f" {row['reason'][:1].upper()}{row['reason'][1:]}" if row["reason"] else ""
        lines.append(f"- `{row['claim']}`: {statement(row)} ({row['source']}) {printed}.{reason}")
        lines += [f"    - {remark}" for remark in row["remarks"]]
    return lines


def claims_markdown(frame: pd.DataFrame) -> str:
    """Tables of the judged claims, then every claim with its place and its reason."""
    judged = frame[frame["verdict"] != "not run"]
    grids = "\n".join(grid.to_markdown() for grid in claim_grids(judged))
    return "\n".join([*filter(None, [grids]), *claim_lines(frame), ""])


def claims_csv(frame: pd.DataFrame) -> str:
    """One line per claim with the columns of `claims_frame`; empty where there is no value."""
    rows: list[list[object]] = [list(frame.columns)]
    for values in frame.itertuples(index=False):
        cells = ["; ".join(each) if isinstance(each, tuple) else each for each in values]
        rows.append([plain(each) if isinstance(each, float) else each for each in cells])
    return csv_text([["" if each is None else each for each in row] for row in rows])
