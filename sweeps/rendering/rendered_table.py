"""A computed table as lines of text with footnotes, the source of all file formats."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from sweeps.rendering.line_builder import LineBuilder
from sweeps.rendering.text_cell import Footnotes, TableLine, TextCell
from sweeps.table.parameter_counts import SCALE
from sweeps.table.scoring import ScoredTable
from sweeps.table.table import Column

DEMO = (
    "scale=demo: data and network are small; compare the order of the rows with the paper, not the "
    "values."
)
ORDER = (
    "rho: Spearman's rank correlation between our means and the published values over n rows; "
    "+1: the same order."
)
NOT_PRINTED = "Not in the paper."
PARAMETERS = f"Parameters are counted at scale={SCALE}, without any run and without discriminators."


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
    """Format a computed table.

    Args:
        scored: the table.
        extra: overrides that the user added to every row.
    """
    table, notes = scored.table, Footnotes()
    builder = LineBuilder(scored, notes)
    title = TextCell(f"{table.paper}, {table.number}: {table.caption}")
    title_notes = notes(table.needs and f"Cannot be run yet: {table.needs}", *table.remarks)
    columns = [
        TextCell(column.name, notes=notes(*_column_notes(column))) for column in table.columns
    ]
    lines = [line for row in table.rows for line in builder.row(row)] + builder.order()
    return RenderedTable(
        title=TextCell(title.text, notes=title_notes),
        header=builder.header(columns),
        lines=tuple(lines),
        notes=tuple(notes.sentences),
        remarks=tuple(_remarks(scored, extra)),
    )


def _column_notes(column: Column) -> list[str]:
    """Footnotes of a column: not in the paper, not computed."""
    ours = [] if column.printed else [NOT_PRINTED]
    return ours + ([f"Not computed: {column.needs}"] if column.needs else [])


def _remarks(scored: ScoredTable, extra: Sequence[str]) -> list[str]:
    """Sentences below the table."""
    table = scored.table
    printed = any(row.values for row in table.rows)
    sizes = [column for column in table.columns if column.parameters]
    remarks = [f"Published: {table.data}; {table.unit}."] if printed else []
    if scored.seeds:
        many = len(scored.seeds) > 1
        seeds = ", ".join(map(str, scored.seeds))
        spread = "mean ± standard deviation (n - 1) over" if many else "of"
        remarks.append(f"Ours: scale={scored.scale}, {spread} seed{'s' * many} {seeds}.")
    if any((row.label, c.name) in scored.cells for row in table.rows for c in sizes):
        remarks.append(PARAMETERS)
    if any(order.rows for order in scored.orders.values()):
        remarks.append(ORDER)
    if scored.seeds and scored.scale == "demo" and printed:
        remarks.append(DEMO)
    if extra:
        remarks.append(f"Every row of ours was run with {' '.join(extra)}.")
    if len(scored.commits) > 1:
        named = Counter(scored.commits).most_common()
        commits = ", ".join(f"{commit} ({count})" for commit, count in named)
        remarks.append(f"Runs of ours come from several git commits: {commits}.")
    return remarks
