"""A computed table as a grid with footnotes for the terminal and Markdown; LaTeX and CSV."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Literal

from rgbt.tables import ABSENT, TextTable, csv_text
from sweeps.plan.table import Column, Form, Row, Table, is_counted, metric_of
from sweeps.score.cells import NO_VALUE, ScoredTable, TableCell, is_of_runs, published
from sweeps.score.efficiency import SCALE

DOUBTFUL = "The printed value does not agree with the others of its row."
NOT_PRINTED = "Not in the paper."
# Remark at every scale but "paper".
SMALL = (
    "scale={scale}: data and network are small; compare the verdicts of the claims with the paper, "
    "not the values."
)

# Remarks on tables that say nothing about their forms.
FORMS: dict[Form, str] = {
    "paper": "Form: every row is run as the text of the paper describes it.",
    "released": "Form: no row of this table has a released form that differs from the text.",
}
COUNTED = f"Parameters are those of the networks at scale={SCALE}, without discriminators."
CSV_HEADER = ["table", "row", "column", "mean", "sd", "n", "published", "difference", "reason"]
CSV_HEADER += ["runs"]

Style = Literal["terminal", "markdown"]
# How all other values, the best and the second best of a column are shown, and what says so.
MARKS: dict[Style, tuple[str, str, str]] = {
    "terminal": ("{}", "*{}", "_{}"),
    "markdown": ("{}", "**{}**", "*{}*"),
}
LEGENDS: dict[Style, str] = {
    "terminal": "*: shown to be the best of our rows, _: the second best.",
    "markdown": "Bold: shown to be the best of our rows, italic: the second best.",
}


def render_table(
    scored: ScoredTable, style: Style, extra: Sequence[str] = (), remarks: Sequence[str] = ()
) -> TextTable:
    """Return the grid of a table; `extra` are overrides of every row, `remarks` end its notes."""
    table = scored.table
    footnotes: list[str] = []  # in the order of their first use
    title = f"{table.paper}, {table.number}: {table.caption}"
    title = _noted(title, table.remarks_at(scored.scale), footnotes)
    header = ["", "", "seeds"]
    for column in table.columns:
        header.append(_noted(column.name, () if column.printed else (NOT_PRINTED,), footnotes))
    rows: list[tuple[str, ...]] = []
    for row in table.rows:
        rows += _lines(scored, row, style, footnotes)
    notes = [f"[{number}] {footnote}" for number, footnote in enumerate(footnotes, start=1)]
    notes += _remarks(scored, extra)
    notes += remarks
    if scored.marks:
        notes.append(LEGENDS[style])
    return TextTable(title, tuple(header), tuple(rows), tuple(notes))


def latex(grid: TextTable) -> str:
    """Return the grid in LaTeX (booktabs), without lines of differences, which no paper has."""
    import pandas as pd

    rows = [row for row in grid.rows if row[1] != "difference"]
    frame = pd.DataFrame(rows, columns=list(grid.header))
    caption = re.sub(r"[&%$#_{}]", r"\\\g<0>", grid.title.replace("\\", "/"))
    sides = "l" + "r" * (len(grid.header) - 1)
    return str(frame.to_latex(index=False, escape=True, caption=caption, column_format=sides))


def tidy_csv(scored: ScoredTable) -> str:
    """Return one line per row and column (`CSV_HEADER`), with all digits; empty: no value.

    Values are in the unit of the table; `n` is the number of seeds, `runs` are keys of runs.
    """
    rows: list[list[object]] = [[*CSV_HEADER]]
    nothing = TableCell(math.nan, math.nan, 0)
    for row in scored.table.rows:
        for column in scored.table.columns:
            cell = scored.cells.get((row.label, column.name), nothing)
            printed = published(row, column)
            line = [
                scored.name,
                row.label,
                column.name,
                plain(cell.mean),
                plain(cell.sd),
                cell.seeds,
            ]
            line += ["" if printed is None else printed, plain(scored.difference(row, column))]
            line += [cell.reason, " ".join(cell.keys)]
            rows.append(line)
    return csv_text(rows)


def plain(value: float) -> str:
    """Return a number for CSV; "" for NaN."""
    return "" if math.isnan(value) else repr(round(value, 6))


def _remarks(scored: ScoredTable, extra: Sequence[str]) -> list[str]:
    """Sentences below the table."""
    table, seeds = scored.table, scored.seeds
    printed = any(row.values for row in table.rows)
    remarks = []
    if printed:
        remarks.append(f"Published: {table.data}; {table.unit}.")
    if printed or scored.lists:
        remarks += _lists_of_paper(table) + _lists_of_runs(scored)
    if seeds:
        over = "mean ± standard deviation (n - 1) over seeds" if len(seeds) > 1 else "of seed"
        remarks.append(f"Ours: scale={scored.scale}, {over} {', '.join(map(str, seeds))}.")
    if scored.cells and printed:
        remarks.append(table.forms.get(scored.form, FORMS[scored.form]))
    sizes = {column.name for column in table.columns if column.efficiency is not None}
    if any(name in sizes for _, name in scored.cells):
        remarks.append(COUNTED)
    if seeds and scored.scale != "paper" and printed:
        remarks.append(SMALL.format(scale=scored.scale))
    if extra:
        remarks.append(f"Every row of ours was run with {' '.join(extra)}.")
    if len(scored.commits) > 1:
        named = Counter(scored.commits).most_common()
        commits = ", ".join(f"{commit} ({count})" for commit, count in named)
        remarks.append(f"Our runs come from several git commits: {commits}.")
    return remarks


def _lists_of_paper(table: Table) -> list[str]:
    """Which lists the published rows were trained and selected on."""
    remarks = []
    if table.lists:
        remarks.append(f"Lists of published rows: {table.lists}.")
    own = [f"{row.label}: {row.lists}" for row in table.rows if row.lists and row.values]
    if own:
        remarks.append(f"{'; '.join(own)}.")
    return remarks


def _lists_of_runs(scored: ScoredTable) -> list[str]:
    """Which lists our rows were trained and selected on, and whether they differ in them."""
    groups: dict[str, list[str]] = {}
    for label, text in scored.lists.items():
        groups.setdefault(text, []).append(label)
    if len(groups) < 2:
        return [f"Lists of our rows: {text}." for text in groups]
    shown = "; ".join(f"{text} ({', '.join(labels)})" for text, labels in groups.items())
    return [f"Our rows have different lists: {shown}."]


def _noted(text: str, notes: Sequence[str], footnotes: list[str]) -> str:
    """A text with the numbers of its notes, of which new ones are added to the footnotes."""
    for note in notes:
        if note not in footnotes:
            footnotes.append(note)
        text += f"[{footnotes.index(note) + 1}]"
    return text


def _lines(
    scored: ScoredTable, row: Row, style: Style, footnotes: list[str]
) -> list[tuple[str, ...]]:
    """The lines of one row: ours, published, difference, as far as there are any."""
    columns = scored.table.columns
    notes = _same_runs(scored, row)
    if not row.doubtful:
        notes += row.remarks
    label = _noted(row.label, notes, footnotes)
    lines = []
    if any((row.label, column.name) in scored.cells for column in columns):
        values = [_ours(scored, row, column, style, footnotes) for column in columns]
        lines.append(("ours", _seeds(scored, row), *values))
    if not lines or any(published(row, column) is not None for column in columns):
        decimals = _decimals(scored.table)
        values = [_published(row, column, decimals, footnotes) for column in columns]
        lines.append(("published", "", *values))
    differences = [scored.difference(row, column) for column in columns]
    if not all(math.isnan(value) for value in differences):
        values = [ABSENT if math.isnan(value) else f"{value:+.2f}" for value in differences]
        lines.append(("difference", "", *values))
    return [("" if place else label, *line) for place, line in enumerate(lines)]


def _ours(scored: ScoredTable, row: Row, column: Column, style: Style, footnotes: list[str]) -> str:
    cell = scored.cells.get((row.label, column.name))
    if cell is None:
        return ABSENT
    text = f"{cell.mean:.2f}"
    if math.isnan(cell.mean):
        text = ABSENT if cell.mark == NO_VALUE else cell.mark
    if not math.isnan(cell.sd):
        text += f" ± {cell.sd:.2f}"
    rank = scored.marks.get((row.label, column.name), 0)
    notes = [f"{cell.reason.removesuffix('.')}."] if cell.reason else []
    return _noted(MARKS[style][rank].format(text), notes, footnotes)


def _published(row: Row, column: Column, decimals: int, footnotes: list[str]) -> str:
    printed = published(row, column)
    if printed is None:
        return ABSENT
    doubts: Sequence[str] = ()
    if column.name in row.doubtful:
        doubts = row.remarks or (DOUBTFUL,)
    return _noted(f"{printed:.{decimals}f}", doubts, footnotes)


def _decimals(table: Table) -> int:
    """How many decimals the paper prints; 2 without printed values."""
    decimals = []
    for row in table.rows:
        for value in row.values.values():
            if value is not None:
                decimals.append(len(repr(value).partition(".")[2].rstrip("0")))
    return max(decimals, default=2)


def _same_runs(scored: ScoredTable, row: Row) -> list[str]:
    """A note on a row of the same runs as one before: at scale=demo networks of all sizes are one.

    Its columns must have the same metrics too.
    """
    keys, rows = _keys(scored, row), scored.table.rows
    counted = [column for column in scored.table.columns if is_counted(column)]
    metrics = [metric_of(column, row) for column in counted]
    for other in rows[: rows.index(row)]:
        is_same = metrics == [metric_of(column, other) for column in counted]
        if keys and keys == _keys(scored, other) and is_same:
            return [f"At scale={scored.scale} the same runs as row '{other.label}'."]
    return []


def _keys(scored: ScoredTable, row: Row) -> tuple[str, ...]:
    """The keys of the runs of a row."""
    for column in scored.table.columns:
        cell = scored.cells.get((row.label, column.name))
        if cell is not None and cell.keys:
            return cell.keys
    return ()


def _seeds(scored: ScoredTable, row: Row) -> str:
    """How many seeds the row's values are means of: "3", or "2-3"."""
    counts = set()
    for column in scored.table.columns:
        cell = scored.cells.get((row.label, column.name))
        if cell is not None and is_of_runs(column):
            counts.add(cell.seeds)
    if not counts:
        return ""
    counts = counts - {0} or counts
    low, high = min(counts), max(counts)
    return str(low) if low == high else f"{low}-{high}"
