"""A computed table as a grid with footnotes for the terminal and Markdown; LaTeX and CSV."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from rgbt.tables import ABSENT, TextTable, csv_text
from sweeps.plan.table import Column, Form, Row, is_counted, metric_of
from sweeps.score.cells import (
    NO_VALUE,
    ScoredTable,
    TableCell,
    is_of_runs,
    published,
)
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
CSV_HEADER = (
    "table",
    "row",
    "column",
    "mean",
    "sd",
    "n",
    "published",
    "difference",
    "reason",
    "runs",
)


class Style(NamedTuple):
    """How the best and the second best of a column are marked, and what says so."""

    marks: tuple[str, str, str]
    legend: str


TERMINAL = Style(("{}", "*{}", "_{}"), "*: shown to be the best of our rows, _: the second best.")
MARKDOWN = Style(
    ("{}", "**{}**", "*{}*"), "Bold: shown to be the best of our rows, italic: the second best."
)


def render_table(
    scored: ScoredTable, style: Style, extra: Sequence[str] = (), remarks: Sequence[str] = ()
) -> TextTable:
    """The grid of a table; `extra` are overrides of every row, `remarks` sentences below it."""
    table, builder = scored.table, _Lines(scored, style)
    title = builder.noted(f"{table.paper}, {table.number}: {table.caption}", *table.remarks)
    header = builder.header()
    rows = tuple(line for row in table.rows for line in builder.row(row))
    notes = [f"[{index}] {note}" for index, note in enumerate(builder.sentences, start=1)]
    legend = [style.legend] if scored.marks else []
    below = (*notes, *_remarks(scored, extra), *remarks, *legend)
    return TextTable(title, header, rows, below)


def latex(grid: TextTable) -> str:
    """The grid in LaTeX (booktabs), without lines of differences, which no paper has."""
    import pandas as pd

    rows = [row for row in grid.rows if row[1] != "difference"]
    frame = pd.DataFrame(rows, columns=list(grid.header))
    caption = re.sub(r"[&%$#_{}]", r"\\\g<0>", grid.title.replace("\\", "/"))
    sides = "l" + "r" * (len(grid.header) - 1)
    return str(frame.to_latex(index=False, escape=True, caption=caption, column_format=sides))


def _remarks(scored: ScoredTable, extra: Sequence[str]) -> list[str]:
    """Sentences below the table."""
    table, seeds = scored.table, scored.seeds
    printed = any(row.values for row in table.rows)
    remarks = [f"Published: {table.data}; {table.unit}."] if printed else []
    remarks += _lists(scored) if printed or scored.lists else []
    if seeds:
        listed, many = ", ".join(map(str, seeds)), len(seeds) > 1
        over = "mean ± standard deviation (n - 1) over seeds" if many else "of seed"
        remarks.append(f"Ours: scale={scored.scale}, {over} {listed}.")
    if scored.cells and printed:
        remarks.append(table.forms.get(scored.form, FORMS[scored.form]))
    sizes = {column.name for column in table.columns if column.efficiency is not None}
    remarks += [COUNTED] if sizes & {name for _, name in scored.cells} else []
    if seeds and scored.scale != "paper" and printed:
        remarks.append(SMALL.format(scale=scored.scale))
    if extra:
        remarks.append(f"Every row of ours was run with {' '.join(extra)}.")
    if len(scored.commits) > 1:
        named = Counter(scored.commits).most_common()
        commits = ", ".join(f"{commit} ({count})" for commit, count in named)
        remarks.append(f"Our runs come from several git commits: {commits}.")
    return remarks


def _lists(scored: ScoredTable) -> list[str]:
    """Which lists the rows were trained and selected on; whether rows of ours differ in them."""
    own = {row.label: row.lists for row in scored.table.rows if row.lists and row.values}
    printed = [f"Lists of published rows: {scored.table.lists}."] if scored.table.lists else []
    if own:
        printed.append(f"{'; '.join(f'{label}: {text}' for label, text in own.items())}.")
    groups: dict[str, list[str]] = {}
    for label, text in scored.lists.items():
        groups.setdefault(text, []).append(label)
    if len(groups) < 2:
        return [*printed, *(f"Lists of our rows: {text}." for text in groups)]
    shown = "; ".join(f"{text} ({', '.join(labels)})" for text, labels in groups.items())
    return [*printed, f"Our rows have different lists: {shown}."]


@dataclass
class _Lines:
    """Makes the lines of a table; `sentences` are its footnotes in the order of their first use."""

    scored: ScoredTable
    style: Style
    sentences: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        # Published values have as many decimals as the paper prints.
        printed = [value for row in self.scored.table.rows for value in row.values.values()]
        digits = [repr(value).partition(".")[2] for value in printed if value is not None]
        self.decimals = max((len(each.rstrip("0")) for each in digits), default=2)

    def noted(self, text: str, *sentences: str | None) -> str:
        """A text with the numbers of its footnotes; the same sentence keeps its number."""
        given = [sentence for sentence in sentences if sentence]
        self.sentences += [one for one in dict.fromkeys(given) if one not in self.sentences]
        return text + "".join(f"[{self.sentences.index(each) + 1}]" for each in given)

    def header(self) -> tuple[str, ...]:
        """The names of the columns, behind the label, the kind of line and the number of seeds."""
        columns = self.scored.table.columns
        own = (self.noted(each.name, "" if each.printed else NOT_PRINTED) for each in columns)
        return ("", "", "seeds", *own)

    def row(self, row: Row) -> list[tuple[str, ...]]:
        """The lines of one row: ours, published, difference, as far as there are any."""
        label = self.noted(row.label, self._same_runs(row), *(() if row.doubtful else row.remarks))
        columns, cells = self.scored.table.columns, self.scored.cells
        is_run = any((row.label, column.name) in cells for column in columns)
        is_printed = any(published(row, column) is not None for column in columns)
        both = any(not math.isnan(self.scored.difference(row, column)) for column in columns)
        kinds = (
            ("ours", self._ours, is_run),
            ("published", self._published, is_printed or not is_run),
            ("difference", self._difference, both),
        )
        lines: list[tuple[str, ...]] = []
        for kind, text, is_shown in kinds:
            if is_shown:
                seeds = self._seeds(row) if kind == "ours" else ""
                texts = (text(row, column) for column in columns)
                lines.append(("" if lines else label, kind, seeds, *texts))
        return lines

    def _same_runs(self, row: Row) -> str | None:
        """A note on an equal row: at scale=demo networks of all sizes are one."""
        keys, rows = self._keys(row), self.scored.table.rows
        counted = list(filter(is_counted, self.scored.table.columns))
        metrics = [metric_of(column, row) for column in counted]
        for other in rows[: rows.index(row)]:
            is_same = metrics == [metric_of(column, other) for column in counted]
            if keys and keys == self._keys(other) and is_same:
                return f"At scale={self.scored.scale} the same runs as row '{other.label}'."
        return None

    def _keys(self, row: Row) -> tuple[str, ...]:
        columns = self.scored.table.columns
        cells = (self.scored.cells.get((row.label, column.name)) for column in columns)
        return next((cell.keys for cell in cells if cell is not None and cell.keys), ())

    def _seeds(self, row: Row) -> str:
        """How many seeds the row's values are means of."""
        columns = filter(is_of_runs, self.scored.table.columns)
        cells = [self.scored.cells.get((row.label, column.name)) for column in columns]
        there = [cell.seeds for cell in cells if cell is not None]
        counts = sorted({seeds for seeds in there if seeds} or set(there))
        return "-".join(dict.fromkeys(map(str, counts[:1] + counts[-1:])))

    def _ours(self, row: Row, column: Column) -> str:
        cell_id = (row.label, column.name)
        cell = self.scored.cells.get(cell_id)
        if cell is None:
            return ABSENT
        text = f"{cell.mean:.2f}"
        if math.isnan(cell.mean):
            text = ABSENT if cell.mark == NO_VALUE else cell.mark
        text += "" if math.isnan(cell.sd) else f" ± {cell.sd:.2f}"
        marked = self.style.marks[self.scored.marks.get(cell_id, 0)].format(text)
        return self.noted(marked, cell.reason and f"{cell.reason.removesuffix('.')}.")

    def _published(self, row: Row, column: Column) -> str:
        printed = published(row, column)
        if printed is None:
            return ABSENT
        doubts = (row.remarks or (DOUBTFUL,)) if column.name in row.doubtful else ()
        return self.noted(f"{printed:.{self.decimals}f}", *doubts)

    def _difference(self, row: Row, column: Column) -> str:
        value = self.scored.difference(row, column)
        return ABSENT if math.isnan(value) else f"{value:+.2f}"


def tidy_csv(scored: ScoredTable) -> str:
    """One line per row and column (`CSV_HEADER`), with all digits; empty where there is no value.

    Values are in the unit of the table; `n` is the number of seeds, `runs` are keys of runs.
    """
    rows: list[tuple[object, ...]] = [CSV_HEADER]
    nothing = TableCell(math.nan, math.nan, 0)
    for row in scored.table.rows:
        for column in scored.table.columns:
            cell = scored.cells.get((row.label, column.name), nothing)
            printed, difference = published(row, column), scored.difference(row, column)
            ours = (plain(cell.mean), plain(cell.sd), cell.seeds)
            theirs = ("" if printed is None else printed, plain(difference), cell.reason)
            rows.append((scored.name, row.label, column.name, *ours, *theirs, " ".join(cell.keys)))
    return csv_text(rows)


def plain(value: float | None) -> str:
    """A number for CSV; "" for none."""
    return "" if value is None or math.isnan(value) else repr(round(value, 6))
