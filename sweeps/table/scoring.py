"""A computed table: mean and spread over seeds, compared with the printed values.

Rows that cannot be run and columns that cannot be computed have no cells; without any run only
columns of efficiency have some.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from sweeps.point import Outcome
from sweeps.table.cells import CellId, TableCell, row_cells
from sweeps.table.table import COUNTED, MEASURED, Column, Form, Row, Table


@dataclass(frozen=True)
class ScoredTable:
    """A table with our values.

    Attributes:
        name: e.g. "spatialseg/table3".
        scale: a file of ``conf/scale``.
        cells: only rows that were run, and columns of efficiency.
        commits: git commit -> number of runs made by it.
        form: what the rows were run as.
        marks: 1 for a row that is shown to be the best of the column, 2 for the second best; see
            `sweeps.verdicts.judge.TableJudge.marks`.
    """

    name: str
    table: Table
    scale: str
    seeds: tuple[int, ...]
    cells: Mapping[CellId, TableCell]
    commits: Mapping[str, int]
    form: Form = "paper"
    marks: Mapping[CellId, int] = field(default_factory=dict)

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


def score(
    name: str,
    table: Table,
    runs: Mapping[tuple[str, int], Outcome],
    *,
    scale: str,
    sizes: Mapping[CellId, TableCell] | None = None,
) -> ScoredTable:
    """Compute every cell of the rows with `runs`: (label of the row, seed) -> the run.

    `sizes` are the cells of the columns of efficiency, see `sweeps.table.efficiency`.
    """
    seeds = sorted({seed for _, seed in runs})  # a row without seeds has a negative one
    cells: dict[CellId, TableCell] = {}
    for row in table.rows:
        outcomes = {seed: runs[row.label, seed] for seed in seeds if (row.label, seed) in runs}
        cells |= row_cells(table, row, outcomes)
    made_by = {run.key: run.commit for outcome in runs.values() for run in outcome.results}
    return ScoredTable(
        name=name,
        table=table,
        scale=scale,
        seeds=tuple(seed for seed in seeds if seed >= 0),
        cells=cells | dict(sizes or {}),
        commits=Counter(commit for commit in made_by.values() if commit is not None),
    )


def size_marks(table: Table, sizes: Mapping[CellId, TableCell]) -> dict[CellId, int]:
    """Marks of columns that are counted without a run and so are exact: 1 best, 2 second best.

    Sizes that are equal as shown share a mark. Where all are equal none has one.
    """
    marks: dict[CellId, int] = {}
    for column in table.columns:
        if column.efficiency not in COUNTED or column.best == "none":
            continue
        values = {
            cell_id: round(cell.mean, 2)
            for cell_id, cell in sizes.items()
            if cell_id[1] == column.name and not math.isnan(cell.mean)
        }
        best = sorted(set(values.values()), reverse=column.best == "highest")[:2]
        if len(best) == 2:
            marks |= {each: best.index(v) + 1 for each, v in values.items() if v in best}
    return marks
