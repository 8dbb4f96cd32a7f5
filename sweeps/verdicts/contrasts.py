"""Contrasts of the cells of a table: what a claim, or the mark of the best row, is about."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sweeps.table.cells import published
from sweeps.table.claim import Claim
from sweeps.table.table import Column, Row, Table


@dataclass(frozen=True)
class Contrast:
    """A row minus another one in a column; or the difference of two such differences.

    Attributes:
        row: its label.
        other: label of the row that is subtracted; None: the score of `row` itself.
        column: its name.
        minus_column: column whose difference is subtracted; None: there is none.
    """

    row: str
    other: str | None
    column: str
    minus_column: str | None = None

    @property
    def label(self) -> str:
        """As shown: "Ny/4 - CRM baseline, Var"."""
        rows = self.row if self.other is None else f"{self.row} - {self.other}"
        columns = (
            self.column if self.minus_column is None else f"{self.column} - {self.minus_column}"
        )
        return f"{rows}, {columns}"

    @property
    def rows(self) -> tuple[str, ...]:
        """The labels of its rows."""
        return (self.row,) if self.other is None else (self.row, self.other)

    def cells(self) -> Iterator[tuple[float, str, str]]:
        """(weight, row, column) of its cells."""
        columns = [(1.0, self.column)]
        columns += [] if self.minus_column is None else [(-1.0, self.minus_column)]
        for weight, column in columns:
            yield weight, self.row, column
            if self.other is not None:
                yield -weight, self.other, column


def contrasts_of(claim: Claim, table: Table) -> list[Contrast]:
    """The contrasts that a claim is made of, column by column."""
    labels = [row.label for row in table.rows if row.experiment is not None or row.values]
    return [
        Contrast(row, other, column, claim.minus_column)
        for column in claim.columns
        for row, other in claim.pairs(labels)
    ]


def printed_value(contrast: Contrast, table: Table) -> float | None:
    """The contrast of the printed values; None where one of them is not printed."""
    rows = {row.label: row for row in table.rows}
    columns = {column.name: column for column in table.columns}
    total = 0.0
    for weight, row, column in contrast.cells():
        value = published(rows[row], columns[column])
        if value is None:
            return None
        total += weight * value
    return total


def base_scores(table: Table, row: Row, name: str) -> Iterator[tuple[float, Column]]:
    """(weight, column) of the scores of counts that a column of a row is computed from.

    Raises:
        KeyError: the row has no such column.
    """
    columns = {column.name: column for column in table.columns_of(row)}
    column = columns[name]
    if not column.sources:
        yield 1.0, column
        return
    weights = [1.0, -1.0] if column.minus else [1 / len(column.sources)] * len(column.sources)
    for weight, source in zip(weights, column.sources, strict=True):
        for inner, base in base_scores(table, row, source):
            yield weight * inner, base
