"""Records of tables, scored again from the counts of the runs that they name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from analysis.report.runs import ReportRun
from analysis.report.tables_recorded import NO_CELL, RecordedCell, RecordedTable
from rgbt.checks import InputError
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import value
from sweeps.point import Outcome, Point
from sweeps.table.cells import (
    ScoredTable,
    TableCell,
    counts_path,
    derived,
    is_counted,
    is_of_runs,
    metric_of,
    score,
)
from sweeps.table.table import Column, Row, Table
from sweeps.verdicts.forms import both_forms
from sweeps.verdicts.judge import CellRunId

AGREES = 1e-4
"""A recorded mean has six digits: a larger difference is another number."""


@dataclass(frozen=True)
class CountsSource:
    """Counts that scores are taken from.

    Attributes:
        keys: of the runs, one per seed.
        paths: of the counts in each run; two: the first less the second.
        absent: how a class without pixels scores; None: as the counts say.
    """

    keys: tuple[str, ...]
    paths: tuple[str, ...]
    absent: Absent | None


@dataclass(frozen=True)
class RescoredTable:
    """A recorded table with its file, scored from the counts of the runs that the record names.

    Attributes:
        outcomes: (label of the row, seed) -> the run that the record names.
        runs: opened runs by key.
    """

    recorded: RecordedTable
    scored: ScoredTable
    outcomes: Mapping[CellRunId, Outcome]
    runs: Mapping[str, ReportRun]

    def line(self, row: Row, column: Column) -> RecordedCell:
        """A cell as it was recorded."""
        return self.recorded.lines.get((row.label, column.name), NO_CELL)

    def interval_key(self, row: Row, column: Column) -> tuple[CountsSource, str] | None:
        """Source and metric of a cell's interval; None for cells without a value from counts."""
        table, cell = self.scored.table, self.scored.cells.get((row.label, column.name))
        if cell is None or not cell.seeds or cell.seeds < self.line(row, column).seeds:
            return None
        columns = self._sides(column) if column.sources else [column]
        metrics = {metric_of(each, row) for each in columns if each.metric is not None}
        if len(metrics) != 1 or not all(map(is_counted, columns)) or column.mean is not None:
            return None  # a mean, or the difference of two different scores
        if cell.seeds != len(cell.keys):
            return None  # the value is a mean over a part of the runs of the row
        paths = tuple(counts_path(each, table) for each in columns)
        return CountsSource(cell.keys, paths, table.absent), metrics.pop()

    def values(self, row: Row, column: Column) -> tuple[float | None, ...]:
        """The score of each run of a cell, in the order of its keys; None: it has none."""
        if not is_of_runs(column):
            return ()
        keys = self.line(row, column).keys
        return tuple(self._value(row, column, self.runs.get(key)) for key in keys)

    def _value(self, row: Row, column: Column, run: ReportRun | None) -> float | None:
        if run is None:
            return None
        table = self.scored.table
        if column.sources:
            each = [self._value(row, side, run) for side in self._sides(column)]
            found = derived(column, ["" if one is None else one for one in each])
            return None if isinstance(found, str) else found
        try:
            counts = run.counts(counts_path(column, table))
            return value(metric_of(column, row), counts, table.absent or counts.absent)
        except InputError:  # the cell shows the reason
            return None

    def _sides(self, column: Column) -> list[Column]:
        """The columns that a difference or mean is computed from, in their order."""
        columns = self.scored.table.columns
        return [each for name in column.sources for each in columns if each.name == name]

    def changed(self) -> list[str]:
        """A sentence where counts give other means than were recorded with the table."""
        apart = [
            (place, cell.mean, line.mean)
            for place, cell in self.scored.cells.items()
            if (line := self.recorded.lines.get(place, NO_CELL)).mean is not None
            and cell.seeds == line.seeds
            and not abs(cell.mean - line.mean) <= AGREES
        ]
        if not apart:
            return []
        (row, column), now, then = apart[0]
        return [
            f"Table '{self.recorded.name}' ({self.recorded.scale}): {len(apart)} cells are not as "
            f"recorded, such as {row}, {column}: {now:.2f} from counts, {then:.2f} recorded; its "
            "command records it again."
        ]


def score_again(
    recorded: RecordedTable, table: Table, runs: Mapping[str, ReportRun]
) -> RescoredTable:
    """Means from the counts of the runs that the record names."""
    table = _in_form(table, recorded)
    labels = {row.label for row in table.rows}
    outcomes: dict[CellRunId, Outcome] = {}
    for label in recorded.rows():
        lines = [line for (row, _), line in recorded.lines.items() if row == label]
        keys = tuple(dict.fromkeys(key for line in lines for key in line.keys))
        if keys and label in labels:
            found = _by_seed(keys, recorded.seeds, runs)
            outcomes |= {(label, seed): outcome for seed, outcome in found.items()}
    # Columns of parameters as recorded: a network is not known here.
    names = {column.name for column in table.columns if column.efficiency is not None}
    sizes = {
        place: TableCell(math.nan if line.mean is None else line.mean, math.nan, 0, line.reason)
        for place, line in recorded.lines.items()
        if place[0] in labels and place[1] in names and (line.mean is not None or line.reason)
    }
    scored = score(recorded.name, table, outcomes, scale=recorded.scale, sizes=sizes)
    form = "paper" if recorded.form == "both" else recorded.form
    return RescoredTable(recorded, replace(scored, form=form), outcomes, runs)


def _in_form(table: Table, recorded: RecordedTable) -> Table:
    """The table with a further row for each released form where the record has both forms."""
    has_forms = any(row.released is not None for row in table.rows)
    return both_forms(table) if recorded.form == "both" and has_forms else table


def _by_seed(
    keys: Sequence[str], seeds: Sequence[int], runs: Mapping[str, ReportRun]
) -> dict[int, Outcome]:
    """The outcome of every run of a row; one that is not here has an outcome without results.

    The seeds of a row without a run have none: the record says why, or the row needs fewer seeds
    than others of the table.
    """
    here = {seed: key for key in keys if key in runs and (seed := runs[key].entry.seed) is not None}
    none = Point("", ())
    found: dict[int, Any] = {seed: runs[key] for seed, key in here.items()}
    outcomes = {seed: Outcome(none, "finished", results=(run,)) for seed, run in found.items()}
    rest = [seed for seed in seeds if seed not in here]
    gone = [key for key in keys if key not in runs]
    for seed, key in zip(rest, gone, strict=False):
        outcomes[seed] = Outcome(none, "missing", f"run {key} is not in the store")
    return outcomes
