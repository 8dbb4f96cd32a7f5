"""The lines of a computed table: of every row ours, published and difference."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rgbt.tracking.tables import number
from sweeps.rendering.text_cell import Footnotes, TableLine, TextCell
from sweeps.table.cells import NO_VALUE, TableCell, is_counted, is_of_runs, metric_of
from sweeps.table.scoring import ScoredTable, published
from sweeps.table.table import Column, Row

BESIDE = 3
"""Columns up to which ours, published and difference stand beside each other; else below."""

WITH_SD = 12
"""Columns up to which the standard deviation stands behind its mean; else on a line of its own."""

BESIDE_OURS = ("published", "difference")
"""Header of the columns that belong to the one before."""

DASH = "-"
DOUBTFUL = "The printed value does not agree with the others of its row."


@dataclass(frozen=True)
class LineBuilder:
    """Makes the lines of a table; `notes` collects their footnotes."""

    scored: ScoredTable
    notes: Footnotes

    @property
    def columns(self) -> tuple[Column, ...]:
        """Of the table."""
        return self.scored.table.columns

    @property
    def decimals(self) -> int:
        """Of the printed values, as many as the paper prints."""
        printed = [value for row in self.scored.table.rows for value in row.values.values()]
        digits = [repr(value).partition(".")[2] for value in printed if value is not None]
        return max((len(each.rstrip("0")) for each in digits), default=2)

    @property
    def beside(self) -> bool:
        """Whether a row is one line."""
        return len(self.columns) <= BESIDE

    @property
    def sd_apart(self) -> bool:
        """Whether standard deviations have a line of their own."""
        spread = any(cell.seeds > 1 for cell in self.scored.cells.values())
        return len(self.columns) > WITH_SD and spread

    def header(self, columns: Sequence[TextCell]) -> tuple[TextCell, ...]:
        """Above the fields of a line, from the names of the columns."""
        if not self.beside:
            return (TextCell(), TextCell("seeds"), *columns)
        words = tuple(map(TextCell, BESIDE_OURS))
        named = zip(self.columns, columns, strict=True)
        beside = [(text, *(words if column.printed else ())) for column, text in named]
        return (TextCell("seeds"), *(text for texts in beside for text in texts))

    def row(self, row: Row) -> list[TableLine]:
        """The lines of one row: all in one where they fit beside each other."""
        printed = [column for column in self.columns if published(row, column) is not None]
        runs = any((row.label, column.name) in self.scored.cells for column in self.columns)
        label = TextCell(row.label, notes=self.notes(*self._label_notes(row)))
        kinds: dict[str, Callable[[Row, Column], TextCell]] = {}
        if runs:
            kinds["ours"] = self._ours
        if runs and self.sd_apart:
            kinds["sd"] = self._sd
        if printed or not runs:
            kinds["published"] = self._published
        if any(not math.isnan(self.scored.difference(row, column)) for column in self.columns):
            kinds["difference"] = self._difference
        if self.beside:
            return [TableLine("all", label, (self._seeds(row), *self._triples(row)))]
        lines: list[TableLine] = []
        for kind, text in kinds.items():
            word = "± sd" if kind == "sd" else kind
            seeds = self._seeds(row) if kind == "ours" else TextCell()
            texts = (text(row, column) for column in self.columns)
            lines.append(
                TableLine(kind, label if not lines else TextCell(), (TextCell(word), seeds, *texts))
            )
        return lines

    def order(self) -> list[TableLine]:
        """The lines that compare the order of the rows with the paper's."""
        orders = [self.scored.orders[column.name] for column in self.columns]
        if not any(order.rows for order in orders):
            return []
        rhos = [TextCell(_signed(order.rho)) for order in orders]
        rows = [TextCell(str(order.rows)) for order in orders]
        if self.beside:
            apart = [self._apart(texts) for texts in (rhos, rows)]
            labels = TextCell("order of rows: rho"), TextCell("n")
            pairs = zip(labels, apart, strict=True)
            return [TableLine("order", label, (TextCell(), *texts)) for label, texts in pairs]
        return [
            TableLine("order", TextCell("order of rows"), (TextCell("rho"), TextCell(), *rhos)),
            TableLine("order", TextCell(), (TextCell("n"), TextCell(), *rows)),
        ]

    def _apart(self, texts: Sequence[TextCell]) -> list[TextCell]:
        """A text per column, with room for what is published of it."""
        pairs = zip(self.columns, texts, strict=True)
        apart = [
            (text, TextCell(), TextCell()) if column.printed else (text,) for column, text in pairs
        ]
        return [text for each in apart for text in each]

    def _triples(self, row: Row) -> list[TextCell]:
        """Ours, published and difference of every column; ours alone where it is not printed."""
        beside = (self._published, self._difference)
        kinds = [(self._ours, *(beside if column.printed else ())) for column in self.columns]
        pairs = zip(self.columns, kinds, strict=True)
        return [kind(row, column) for column, each in pairs for kind in each]

    def _label_notes(self, row: Row) -> list[str]:
        needs = [] if row.needs is None else [f"Cannot be run yet: {row.needs}"]
        return [*needs, *self._same_runs(row), *(row.remarks if not row.doubtful else ())]

    def _same_runs(self, row: Row) -> list[str]:
        """That the row is another one again: at scale=demo networks of all sizes are one."""
        counted = list(filter(is_counted, self.columns))
        for other in self.scored.table.rows:
            if other.label == row.label:
                return []
            keys = self._keys(other)
            metrics = [metric_of(column, other) for column in counted]
            if keys and keys == self._keys(row) and metrics == [metric_of(c, row) for c in counted]:
                return [f"At scale={self.scored.scale} the same runs as row '{other.label}'."]
        raise AssertionError("the row is one of the table's")

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
        place = (row.label, column.name)
        cell = self.scored.cells.get(place)
        if cell is None:
            return TextCell(DASH)
        notes = self.notes(cell.reason and _sentence(cell))
        if math.isnan(cell.mean):
            return TextCell(DASH if cell.mark == NO_VALUE else cell.mark, notes=notes)
        spread = "" if math.isnan(cell.sd) or self.sd_apart else f"{cell.sd:.2f}"
        rank = self.scored.ranks_ours.get(place, 0)
        return TextCell(f"{cell.mean:.2f}", spread, rank, notes)

    def _sd(self, row: Row, column: Column) -> TextCell:
        cell = self.scored.cells.get((row.label, column.name))
        return TextCell(DASH if cell is None else number(cell.sd))

    def _published(self, row: Row, column: Column) -> TextCell:
        printed = published(row, column)
        if printed is None:
            return TextCell(DASH)
        doubts = (row.remarks or (DOUBTFUL,)) if column.name in row.doubtful else ()
        rank = self.scored.ranks_published.get((row.label, column.name), 0)
        notes = self.notes(*doubts)
        return TextCell(f"{printed:.{self.decimals}f}", rank=rank, notes=notes)

    def _difference(self, row: Row, column: Column) -> TextCell:
        return TextCell(_signed(self.scored.difference(row, column)))


def _sentence(cell: TableCell) -> str:
    return cell.reason if cell.reason.endswith(".") else f"{cell.reason}."


def _signed(value: float) -> str:
    return DASH if math.isnan(value) else f"{value:+.2f}"
