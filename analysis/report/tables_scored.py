"""Recorded tables scored again: every value from the counts of the runs that the record names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analysis.report.runs import ReportRun
from analysis.report.tables_files import NO_CELL, RecordedTable
from analysis.report.tables_intervals import CountsSource
from rgbt.checks import InputError
from rgbt.metrics.named import value
from sweeps.table.cells import (
    CellId,
    TableCell,
    counts_path,
    derived,
    is_counted,
    is_of_runs,
    metric_of,
)
from sweeps.table.scoring import ScoredTable, score
from sweeps.table.table import Column, Row, Table

AGREES = 1e-4
"""A recorded mean has six digits: a larger difference is another number."""


@dataclass(frozen=True)
class _Outcome:
    """What became of a cell's run, as `sweeps.table.scoring` reads it."""

    state: str
    reason: str = ""
    results: tuple[ReportRun, ...] = ()


@dataclass(frozen=True)
class RescoredTable:
    """A recorded table with its file, scored."""

    recorded: RecordedTable
    scored: ScoredTable


def score_again(
    recorded: RecordedTable, table: Table, runs: Mapping[str, ReportRun]
) -> ScoredTable:
    """Means, ranks and orders from the counts of the runs that the record names."""
    labels = {row.label for row in table.rows}
    places: dict[tuple[str, int], _Outcome] = {}
    for label in recorded.rows():
        keys = recorded.keys_of(label)
        if not keys or label not in labels:
            continue
        outcomes = _by_seed(keys, recorded.seeds, runs)
        places |= {(label, seed): outcome for seed, outcome in outcomes.items()}
    sizes = _sizes(recorded, table)
    return score(recorded.name, table, places, scale=recorded.scale, sizes=sizes)


def _sizes(recorded: RecordedTable, table: Table) -> dict[CellId, TableCell]:
    """Columns of parameters as recorded: a network is not known here."""
    names = {column.name for column in table.columns if column.parameters}
    labels = {row.label for row in table.rows}
    return {
        place: TableCell(math.nan if line.mean is None else line.mean, math.nan, 0, line.reason)
        for place, line in recorded.lines.items()
        if place[0] in labels and place[1] in names and (line.mean is not None or line.reason)
    }


def _by_seed(
    keys: Sequence[str], seeds: Sequence[int], runs: Mapping[str, ReportRun]
) -> dict[int, _Outcome]:
    """What became of every seed of a row; a run that is not here stands for a seed without one."""
    outcomes = {seed: _Outcome("failed", "not finished") for seed in seeds}
    here = {seed: key for key in keys if key in runs and (seed := runs[key].entry.seed) is not None}
    rest = [seed for seed in seeds if seed not in here]
    gone = zip(rest, (key for key in keys if key not in runs), strict=False)
    return outcomes | {seed: _outcome(key, runs.get(key)) for seed, key in [*here.items(), *gone]}


def _outcome(key: str, run: ReportRun | None) -> _Outcome:
    if run is None:
        return _Outcome("missing", f"run {key} is not in the store")
    return _Outcome("finished", results=(run,))


def interval_key(draft: RescoredTable, row: Row, column: Column) -> tuple[CountsSource, str] | None:
    """Source and metric of a cell's interval; None for cells without a value from counts."""
    table, place = draft.scored.table, (row.label, column.name)
    cell, line = draft.scored.cells.get(place), draft.recorded.lines.get(place, NO_CELL)
    if cell is None or not cell.seeds or cell.seeds < line.seeds:
        return None
    columns = _sides(table, column) if column.sources else [column]
    metrics = {metric_of(each, row) for each in columns if each.metric is not None}
    if len(metrics) != 1 or not all(map(is_counted, columns)) or column.mean is not None:
        return None  # a mean, or the difference of two different scores
    paths = tuple(counts_path(each, table) for each in columns)
    # Of the runs of the row those that the value is a mean of: all of them, see the check above.
    keys = cell.keys if cell.seeds == len(cell.keys) else ()
    return (CountsSource(keys, paths, table.absent), metrics.pop()) if keys else None


def values_of(
    draft: RescoredTable, row: Row, column: Column, runs: Mapping[str, ReportRun]
) -> tuple[float | None, ...]:
    """The score of each run of a cell, in the order of its keys; None: it has none."""
    keys = draft.recorded.lines.get((row.label, column.name), NO_CELL).keys
    if not is_of_runs(column):
        return ()
    return tuple(_value(draft.scored.table, row, column, runs.get(key)) for key in keys)


def _value(table: Table, row: Row, column: Column, run: ReportRun | None) -> float | None:
    if run is None:
        return None
    if column.sources:
        each = [_value(table, row, side, run) for side in _sides(table, column)]
        found = derived(column, ["" if value is None else value for value in each])
        return None if isinstance(found, str) else found
    try:
        counts = run.counts(counts_path(column, table))
        return value(metric_of(column, row), counts, table.absent or counts.absent)
    except InputError:  # the reason stands in the cell
        return None


def _sides(table: Table, column: Column) -> list[Column]:
    """The columns that a difference or mean is computed from, in their order."""
    return [each for name in column.sources for each in table.columns if each.name == name]


def changed(draft: RescoredTable) -> list[str]:
    """A sentence where counts give other means than were recorded with the table."""
    apart = [
        (place, cell.mean, line.mean)
        for place, cell in draft.scored.cells.items()
        if (line := draft.recorded.lines.get(place, NO_CELL)).mean is not None
        and cell.seeds == line.seeds
        and not abs(cell.mean - line.mean) <= AGREES
    ]
    if not apart:
        return []
    (row, column), now, then = apart[0]
    return [
        f"Table '{draft.recorded.name}' ({draft.recorded.scale}): {len(apart)} cells are not as "
        f"recorded, such as {row}, {column}: {now:.2f} from counts, {then:.2f} recorded; its "
        "command records it again."
    ]
