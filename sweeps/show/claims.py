"""Judged claims as one frame; terminal, Markdown, CSV and counts are views of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from analysis.uncertainty.verdicts import Verdict
from rgbt.tables import ABSENT, TextTable, csv_text
from sweeps.judge.judged_claim import JUDGED_ONCE, NOT_COMPARABLE, NOT_RUN, WORDS, JudgedClaim
from sweeps.show.table import plain

if TYPE_CHECKING:
    import pandas as pd

NOTES = (
    "same direction, opposite direction: the whole 95 % interval is on one side of 0. holds, "
    "contradicted: so on the paper's images with its recipe. confirmation: by the seeds that "
    "the table declared before they were run. exploration: by all others, whose number may depend "
    "on results, so that the interval is valid for any number of them, and wider.",
    "ours: mean over paired seeds, and its interval over images and seeds, of one seed over images "
    "alone. size: our interval beside the printed difference. would decide: what is needed for a "
    "difference as large as ours.",
)
AS_CLAIMED, OTHERWISE = ("holds", "same direction"), ("contradicted", "opposite direction")
# Words before the printed difference.
SIZES = {
    "includes it": "which includes the",
    "larger": "larger than the",
    "smaller": "smaller than the",
    "other sign": "of another sign than the",
}
OPEN = ("undecided", "not shown")
# Word in the column of seeds for a difference of two evaluations without seeds.
IMAGES = "images alone"

COLUMNS = ["table", "paper", "claim", "source", "says", "remarks", "verdict", "basis", "contrast"]
COLUMNS += ["printed", "as_printed", "size", "margin", "missing", "reason", "how", "estimate"]
COLUMNS += ["low", "high", "smallest", "seeds_needed", "seeds", "starts", "covers", "warning"]
COLUMNS += ["images", "scale", "start", "same_as", "explored", "explored_low", "explored_high"]
COLUMNS += ["explored_seeds"]
# Claims that differ in one of these are never in one grid.
BASIS = ["images", "scale", "start", "how"]

# Numbers of a claim without a verdict.
NO_VERDICT = Verdict(
    kind="undecided",
    estimate=math.nan,
    interval=None,
    covers="none",
    smallest=math.nan,
    seeds=0,
    seeds_needed=math.nan,
    decisive=0,
)


def claims_frame(judged: Sequence[JudgedClaim], how: str = "") -> pd.DataFrame:
    """Return one claim a row; `how` names the form and overrides of all rows.

    Returns:
        the columns `COLUMNS`. verdict, basis and size are those of `JudgedClaim`, as_printed is
        True, False or None (not printed), margin that of "does as well as" (NaN of others), start
        and starts say from how many initial weights the seeds began, warning also says whether
        lists or machines of the rows differ, and estimate to seeds_needed, seeds and covers are
        those of `analysis.uncertainty.verdicts.Verdict`; NaN, 0 and "" without a verdict. explored
        to explored_seeds: what was explored, beside a confirmation too.
    """
    import pandas as pd

    rows = [{**_columns_of(claim), "how": how} for claim in judged]
    return pd.DataFrame(rows, columns=COLUMNS).astype({"as_printed": object})


def _columns_of(judged: JudgedClaim) -> dict[str, Any]:
    claim, verdict = judged.claim, judged.verdict or NO_VERDICT
    explored = judged.exploration or NO_VERDICT
    is_similar = claim.expected == "similar" and claim.at_most is not None
    start = ""
    if judged.scale:
        is_one = verdict.starts == 1 and verdict.seeds > 1
        start = "one start for all seeds" if is_one else "a start for each seed"
    warnings = [verdict.warning, *judged.warnings] if verdict.warning else judged.warnings
    return {
        "table": judged.table,
        "paper": judged.table.rpartition("/")[0] or "studies",
        "claim": claim.name,
        "source": claim.source,
        "says": claim.says,
        "remarks": claim.remarks,
        "verdict": judged.word,
        "basis": judged.basis or "",
        "contrast": judged.label,
        "printed": math.nan if judged.printed is None else judged.printed,
        "as_printed": judged.as_printed,
        "size": judged.size,
        "margin": claim.at_most if is_similar else math.nan,
        "missing": " | ".join(judged.missing),
        "reason": judged.reason,
        "estimate": verdict.estimate,
        "low": _ends(verdict)[0],
        "high": _ends(verdict)[1],
        "smallest": verdict.smallest,
        "seeds_needed": verdict.seeds_needed,
        "seeds": verdict.seeds,
        "starts": min(verdict.seeds, verdict.starts or 0),
        "covers": "" if judged.verdict is None else verdict.covers,
        "warning": " ".join(warnings),
        "images": judged.images,
        "scale": judged.scale,
        "start": start,
        "same_as": judged.same_as,
        "explored": explored.estimate,
        "explored_low": _ends(explored)[0],
        "explored_high": _ends(explored)[1],
        "explored_seeds": explored.seeds,
    }


def _ends(verdict: Verdict) -> tuple[float, float]:
    found = verdict.interval
    return (math.nan, math.nan) if found is None else (found.low, found.high)


def counted(frame: pd.DataFrame) -> str:
    """Say how many claims there are by verdict, in a sentence."""
    counts = frame["verdict"].value_counts()
    parts = []
    for word in WORDS:
        if word in counts:
            shown = "hold" if word == "holds" and counts[word] > 1 else word
            parts.append(f"{counts[word]} {shown}")
    if not parts:
        return "The table has no claims."
    noun = "claim" if len(frame) == 1 else "claims"
    confirmed = int((frame["basis"] == "confirmation").sum())
    return f"{len(frame)} {noun}: {', '.join(parts)}; {confirmed} by declared seeds."


def counts_grid(frame: pd.DataFrame) -> TextTable:
    """Count the claims of every paper by verdict, and those with which its printed values agree."""
    used = [word for word in WORDS if (frame["verdict"] == word).any()]
    rows = []
    for paper, claims in frame.groupby("paper", sort=True):
        verdicts = [str((claims["verdict"] == word).sum()) for word in used]
        confirmed = str((claims["basis"] == "confirmation").sum())
        agreeing = sum(value is True for value in claims["as_printed"])
        printed = sum(value is not None for value in claims["as_printed"])
        rows.append((str(paper), *verdicts, confirmed, f"{agreeing} of {printed}"))
    header = ("paper", *used, "by declared seeds", "agree as printed")
    return TextTable("", header, tuple(rows))


def chance_of(frame: pd.DataFrame) -> str:
    """Say how many of these verdicts chance alone would make, in both directions."""
    is_judged = frame["basis"].isin(("confirmation", "exploration"))
    is_left_out = frame["verdict"].isin((NOT_COMPARABLE, JUDGED_ONCE))
    judged = int((is_judged & ~is_left_out).sum())
    if not judged:
        return ""
    words = frame.loc[is_judged, "verdict"]
    same, opposite = (int(words.isin(pair).sum()) for pair in (AS_CLAIMED, OTHERWISE))
    return (
        f"Of {judged} claims judged at 5 %, chance alone would show up to {0.025 * judged:.1f} in "
        f"the claimed direction and as many in the opposite one; {same} and {opposite} are shown."
    )


def basis_of(images: str, scale: str, start: str, how: str) -> str:
    """Say what verdicts rest on: "synthetic scenes, scale=bench, a start for each seed"."""
    return ", ".join(part for part in (images, f"scale={scale}", start, how) if part)


def claim_grids(frame: pd.DataFrame, *, noted: bool = False) -> list[TextTable]:
    """Return the claims, one grid for each kind of images, scale and start.

    Those that are decided come first. `noted`: with what the columns and a verdict mean.
    """
    order = frame["verdict"].map(WORDS.index).sort_values(kind="stable").index
    header = ("verdict", "claim", "ours", "printed", "size", "seeds", "would decide")
    grids = []
    for basis, claims in frame.loc[order].groupby(BASIS, sort=False):
        is_run = bool(basis[1])
        title = counted(claims)
        if is_run:
            title += f" On {basis_of(*basis)}."
        rows = [_grid_row(row) for _, row in claims.iterrows()]
        notes = [warning for warning in claims["warning"].unique() if warning]
        if noted and is_run:
            notes += NOTES
        grids.append(TextTable(title, header, tuple(rows), tuple(notes)))
    return grids


def _grid_row(row: pd.Series) -> tuple[str, ...]:
    table = row["table"].rpartition("/")[2]
    ours = _signed(row["estimate"])
    if not math.isnan(row["low"]):
        ours += f" {_interval(row)}"
    return (
        row["verdict"],
        f"{row['says']} ({table}: {row['contrast']})",
        ours,
        _signed(row["printed"]),
        row["size"] or ABSENT,
        _seeds(row),
        _would_decide(row),
    )


def _interval(row: pd.Series) -> str:
    """The interval as text."""
    return ABSENT if math.isnan(row["low"]) else f"[{_signed(row['low'])}, {_signed(row['high'])}]"


def _seeds(row: pd.Series) -> str:
    """The number of paired seeds and what they are for, or that there are none."""
    if row["basis"] == "evaluation":
        return IMAGES
    return f"{row['seeds']} ({row['basis']})" if row["seeds"] else str(row["seeds"])


def _would_decide(row: pd.Series) -> str:
    """What a claim needs whose direction is open."""
    needed = float(row["seeds_needed"])
    if row["verdict"] not in OPEN:
        return ABSENT
    if row["missing"]:
        return "more rows"
    if math.isnan(needed):
        return "a second seed" if row["seeds"] == 1 else "more images"
    return "more images" if math.isinf(needed) else f"{needed:.0f} seeds"


def _signed(value: float) -> str:
    return ABSENT if math.isnan(value) else f"{value:+.2f}"


def statement(row: pd.Series) -> str:
    """Return a claim with its direction and size, and what these rest on, as a line of Markdown."""
    word = row["verdict"]
    if word == NOT_RUN:
        return f"{row['says']} **Not run.**"
    if word == NOT_COMPARABLE:
        where = f"these are of {row['images']}"
        return f"{row['says']} **Not comparable**: it is about a level of scores, and {where}."
    if word == JUDGED_ONCE:
        return (
            f"{row['says']} **Judged once**: the runs and scores are those of `{row['same_as']}`."
        )
    where = f" on {row['images']}" if row["images"] else ""
    text = f"{row['says']} **{word.capitalize()}**{where}: "
    text += f"{_signed(row['estimate'])} {_interval(row)}"
    if row["size"]:
        text += f", {SIZES[row['size']]} printed {_signed(row['printed'])}"
    return f"{text}; {_rests_on(row)}."


def _rests_on(row: pd.Series) -> str:
    """What a verdict rests on, in words."""
    seeds = "1 seed" if row["seeds"] == 1 else f"{row['seeds']} seeds"
    if row["basis"] == "confirmation":
        return f"confirmation by {row['seeds']} declared seeds"
    if row["basis"] == "exploration":
        return f"exploration with {seeds}, not confirmed"
    return "counted" if row["basis"] == "counted" else f"of {IMAGES}"


def claim_lines(frame: pd.DataFrame) -> list[str]:
    """Return every claim as an item of a Markdown list, with printed values and its reason."""
    words = {True: "agree", False: "do not agree", None: "do not tell"}
    lines = []
    for _, row in frame.iterrows():
        line = f"- `{row['claim']}`: {statement(row)} ({row['source']})"
        if row["verdict"] == NOT_RUN:
            lines.append(line)
            continue
        line += f" The printed values {words[row['as_printed']]}. {row['contrast']}"
        line += f"; {basis_of(*row[BASIS])}." if row["scale"] else "."
        if not math.isnan(row["margin"]):
            line += f" Alike means within {row['margin']:g}."
        if row["warning"]:
            line += f" {row['warning']}"
        if row["basis"] == "confirmation" and not math.isnan(row["explored_low"]):
            explored = f"{_signed(row['explored'])} {_explored(row)}"
            line += f" Explored before: {explored}, {row['explored_seeds']} seeds."
        if row["reason"]:
            line += f" {row['reason'][:1].upper()}{row['reason'][1:]}"
        lines.append(line)
        lines += [f"    - {remark}" for remark in row["remarks"]]
    return lines


def _explored(row: pd.Series) -> str:
    return f"[{_signed(row['explored_low'])}, {_signed(row['explored_high'])}]"


def claims_markdown(frame: pd.DataFrame) -> str:
    """Return tables of the judged claims, then every claim with its place and its reason."""
    grids = "\n".join(grid.to_markdown() for grid in claim_grids(frame))
    lines = [*claim_lines(frame), ""]
    return "\n".join([grids, *lines] if grids else lines)


def frame_csv(frame: pd.DataFrame) -> str:
    """Return a frame as CSV; empty where there is no value."""
    rows: list[list[object]] = [list(frame.columns)]
    for values in frame.itertuples(index=False):
        row: list[object] = []
        for value in values:
            if isinstance(value, tuple):
                row.append("; ".join(value))
            elif isinstance(value, float):
                row.append(plain(value))
            else:
                row.append("" if value is None else value)
        rows.append(row)
    return csv_text(rows)
