"""A computed table as lines of text with footnotes, the source of all file formats."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from rgbt.tables import number
from sweeps.table.cells import NO_VALUE, ScoredTable, is_counted, is_of_runs, metric_of, published
from sweeps.table.efficiency import SCALE
from sweeps.table.table import MEASURED, Column, Form, Row

MAX_ON_ONE_LINE = 3
"""Most columns with ours, published and difference on one line; more columns use several lines."""

WITH_SD = 12
"""Most columns with the standard deviation behind its mean; with more it has its own line."""

BESIDE_OURS = ("published", "difference")
"""Header of the columns that belong to the one before."""

DASH = "-"
DOUBTFUL = "The printed value does not agree with the others of its row."
SMALL = (
    "scale={scale}: data and network are small; compare the verdicts of the claims with the paper, "
    "not the values."
)
"""Of every scale but "paper"."""

FORMS: dict[Form, str] = {
    "paper": "Form: every row is run as the text of the paper describes it.",
    "released": "Form: no row of this table has a released form that differs from the text.",
}
"""Of tables that say nothing about their forms."""
NOT_PRINTED = "Not in the paper."
COUNTED = (
    "Parameters and operations are those of the networks at scale={scale}, without any run and "
    "without discriminators."
)
MEASURED_ON = (
    "Memory and speed are those of the networks at scale={scale} with random weights, measured on "
    "{device}, batch 1. In brackets: the ratio to the first row. Compare the ratios with the "
    "paper, not the values."
)


@dataclass(frozen=True)
class TextCell:
    """One cell.

    Attributes:
        text: without marks.
        spread: standard deviation, or "".
        rank: 1 shown to be the best of the column, 2 the second best, 0 neither.
        notes: numbers of its footnotes.
    """

    text: str = ""
    spread: str = ""
    rank: int = 0
    notes: tuple[int, ...] = ()

    @property
    def whole(self) -> str:
        """With its spread."""
        return f"{self.text} ± {self.spread}" if self.spread else self.text


@dataclass(frozen=True)
class TableLine:
    """One line: "ours", "sd", "published", "difference" or "all" of a row."""

    kind: str
    label: TextCell
    fields: tuple[TextCell, ...]


@dataclass(frozen=True)
class RenderedTable:
    """The text of a table.

    Attributes:
        title: number and caption.
        header: above the fields of a line; the column of labels has none.
        lines: in the order of the rows.
        notes: footnotes, 1 first.
        remarks: sentences below the table without a footnote mark.
    """

    title: TextCell
    header: tuple[TextCell, ...]
    lines: tuple[TableLine, ...]
    notes: tuple[str, ...]
    remarks: tuple[str, ...]

    def remarks_with(self, legend: str) -> list[str]:
        """The remarks, with the legend where a cell is ranked."""
        marked = any(text.rank for line in self.lines for text in line.fields)
        return [*self.remarks, *([legend] if marked else [])]


def render_table(scored: ScoredTable, extra: Sequence[str] = ()) -> RenderedTable:
    """Format a computed table; `extra` are overrides that the user added to every row."""
    table, builder = scored.table, _LineBuilder(scored)
    title_notes = builder.notes(*table.remarks)
    header = builder.header()
    lines = [line for row in table.rows for line in builder.row(row)]
    return RenderedTable(
        title=TextCell(f"{table.paper}, {table.number}: {table.caption}", notes=title_notes),
        header=header,
        lines=tuple(lines),
        notes=tuple(builder.sentences),
        remarks=tuple(_remarks(scored, extra)),
    )


def _remarks(scored: ScoredTable, extra: Sequence[str]) -> list[str]:
    """Sentences below the table."""
    table = scored.table
    printed = any(row.values for row in table.rows)
    remarks = [f"Published: {table.data}; {table.unit}."] if printed else []
    if scored.seeds:
        many = len(scored.seeds) > 1
        seeds = _listed(scored.seeds)
        spread = "mean ± standard deviation (n - 1) over" if many else "of"
        remarks.append(f"Ours: scale={scored.scale}, {spread} seed{'s' * many} {seeds}.")
    if scored.cells and printed:
        remarks.append(table.forms.get(scored.form, FORMS[scored.form]))
    remarks += _efficiency_remarks(scored)
    if scored.seeds and scored.scale != "paper" and printed:
        remarks.append(SMALL.format(scale=scored.scale))
    if extra:
        remarks.append(f"Every row of ours was run with {' '.join(extra)}.")
    if len(scored.commits) > 1:
        named = Counter(scored.commits).most_common()
        commits = ", ".join(f"{commit} ({count})" for commit, count in named)
        remarks.append(f"Our runs come from several git commits: {commits}.")
    return remarks


def _efficiency_remarks(scored: ScoredTable) -> list[str]:
    """How columns of efficiency were counted or measured."""
    remarks = []
    shown = [
        (column, scored.cells[row.label, column.name])
        for row in scored.table.rows
        for column in scored.table.columns
        if column.efficiency is not None and (row.label, column.name) in scored.cells
    ]
    if any(column.efficiency not in MEASURED for column, _ in shown):
        remarks.append(COUNTED.format(scale=SCALE))
    devices = dict.fromkeys(cell.device for _, cell in shown if cell.device)
    return remarks + [MEASURED_ON.format(scale=SCALE, device=device) for device in devices]


@dataclass
class _LineBuilder:
    """Makes the lines of a table, of every row ours, published and difference.

    Attributes:
        sentences: footnotes in the order of their first use.
    """

    scored: ScoredTable
    sentences: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        table, cells = self.scored.table, self.scored.cells
        self.columns = table.columns
        self.on_one_line = len(self.columns) <= MAX_ON_ONE_LINE
        spread = any(cell.seeds > 1 for cell in cells.values())
        self.sd_apart = len(self.columns) > WITH_SD and spread
        # Published values have as many decimals as the paper prints.
        printed = [value for row in table.rows for value in row.values.values()]
        digits = [repr(value).partition(".")[2] for value in printed if value is not None]
        self.decimals = max((len(each.rstrip("0")) for each in digits), default=2)

    def notes(self, *sentences: str | None) -> tuple[int, ...]:
        """Numbers of footnotes; the same sentence keeps its number."""
        given = [sentence for sentence in sentences if sentence]
        self.sentences += [one for one in dict.fromkeys(given) if one not in self.sentences]
        return tuple(self.sentences.index(sentence) + 1 for sentence in given)

    def header(self) -> tuple[TextCell, ...]:
        """Above the fields of a line: the names of the columns."""
        names = []
        for column in self.columns:
            notes = self.notes(None if column.printed else NOT_PRINTED)
            names.append(TextCell(column.name, notes=notes))
        if not self.on_one_line:
            return (TextCell(), TextCell("seeds"), *names)
        return (TextCell("seeds"), *self._beside(names, [TextCell(word) for word in BESIDE_OURS]))

    def _beside(self, texts: Sequence[TextCell], others: Sequence[TextCell]) -> list[TextCell]:
        """A text per column, with `others` behind those of printed columns."""
        pairs = zip(self.columns, texts, strict=True)
        parts = [(text, *(others if column.printed else ())) for column, text in pairs]
        return [text for part in parts for text in part]

    def row(self, row: Row) -> list[TableLine]:
        """The lines of one row: a single one for few columns."""
        columns = self.columns
        remarks = row.remarks if not row.doubtful else ()
        label = TextCell(row.label, notes=self.notes(self._same_runs(row), *remarks))
        if self.on_one_line:
            texts = []
            for column in columns:
                texts.append(self._ours(row, column))
                if column.printed:
                    texts += [self._published(row, column), self._difference(row, column)]
            return [TableLine("all", label, (self._seeds(row), *texts))]
        runs = any((row.label, column.name) in self.scored.cells for column in columns)
        printed = any(published(row, column) is not None for column in columns)
        both = any(not math.isnan(self.scored.difference(row, column)) for column in columns)
        kinds = (
            ("ours", self._ours, runs),
            ("sd", self._sd, runs and self.sd_apart),
            ("published", self._published, printed or not runs),
            ("difference", self._difference, both),
        )
        lines: list[TableLine] = []
        for kind, text, is_shown in kinds:
            if is_shown:
                word = TextCell("± sd" if kind == "sd" else kind)
                seeds = self._seeds(row) if kind == "ours" else TextCell()
                fields = (word, seeds, *(text(row, column) for column in columns))
                lines.append(TableLine(kind, TextCell() if lines else label, fields))
        return lines

    def _same_runs(self, row: Row) -> str | None:
        """A note on an equal row: at scale=demo networks of all sizes are one."""
        keys = self._keys(row)
        counted = list(filter(is_counted, self.columns))
        metrics = [metric_of(column, row) for column in counted]
        for other in self.scored.table.rows[: self.scored.table.rows.index(row)]:
            is_same = metrics == [metric_of(column, other) for column in counted]
            if keys and keys == self._keys(other) and is_same:
                return f"At scale={self.scored.scale} the same runs as row '{other.label}'."
        return None

    def _keys(self, row: Row) -> tuple[str, ...]:
        cells = (self.scored.cells.get((row.label, column.name)) for column in self.columns)
        return next((cell.keys for cell in cells if cell is not None and cell.keys), ())

    def _seeds(self, row: Row) -> TextCell:
        """How many seeds the row's values are means of."""
        columns = filter(is_of_runs, self.columns)
        cells = [self.scored.cells.get((row.label, column.name)) for column in columns]
        there = [cell.seeds for cell in cells if cell is not None]
        counts = sorted({seeds for seeds in there if seeds} or set(there))
        return TextCell("-".join(dict.fromkeys(map(str, counts[:1] + counts[-1:]))))

    def _ours(self, row: Row, column: Column) -> TextCell:
        cell_id = (row.label, column.name)
        cell = self.scored.cells.get(cell_id)
        if cell is None:
            return TextCell(DASH)
        notes = self.notes(cell.reason and f"{cell.reason.removesuffix('.')}.")
        if math.isnan(cell.mean):
            return TextCell(DASH if cell.mark == NO_VALUE else cell.mark, notes=notes)
        spread = "" if math.isnan(cell.sd) or self.sd_apart else f"{cell.sd:.2f}"
        rank = self.scored.marks.get(cell_id, 0)
        return TextCell(f"{cell.mean:.2f}{_bracketed_ratio(cell.ratio)}", spread, rank, notes)

    def _sd(self, row: Row, column: Column) -> TextCell:
        cell = self.scored.cells.get((row.label, column.name))
        return TextCell(DASH if cell is None else number(cell.sd))

    def _published(self, row: Row, column: Column) -> TextCell:
        printed = published(row, column)
        if printed is None:
            return TextCell(DASH)
        doubts = (row.remarks or (DOUBTFUL,)) if column.name in row.doubtful else ()
        text = f"{printed:.{self.decimals}f}{_bracketed_ratio(self._printed_ratio(row, column))}"
        return TextCell(text, notes=self.notes(*doubts))

    def _printed_ratio(self, row: Row, column: Column) -> float:
        """The printed value divided by that of the first row that we measured; NaN: not shown."""
        if column.efficiency not in MEASURED:
            return math.nan
        rows = [each for each in self.scored.table.rows if self._is_measured(each, column)]
        first = published(rows[0], column) if rows else None
        printed = published(row, column)
        return printed / first if first and printed is not None else math.nan

    def _is_measured(self, row: Row, column: Column) -> bool:
        cell = self.scored.cells.get((row.label, column.name))
        return cell is not None and not math.isnan(cell.ratio)

    def _difference(self, row: Row, column: Column) -> TextCell:
        return TextCell(_signed(self.scored.difference(row, column)))


def _listed(seeds: Sequence[int]) -> str:
    """Numbers in order: "0, 4, 7", or "0 to 19" where none between them is missing."""
    if len(seeds) > 3 and seeds[-1] - seeds[0] == len(seeds) - 1:
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))


def _bracketed_ratio(ratio: float) -> str:
    return "" if math.isnan(ratio) else f" ({ratio:.2f}x)"


def _signed(value: float) -> str:
    return DASH if math.isnan(value) else f"{value:+.2f}"
