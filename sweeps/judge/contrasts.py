"""Contrasts: the weighted sums of scores that a claim is about, and their exact values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from statistics import fmean
from typing import NamedTuple

from sweeps.plan.claim import Claim
from sweeps.plan.design import Design, sign_of
from sweeps.plan.table import Column, Row, Table
from sweeps.score.cells import CellId


class Cell(NamedTuple):
    """A score in a weighted sum: of a row in a column, tested in a `world` of its design or ""."""

    weight: float
    row: str
    column: str
    world: str = ""


class Contrast(NamedTuple):
    """A weighted sum of cells, and how it is shown: "Ny/4 - CRM baseline, Var"."""

    label: str
    cells: tuple[Cell, ...]

    @property
    def rows(self) -> set[str]:
        """Labels of its rows."""
        return {cell.row for cell in self.cells}

    def of_values(self, values: Mapping[CellId, float]) -> float | None:
        """Return the contrast of exact values of its cells; None where one is missing."""
        total = 0.0
        for cell in self.cells:
            if (cell.row, cell.column) not in values:
                return None
            total += cell.weight * values[cell.row, cell.column]
        return total


def contrasts_of(claim: Claim, table: Table) -> list[Contrast]:
    """Return the contrasts of rows that a claim is about, column by column; [] of an effect."""
    if claim.effect:
        return []
    labels = [row.label for row in table.rows if row.experiment is not None or row.values]
    contrasts = []
    for column in claim.columns:
        for row, other in claim.pairs(labels):
            contrasts.append(difference(row, other, column, claim.minus_column))
    return contrasts


def difference(row: str, other: str | None, column: str, minus: str | None = None) -> Contrast:
    """Subtract row `other` (None: nothing) in a column, and the same in the column `minus`."""
    cells = [Cell(1.0, row, column)]
    label = row
    if other is not None:
        cells.append(Cell(-1.0, other, column))
        label += f" - {other}"
    label += f", {column}"
    if minus is not None:
        cells += [Cell(-cell.weight, cell.row, minus) for cell in cells]
        label += f" - {minus}"
    return Contrast(label, tuple(cells))


def effects_claimed(claim: Claim, design: Design) -> list[Contrast]:
    """Return an effect on each method and outcome, in worlds that it is tested or trained in."""
    part = claim.part or next(iter(design.parts))
    signs = [sign_of(levels, claim.effect) for levels in design.cells(part)]
    contrasts = []
    for method, outcome in product(claim.rows, claim.columns):
        cells = []
        for sign, (row, world) in zip(signs, design.places(part, method), strict=True):
            cells.append(Cell(2 * sign / len(signs), row, outcome, world))
        label = f"{method}, {outcome}: {claim.effect}+ - {claim.effect}- ({part})"
        contrasts.append(Contrast(label, tuple(cells)))
    return contrasts


def printed_values(table: Table) -> dict[CellId, float]:
    """Return the printed value of every row and column that has one."""
    printed = {}
    for row in table.rows:
        for name, value in row.values.items():
            if value is not None:
                printed[row.label, name] = float(value)
    return printed


def base_scores(table: Table, row: Row, name: str) -> list[tuple[float, Column]]:
    """Return the scores that a column of a row is computed from, with weights."""
    columns = {column.name: column for column in table.columns_of(row)}
    column = columns[name]
    if not column.sources:
        return [(1.0, column)]
    weights = [1 / len(column.sources)] * len(column.sources)
    if column.minus:
        weights = [1.0, -1.0]
    scores = []
    for weight, source in zip(weights, column.sources, strict=True):
        for inner, base in base_scores(table, row, source):
            scores.append((weight * inner, base))
    return scores


def is_level(contrast: Contrast, table: Table) -> bool:
    """Whether a contrast is about how high a score is, not about a difference of scores."""
    rows = {row.label: row for row in table.rows}
    total = 0.0
    for cell in contrast.cells:
        parts = base_scores(table, rows[cell.row], cell.column)
        total += cell.weight * sum(weight for weight, _ in parts)
    return abs(total) > 1e-9


def as_claimed(claim: Claim, contrasts: Sequence[float | None]) -> bool | None:
    """Return whether exact values of its contrasts agree with a claim; None: some are missing."""
    values = [value for value in contrasts if value is not None]
    if not values or len(values) < len(contrasts):
        return None
    low, high = claim.range
    if claim.combine == "mean":
        return low < fmean(values) < high
    inside = sum(low < value < high for value in values)
    least = {"all": len(values), "most": len(values) // 2 + 1, "any": 1}[claim.combine]
    return inside >= least
