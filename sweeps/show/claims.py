"""Judged claims as one frame; terminal, Markdown, CSV and counts are views of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rgbt.tables import ABSENT, TextTable, csv_text
from sweeps.judge.judged_table import JudgedClaim
from sweeps.show.table import plain

if TYPE_CHECKING:
    import pandas as pd

WORDS = ("holds", "contradicted", "undecided", "not run")
NOTES = (
    "ours: mean over paired seeds, and its 95 % interval over images and seeds, of one seed over "
    "images alone. would decide: what is needed for a difference as large as ours.",
    "A verdict is about the direction and the bounds of a claim, not about a size in its words. "
    "Each interval holds the truth in 95 % of cases by itself; of many claims without an effect, "
    "2.5 % are called holding. With seeds far from normal (lognormal, sd 1 of the logarithm) 14 to "
    "18 % of verdicts about no difference are wrong.",
)
# Word in the column of seeds for a difference of two evaluations without seeds.
IMAGES = "images alone"

ALWAYS = (
    "table",
    "paper",
    "claim",
    "source",
    "says",
    "remarks",
    "verdict",
    "contrast",
    "printed",
    "as_printed",
    "margin",
    "missing",
    "reason",
    "how",
)
NUMBERS = ("estimate", "low", "high", "smallest", "seeds_needed")
# Claims that differ in one of these are never in one grid.
BASIS = ["images", "scale", "start", "how"]

# Values of a claim without a verdict.
WITHOUT: dict[str, Any] = dict.fromkeys(NUMBERS, math.nan)
WITHOUT |= {"seeds": 0, "starts": 0}
WITHOUT |= dict.fromkeys(("covers", "warning", "images", "scale", "start"), "")


def claims_frame(judged: Sequence[JudgedClaim], how: str = "") -> pd.DataFrame:
    """One claim a row; `how` names the form and overrides of all rows.

    Returns:
        the columns `ALWAYS` and those of `WITHOUT`. as_printed is True, False or None (not
        printed), margin that of "does as well as" (NaN of others), start and starts say from how
        many initial weights the seeds began, warning also says whether lists or machines of the
        rows differ, and covers, smallest and seeds_needed are those of
        `analysis.uncertainty.verdicts.Verdict`.
    """
    import pandas as pd

    rows = []
    for each in judged:
        claim, found, basis = each.claim, each.verdict, each.basis
        is_similar = claim.expected == "similar" and claim.at_most is not None
        row: dict[str, Any] = {
            "table": each.table,
            "paper": each.table.rpartition("/")[0] or "studies",
            "claim": claim.name,
            "source": claim.source,
            "says": claim.says,
            "remarks": claim.remarks,
            "verdict": each.word,
            "contrast": each.contrast,
            "printed": math.nan if each.printed is None else each.printed,
            "as_printed": each.as_printed,
            "margin": claim.at_most if is_similar else math.nan,
            "missing": " | ".join(each.missing),
            "reason": each.reason,
            "how": how,
            **WITHOUT,
        }
        if found is not None:
            row |= {key: getattr(found, key) for key in WITHOUT if hasattr(found, key)}
            around = found.interval
            row |= {} if around is None else {"low": around.low, "high": around.high}
        if found is not None and basis is not None:
            one_start = basis.starts == 1 and found.seeds > 1
            row |= {"images": basis.images, "scale": basis.scale}
            row["start"] = "one start for all seeds" if one_start else "a start for each seed"
            row["warning"] = " ".join(filter(None, (row["warning"], *basis.warnings)))
        row["starts"] = 0 if basis is None else min(row["seeds"], basis.starts)
        rows.append(row)
    return pd.DataFrame(rows, columns=[*ALWAYS, *WITHOUT]).astype({"as_printed": object})


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
    rows = []
    for paper, each in frame.groupby("paper", sort=True):
        verdicts = [int((each["verdict"] == word).sum()) for word in WORDS]
        printed = [sum(value is word for value in each["as_printed"]) for word in (True, False)]
        agree = f"{printed[0]} of {sum(printed)}"
        rows.append((str(paper), *map(str, verdicts), agree))
    return TextTable("", ("paper", *WORDS, "agree as printed"), tuple(rows))


def basis_of(images: str, scale: str, start: str, how: str) -> str:
    """What verdicts rest on: "synthetic images, scale=bench, a start for each seed"."""
    return ", ".join(filter(None, (f"{images} images", f"scale={scale}", start, how)))


def claim_grids(frame: pd.DataFrame, *, noted: bool = False) -> list[TextTable]:
    """Claims, one grid for each kind of images, scale and start.

    Those that are decided come first. `noted`: with what the columns and a verdict mean.
    """
    order = frame["verdict"].map({word: place for place, word in enumerate(WORDS)})
    frame = frame.loc[order.sort_values(kind="stable").index]
    grids = []
    for key, each in frame.groupby(BASIS, sort=False):
        title = f"{counted(each)} {basis_of(*key).capitalize()}." if key[1] else counted(each)
        rows = []
        for _, row in each.iterrows():
            table = row["table"].rpartition("/")[2]
            claim = f"{row['says']} ({table}: {row['contrast']})"
            ours = f"{_signed(row['estimate'])} {interval_of(row)}".removesuffix(f" {ABSENT}")
            last = (_signed(row["printed"]), seeds_of(row), _would_decide(row))
            rows.append((row["verdict"], claim, ours, *last))
        header = ("verdict", "claim", "ours", "printed", "seeds", "would decide")
        warnings = tuple(filter(None, each["warning"].unique()))
        grids.append(
            TextTable(title, header, tuple(rows), (*warnings, *NOTES * (noted and bool(key[1]))))
        )
    return grids


def interval_of(row: pd.Series) -> str:
    """The interval as text."""
    return ABSENT if math.isnan(row["low"]) else f"[{_signed(row['low'])}, {_signed(row['high'])}]"


def seeds_of(row: pd.Series) -> str:
    """The number of paired seeds, or that there are none."""
    return IMAGES if row["covers"] == "images" and not row["seeds"] else str(row["seeds"])


def _would_decide(row: pd.Series) -> str:
    """What an undecided claim needs."""
    needed = float(row["seeds_needed"])
    if row["verdict"] != "undecided":
        return ABSENT
    if row["missing"]:
        return "more rows"
    if math.isnan(needed):
        return "a second seed" if row["seeds"] == 1 else "more images"
    return "more images" if math.isinf(needed) else f"{needed:.0f} seeds"


def _signed(value: float) -> str:
    return ABSENT if math.isnan(value) else f"{value:+.2f}"


def statement(row: pd.Series) -> str:
    """A claim with its verdict, its numbers and what these rest on, as Markdown."""
    if row["verdict"] == "not run":
        return f"{row['says']} **Not run.**"
    limit = "" if math.isnan(row["margin"]) else f" Alike means within {row['margin']:g}."
    seeds = seeds_of(row)
    seeds = seeds if seeds == IMAGES else f"{seeds} seeds"
    basis = f" ({basis_of(*row[BASIS])}, {seeds})" if row["scale"] else ""
    warning = f" {row['warning']}" if row["warning"] else ""
    return (
        f"{row['says']} **{row['verdict'].capitalize()}**: {row['contrast']} "
        f"{_signed(row['estimate'])} {interval_of(row)}{basis}.{limit}{warning}"
    )


def claim_lines(frame: pd.DataFrame) -> list[str]:
    """Every claim as an item of a Markdown list; with a verdict also printed values and reason."""
    lines = []
    for _, row in frame.iterrows():
        line = f"- `{row['claim']}`: {statement(row)} ({row['source']})"
        remarks = row["remarks"] if row["verdict"] != "not run" else ()
        if row["verdict"] != "not run":
            words = {True: "agree", False: "do not agree", None: "do not tell"}
            printed = "" if math.isnan(row["printed"]) else f" ({row['printed']:+.2f})"
            reason = f" {row['reason'][:1].upper()}{row['reason'][1:]}" if row["reason"] else ""
            line += f" The printed values {words[row['as_printed']]}{printed}.{reason}"
        lines += [line, *(f"    - {remark}" for remark in remarks)]
    return lines


def claims_markdown(frame: pd.DataFrame) -> str:
    """Tables of the judged claims, then every claim with its place and its reason."""
    grids = "\n".join(grid.to_markdown() for grid in claim_grids(frame))
    return "\n".join([*filter(None, [grids]), *claim_lines(frame), ""])


def frame_csv(frame: pd.DataFrame) -> str:
    """A frame as CSV; empty where there is no value."""
    rows: list[list[object]] = [list(frame.columns)]
    for values in frame.itertuples(index=False):
        cells = ["; ".join(each) if isinstance(each, tuple) else each for each in values]
        cells = [plain(each) if isinstance(each, float) else each for each in cells]
        rows.append(["" if each is None else each for each in cells])
    return csv_text(rows)
