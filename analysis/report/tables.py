"""Every table beside its paper: our cells from counts with intervals, and those nobody has run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from analysis.report.data import CellEntry, TableEntry
from analysis.report.runs import ReportRun
from analysis.report.store import MlflowRun
from analysis.report.tables_cells import as_recorded, cell_of, printed_cell
from analysis.report.tables_files import (
    DEFAULT_SEEDS,
    NO_CELL,
    RecordedTable,
    read_recorded,
    reproduce_command,
)
from analysis.report.tables_intervals import Intervals, Track
from analysis.report.tables_scored import RescoredTable, changed, interval_key, score_again
from rgbt.checks import InputError
from sweeps.table.load_table import load_table, table_names
from sweeps.table.request import DEFAULT_SCALE
from sweeps.table.scoring import score
from sweeps.table.table import Column, Row, Table


def table_entries(
    records: Sequence[MlflowRun],
    runs: Mapping[str, ReportRun],
    resamples: int,
    track: Track,
    remarks: list[str],
) -> tuple[TableEntry, ...]:
    """All tables: those with runs first, then the published ones that wait.

    Args:
        records: runs of MLflow of the kind "table".
        runs: opened runs by key.
        resamples: of the images, for intervals.
        track: shows how far it is.
        remarks: gets a sentence for everything that cannot be read or does not agree.
    """
    files = _load_all(track, remarks)
    recorded = _read_all(records, remarks)
    drafts = {
        index: RescoredTable(each, score_again(each, files[each.name], runs))
        for index, each in enumerate(recorded)
        if each.name in files
    }
    intervals = Intervals(runs)
    for draft in drafts.values():
        _ask(draft, intervals)
    intervals.compute(resamples, track)
    known = {each.name for each in recorded}
    made = [
        _entry(drafts[index], intervals, remarks) if index in drafts else _without_file(each)
        for index, each in enumerate(recorded)
    ]
    for each in recorded:
        if each.name not in files:
            remarks.append(f"Table '{each.name}' has no file here any more; it is as recorded.")
    return (*made, *(_waiting(name, files[name]) for name in files if name not in known))


def _load_all(track: Track, remarks: list[str]) -> dict[str, Table]:
    files = {}
    for name in track(list(dict.fromkeys(table_names())), "tables"):
        try:
            files[name] = load_table(name)
        except InputError as error:
            remarks.append(f"Table '{name}' is left out: {error}")
    return files


def _read_all(records: Sequence[MlflowRun], remarks: list[str]) -> list[RecordedTable]:
    found = []
    for record in records:
        try:
            found.append(read_recorded(record))
        except InputError as error:
            remarks.append(str(error))
    return sorted(found, key=lambda each: (each.name, each.scale, each.extra))


def _ask(draft: RescoredTable, intervals: Intervals) -> None:
    table = draft.scored.table
    for row in table.rows:
        for column in table.columns:
            key = interval_key(draft, row, column)
            if key is not None:
                intervals.request(*key)


def _entry(draft: RescoredTable, intervals: Intervals, remarks: list[str]) -> TableEntry:
    recorded, scored = draft.recorded, draft.scored
    table = scored.table
    gone = [label for label in recorded.rows() if label not in {row.label for row in table.rows}]
    if gone:
        remarks.append(
            f"Table '{recorded.name}': its file has no row '{gone[0]}' any more, which was run."
        )
    remarks += changed(draft)
    return _laid_out(
        recorded.name,
        table,
        lambda row, column: cell_of(draft, row, column, intervals),
        scale=recorded.scale,
        orders={
            name: (None if math.isnan(each.rho) else each.rho, each.rows)
            for name, each in scored.orders.items()
        },
        notes=(*_notes(table), *recorded.remarks),
        command=_command(recorded),
        extra=recorded.extra,
    )


def _notes(table: Table) -> tuple[str, ...]:
    """What the file says beside its values, one sentence each."""
    needed = [f"Cannot be run yet, needs {table.needs}."] if table.needs else []
    columns = [f"{each.name}: not in the paper." for each in table.columns if not each.printed]
    columns += [
        f"{each.name}: not computed, needs {each.needs}." for each in table.columns if each.needs
    ]
    rows = [f"{row.label}: {remark}" for row in table.rows for remark in row.remarks]
    return (*needed, *table.remarks, *columns, *rows)


def _command(recorded: RecordedTable) -> str:
    seeds = recorded.seeds or DEFAULT_SEEDS
    return reproduce_command(recorded.name, seeds, recorded.scale or DEFAULT_SCALE, recorded.extra)


def _waiting(name: str, table: Table) -> TableEntry:
    """A table that nobody has run."""
    scored = score(name, table, {}, scale="")
    return _laid_out(
        name,
        table,
        partial(printed_cell, scored),
        scale="",
        orders={},
        notes=_notes(table),
        command=reproduce_command(name, DEFAULT_SEEDS, DEFAULT_SCALE),
    )


def _laid_out(
    name: str, table: Table, cell: Callable[[Row, Column], CellEntry], **others: Any
) -> TableEntry:
    return TableEntry(
        name=name,
        paper=table.paper,
        number=table.number,
        caption=table.caption,
        data=table.data,
        unit=table.unit,
        columns=tuple(column.name for column in table.columns),
        best=tuple(column.best for column in table.columns),
        rows=tuple(row.label for row in table.rows),
        proposed=tuple(row.proposed for row in table.rows),
        cells=tuple(tuple(cell(row, each) for each in table.columns) for row in table.rows),
        **others,
    )


def _without_file(recorded: RecordedTable) -> TableEntry:
    """A recorded table whose file is gone: as recorded, without intervals."""
    rows, columns = recorded.rows(), recorded.columns()
    lines = [[recorded.lines.get((row, column), NO_CELL) for column in columns] for row in rows]
    return TableEntry(
        name=recorded.name,
        paper=recorded.name.rpartition("/")[0],
        number=recorded.name,
        caption="",
        scale=recorded.scale,
        data="",
        unit="percent",
        columns=columns,
        best=tuple("none" for _ in columns),
        rows=rows,
        proposed=tuple(False for _ in rows),
        cells=tuple(
            tuple(as_recorded(CellEntry(published=line.published), line) for line in row)
            for row in lines
        ),
        orders={name: (rho, 0) for name, rho in recorded.orders.items()},
        notes=("Its file is gone: values as recorded, without intervals.", *recorded.remarks),
        command=_command(recorded),
        extra=recorded.extra,
    )
