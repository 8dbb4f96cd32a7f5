"""Cells of the page's tables: ours with interval and rank, or as recorded, beside the printed."""

from __future__ import annotations

import math
from dataclasses import replace

from analysis.report.data import CellEntry
from analysis.report.tables_files import NO_CELL, RecordedCell
from analysis.report.tables_intervals import Intervals
from analysis.report.tables_scored import RescoredTable, interval_key, values_of
from sweeps.table.scoring import ScoredTable, published
from sweeps.table.table import Column, Row

NOT_HERE = "counts of some runs are not in the store; the value is as recorded, without interval."


def cell_of(draft: RescoredTable, row: Row, column: Column, intervals: Intervals) -> CellEntry:
    """One cell of a table that was run; `intervals` have been computed."""
    scored, place = draft.scored, (row.label, column.name)
    plain = printed_cell(scored, row, column)
    line, cell = draft.recorded.lines.get(place, NO_CELL), scored.cells.get(place)
    if cell is None or cell.seeds < line.seeds:
        values = values_of(draft, row, column, intervals.runs)
        return replace(as_recorded(plain, line), values=values)
    mean = None if math.isnan(cell.mean) else cell.mean
    entry = replace(
        plain,
        mean=mean,
        sd=None if math.isnan(cell.sd) else cell.sd,
        seeds=cell.seeds,
        difference=_difference(mean, plain.published),
        reason=line.reason or cell.reason or plain.reason,
        runs=line.keys,
        values=values_of(draft, row, column, intervals.runs),
        rank=scored.ranks_ours.get(place, 0),
    )
    key = interval_key(draft, row, column)
    found = None if key is None else intervals.found.get(key)
    if found is None:
        return entry
    if found.interval is None:
        return replace(entry, reason=entry.reason or found.reason)
    low, high = found.interval.low, found.interval.high
    return replace(entry, low=low, high=high, covers=found.covers)


def printed_cell(scored: ScoredTable, row: Row, column: Column) -> CellEntry:
    """What is known of a cell without any run."""
    needs = column.needs or row.needs or scored.table.needs or ""
    if not needs and row.experiment is None:
        needs = "shown as published only"
    return CellEntry(
        published=published(row, column),
        reason=needs,
        published_rank=scored.ranks_published.get((row.label, column.name), 0),
    )


def as_recorded(plain: CellEntry, line: RecordedCell) -> CellEntry:
    """A cell whose runs have no counts here."""
    if line.mean is None:
        return replace(plain, reason=line.reason or plain.reason, runs=line.keys)
    return replace(
        plain,
        mean=line.mean,
        sd=line.sd,
        seeds=line.seeds,
        difference=_difference(line.mean, plain.published),
        reason=line.reason or NOT_HERE,
        runs=line.keys,
    )


def _difference(mean: float | None, printed: float | None) -> float | None:
    return None if mean is None or printed is None else mean - printed
