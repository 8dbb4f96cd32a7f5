"""A computed table: mean and spread over seeds, compared with the printed values.

Rows that cannot be run and columns that cannot be computed have no cells; without any run only
columns of efficiency have some.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from rgbt.metrics.named import parse
from sweeps.table.cells import CellId, CellRun, TableCell, is_counted, metric_of, row_cells
from sweeps.table.table import MEASURED, Column, Row, Table

MIN_ROWS = 3
"""Fewest rows whose order is compared: two rows agree or not by chance."""


@dataclass(frozen=True)
class Order:
    """Whether the rows have the printed order: Spearman's rank correlation.

    Attributes:
        rho: -1..1; NaN for fewer than `MIN_ROWS` rows, or where all values are equal.
        rows: number of rows with a value of ours and a printed one.
    """

    rho: float
    rows: int


@dataclass(frozen=True)
class ScoredTable:
    """A table with our values.

    Attributes:
        name: e.g. "spatialseg/table3".
        scale: "demo" or "paper".
        cells: only rows that were run, and columns of efficiency.
        orders: by name of the column.
        ranks_ours: 1 best, 2 second best of the column among our means.
        ranks_published: the same among the printed values.
        commits: git commit -> number of runs made by it.
    """

    name: str
    table: Table
    scale: str
    seeds: tuple[int, ...]
    cells: Mapping[CellId, TableCell]
    orders: Mapping[str, Order]
    ranks_ours: Mapping[CellId, int]
    ranks_published: Mapping[CellId, int]
    commits: Mapping[str, int]

    def difference(self, row: Row, column: Column) -> float:
        """Ours less the printed value; NaN where one is missing or of another device."""
        if column.efficiency in MEASURED:
            return math.nan
        cell = self.cells.get((row.label, column.name))
        printed = published(row, column)
        return math.nan if cell is None or printed is None else cell.mean - printed


def published(row: Row, column: Column) -> float | None:
    """The printed value, or None where there is none or a dash."""
    printed = row.values.get(column.name)
    return None if printed is None else float(printed)


def check_metrics(table: Table) -> None:
    """Refuse a misspelt metric before anything is run.

    Raises:
        InputError: naming the metric and the nearest known one.
    """
    columns = list(filter(is_counted, table.columns))
    metrics = {metric_of(column, row) for row in table.runnable_rows for column in columns}
    for metric in sorted(metrics):
        parse(metric)


def score(
    name: str,
    table: Table,
    runs: Mapping[tuple[str, int], CellRun],
    *,
    scale: str,
    sizes: Mapping[CellId, TableCell] | None = None,
) -> ScoredTable:
    """Compute every cell of the rows that were run.

    Args:
        name: of the table.
        table: its file.
        runs: (label of the row, seed) -> the run.
        scale: "demo" or "paper".
        sizes: cells of the columns of efficiency, see `sweeps.table.efficiency`.
    """
    seeds = sorted({seed for _, seed in runs})
    ran = {label for label, _ in runs}
    cells: dict[CellId, TableCell] = {}
    for row in table.rows:
        if row.label in ran:
            outcomes = {seed: runs[row.label, seed] for seed in seeds if (row.label, seed) in runs}
            cells |= row_cells(table, row, outcomes)
    # A mean over fewer seeds is shown, but has no rank and no part in the order of the rows.
    whole = {cell_id: cell for cell_id, cell in cells.items() if cell.seeds == len(seeds)}
    cells |= sizes or {}
    whole |= sizes or {}
    pairs = (((row.label, c.name), published(row, c)) for row in table.rows for c in table.columns)
    printed = {cell_id: value for cell_id, value in pairs if value is not None}
    made_by = {run.key: run.commit for outcome in runs.values() for run in outcome.results}
    return ScoredTable(
        name=name,
        table=table,
        scale=scale,
        seeds=tuple(seeds),
        cells=cells,
        orders={column.name: _order(table, column, whole) for column in table.columns},
        ranks_ours=_ranks(table, {cell_id: cell.mean for cell_id, cell in whole.items()}),
        ranks_published=_ranks(table, printed),
        commits=Counter(commit for commit in made_by.values() if commit is not None),
    )


def _ranks(table: Table, values: Mapping[CellId, float]) -> dict[CellId, int]:
    """1 and 2 for the best and second best of every column.

    Values that are equal as shown share a rank. Where all are equal none has one.
    """
    ranks: dict[CellId, int] = {}
    for column in table.columns:
        shown = {
            cell_id: round(value, 2)
            for cell_id, value in values.items()
            if cell_id[1] == column.name and not math.isnan(value)
        }
        if column.best == "none" or len(set(shown.values())) < 2:
            continue
        best = sorted(set(shown.values()), reverse=column.best == "highest")[:2]
        ranks |= {cell_id: best.index(each) + 1 for cell_id, each in shown.items() if each in best}
    return ranks


def _order(table: Table, column: Column, cells: Mapping[CellId, TableCell]) -> Order:
    pairs = []
    for row in table.rows:
        cell, printed = cells.get((row.label, column.name)), published(row, column)
        if cell is not None and printed is not None and not math.isnan(cell.mean):
            pairs.append((cell.mean, printed))
    constant = any(len(set(side)) < 2 for side in zip(*pairs, strict=True))
    if len(pairs) < MIN_ROWS or constant:
        return Order(math.nan, len(pairs))
    from scipy.stats import spearmanr

    ours, theirs = zip(*pairs, strict=True)
    return Order(float(spearmanr(ours, theirs).statistic), len(pairs))
