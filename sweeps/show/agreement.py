"""How far runs rank like the printed values: a sentence, grids, and one picture a paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rgbt.tables import ABSENT, TextTable
from sweeps.judge.agreement import PRINT, ends_of, kinds_of, ours_of
from sweeps.show.figure import OURS, PUBLISHED

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALE = "#9CC7E3"
# Most letters of the name of a contrast in a picture.
LETTERS = 58
# Differences below this are drawn to a linear scale, others to a logarithmic one.
LINEAR = 1.0


def signs_in_words(signs: pd.DataFrame) -> list[str]:
    """Say of how many contrasts the sign is the printed one, a sentence for each kind of runs."""
    sentences = []
    for _, found in signs.iterrows():
        share = f"{100 * found['alike'] / found['contrasts']:.0f} %"
        if not math.isnan(found["low"]):
            share += f" [{100 * found['low']:.0f}, {100 * found['high']:.0f}]"
        decided = "no interval excludes 0"
        if found["decided"]:
            alike = f"{found['decided_alike']} of {found['decided']}"
            decided = f"of those whose interval excludes 0, {alike}"
        sentences.append(
            f"on {found['images']} at scale={found['scale']}, {found['alike']} of "
            f"{found['contrasts']} contrasts have the printed sign, {share}, where chance gives "
            f"50 %; {decided}"
        )
    return sentences


def agreement_lines(signs: pd.DataFrame, ranks: pd.DataFrame) -> list[str]:
    """Say how far results foretell the printed ones, two sentences for each kind of runs."""
    lines = []
    for (_, found), sentence in zip(signs.iterrows(), signs_in_words(signs), strict=True):
        line = f"{sentence[:1].upper()}{sentence[1:]}."
        is_own = (ranks["images"] == found["images"]) & (ranks["scale"] == found["scale"])
        own = ranks[is_own]
        if len(own):
            above, below = int((own["low"] > 0).sum()), int((own["high"] < 0).sum())
            line += (
                f" Spearman's correlation of the rows with print has the median "
                f"{own['rho'].median():+.2f} over {len(own)} scores of tables; {above} are shown "
                f"to be above 0, {below} below."
            )
        lines.append(line)
    return lines


def ranks_grid(ranks: pd.DataFrame) -> TextTable:
    """Show the rank correlation of each table and column."""
    rows = []
    for _, row in ranks.iterrows():
        ends = ABSENT
        if not math.isnan(row["low"]):
            ends = f"[{row['low']:+.2f}, {row['high']:+.2f}]"
        where = f"{row['images']}, scale={row['scale']}"
        rows.append(
            (row["table"], row["column"], where, str(row["rows"]), f"{row['rho']:+.2f}", ends)
        )
    header = ("table", "score", "on", "rows", "Spearman", "95 % interval")
    return TextTable("", header, tuple(rows))


def signs_grid(contrasts: pd.DataFrame) -> TextTable:
    """Count the contrasts of each table whose sign is the printed one."""
    ours = ours_of(contrasts)
    frame = contrasts.assign(alike=ours * contrasts["printed"] > 0, ours=ours)
    frame = frame.dropna(subset=["ours", "printed"])
    frame = frame[frame["printed"] != 0]
    rows = []
    for (table, images, scale), own in frame.groupby(["table", "images", "scale"], sort=True):
        confirmed = str(own["confirmed"].notna().sum())
        alike = f"{own['alike'].sum()} of {len(own)}"
        rows.append((str(table), f"{images}, scale={scale}", alike, confirmed))
    header = ("table", "on", "sign as printed", "by declared seeds")
    return TextTable("", header, tuple(rows))


def pairs_grid(pairs: pd.DataFrame) -> TextTable:
    """Show how far print and each kind of runs agree (`sweeps.judge.agreement.pairs_of`)."""
    rows = []
    for _, row in pairs.iterrows():
        share, rho = f"{100 * row['alike'] / row['contrasts']:.0f} %", f"{row['rho']:+.2f}"
        if not math.isnan(row["low"]):
            share += f" [{100 * row['low']:.0f}, {100 * row['high']:.0f}]"
            rho += f" [{row['rho_low']:+.2f}, {row['rho_high']:+.2f}]"
        counted = f"{row['alike']} of {row['contrasts']}"
        compared = f"{row['first']} and {row['second']}"
        rows.append((compared, counted, str(row["tables"]), share, rho))
    header = ("compared", "same sign", "tables", "share [95 %]", "Spearman [95 %]")
    return TextTable("", header, tuple(rows))


def sides_grid(contrasts: pd.DataFrame, beside: str) -> TextTable:
    """Show each contrast in print and in every kind of runs, if runs on `beside` have it.

    `beside` is the beginning of a kind (`sweeps.judge.agreement.kinds_of`). A star says that the
    interval excludes 0, "declared" that the seeds were declared.
    """
    frame, kinds = _sides(contrasts, beside)
    rows = []
    for (table, _, contrast), own in frame.groupby(["table", "claim", "contrast"], sort=False):
        by_kind = {row["kind"]: _side(row) for _, row in own.iterrows()}
        value = own["printed"].iloc[0]
        printed = ABSENT if math.isnan(value) else f"{value:+.2f}"
        cells = [by_kind.get(kind, ABSENT) for kind in kinds]
        rows.append((f"{table}: {contrast}", printed, *cells))
    return TextTable("", ("contrast", PRINT, *kinds), tuple(rows))


def sides_figure(contrasts: pd.DataFrame, beside: str) -> Figure | None:
    """Draw the contrasts of `sides_grid`: print hollow, runs on `beside` full, others pale."""
    from analysis.figures.plots import new_figure

    frame, kinds = _sides(contrasts, beside)
    if frame.empty:
        return None
    place = frame.groupby(["table", "claim", "contrast"], sort=False).ngroup()
    frame = frame.assign(place=place)
    labelled = frame.drop_duplicates("place")  # in their order
    figure = new_figure(8.6, 1.6 + 0.24 * len(labelled))
    axes = figure.subplots()
    axes.axvline(0, color="grey", lw=0.8, zorder=1)
    for kind in kinds:
        own = frame[frame["kind"] == kind]
        is_beside = kind.startswith(beside)
        colour, shift = (OURS, -0.14) if is_beside else (PALE, 0.14)
        _bars(axes, own, own["place"] + shift, colour, kind)
    _printed(axes, labelled["printed"], labelled["place"])
    _finish(figure, axes, [_name_of(row) for _, row in labelled.iterrows()])
    return figure


def _sides(contrasts: pd.DataFrame, beside: str) -> tuple[pd.DataFrame, list[str]]:
    """The contrasts that runs on `beside` have, with ours, low, high and kind; and the kinds."""
    low, high = ends_of(contrasts)
    frame = contrasts.assign(
        ours=ours_of(contrasts), kind=kinds_of(contrasts), low=low, high=high
    ).dropna(subset=["ours"])
    is_beside = frame["kind"].str.startswith(beside)
    place = [frame["table"], frame["claim"], frame["contrast"]]
    frame = frame[is_beside.groupby(place).transform("any")]
    kinds = sorted(frame["kind"].unique(), key=lambda kind: (kind.startswith(beside), kind))
    return frame, kinds


def _side(row: pd.Series) -> str:
    if math.isnan(row["low"]):
        return f"{row['ours']:+.2f}"
    star = "*" if row["low"] > 0 or row["high"] < 0 else ""
    declared = "" if math.isnan(row["confirmed"]) else ", declared"
    return f"{row['ours']:+.2f}{star} [{row['low']:+.2f}, {row['high']:+.2f}]{declared}"


def forest_of(contrasts: pd.DataFrame, title: str) -> Figure | None:
    """Draw the contrast that decides each claim: print hollow, explored pale, confirmed full.

    Those that disagree most with print are on top. `contrasts` is that of
    `sweeps.judge.agreement.contrasts_frame`; None where nothing is to be drawn.
    """
    import pandas as pd

    from analysis.figures.plots import new_figure

    ours = ours_of(contrasts)
    frame = contrasts.assign(ours=ours)[contrasts["decides"]].dropna(subset=["ours", "printed"])
    if frame.empty:
        return None
    # Of a printed gain and a loss of ours the gap is relative to the printed size.
    gap = (frame["ours"] - frame["printed"]) / frame["printed"].abs().clip(lower=0.1)
    frame = frame.assign(gap=gap * frame["printed"].map(lambda value: 1 if value >= 0 else -1))
    frame = frame.sort_values("gap", kind="stable")
    figure = new_figure(8.6, 1.6 + 0.21 * len(frame))
    axes = figure.subplots()
    axes.axvline(0, color="grey", lw=0.8, zorder=1)
    places = pd.Series(range(len(frame)), frame.index, dtype=float)
    for kind, colour, label, shift in (
        ("explored", PALE, "ours, explored", 0.14),
        ("confirmed", OURS, "ours, confirmed by declared seeds", -0.14),
    ):
        ends = frame[[kind, f"{kind}_low", f"{kind}_high"]].set_axis(
            ["ours", "low", "high"], axis=1
        )
        _bars(axes, ends, places + shift, colour, label)
    _printed(axes, frame["printed"], places)
    kinds = sorted(set(kinds_of(frame)))
    figure.suptitle(f"{title}: printed differences and ours ({'; '.join(kinds)})", fontsize=10)
    _finish(figure, axes, [_name_of(row) for _, row in frame.iterrows()])
    return figure


def _bars(axes: Axes, ends: pd.DataFrame, places: pd.Series, colour: str, label: str) -> None:
    """Draw differences (`ends`: ours, low, high) with their intervals at the heights `places`."""
    ours, low, high = (ends[name] for name in ("ours", "low", "high"))
    lengths = [(ours - low).fillna(0.0), (high - ours).fillna(0.0)]
    axes.errorbar(
        ours, places, xerr=lengths, fmt="o", ms=3.5, lw=1.2, color=colour, zorder=3, label=label
    )


def _printed(axes: Axes, values: pd.Series, places: pd.Series) -> None:
    axes.scatter(
        values, places, s=26, facecolors="none", edgecolors=PUBLISHED, zorder=4, label="printed"
    )


def _finish(figure: Figure, axes: Axes, names: Sequence[str]) -> None:
    """Label a chart of differences."""
    axes.set_xscale("symlog", linthresh=LINEAR)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set_xlabel("difference in percent points (Var: squared); linear between -1 and 1")
    axes.grid(axis="x", alpha=0.25)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)


def _name_of(row: pd.Series) -> str:
    is_mean = row["contrast"].startswith("mean of")
    what = row["claim"].replace("_", " ") if is_mean else row["contrast"]
    text = f"{row['table'].rpartition('/')[2]}: {what}"
    return text if len(text) <= LETTERS else f"{text[: LETTERS - 1]}…"
