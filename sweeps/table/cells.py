"""Our values of a table: of every run, then mean and spread over seeds."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from sweeps.evaluation import ExtraEvaluation

if TYPE_CHECKING:
    from sweeps.table.table import Column, Row, Table

NO_VALUE = "no value"
"""Mark of a cell whose run is there but does not hold what the column asks for."""

Place = tuple[str, str]
"""(label of the row, name of the column)."""

Value = float | str
"""A score, or why there is none."""


class ScoredRun(Protocol):
    """A finished run, here or in the store."""

    @property
    def key(self) -> str:
        """Its config key."""
        ...

    @property
    def commit(self) -> str | None:
        """Git commit of the code that made it."""
        ...

    def counts(self, evaluation: ExtraEvaluation | None = None) -> Counts:
        """Counts of the test split; InputError where they are missing or not readable."""
        ...


class CellRun(Protocol):
    """What became of a row's run with one seed."""

    @property
    def state(self) -> str:
        """How far it is: "finished", or a word that says why not."""
        ...

    @property
    def reason(self) -> str:
        """Why it is not finished, else empty."""
        ...

    @property
    def found(self) -> Sequence[ScoredRun]:
        """The finished run, or nothing."""
        ...


@dataclass(frozen=True)
class TableCell:
    """Our value of one row and column.

    Attributes:
        mean: over seeds, percent (Var: squared percent points); NaN without any.
        sd: standard deviation over seeds with n - 1; NaN for fewer than two.
        seeds: number of seeds that went into it; 0 for what is counted without any run.
        reason: why seeds are missing, or "".
        mark: the same in a word, e.g. "failed".
        keys: of the runs.
    """

    mean: float
    sd: float
    seeds: int
    reason: str = ""
    mark: str = ""
    keys: tuple[str, ...] = ()


def metric_of(column: Column, row: Row) -> str:
    """The column's metric with placeholders such as ``{class}`` filled from the row's settings."""
    return str(column.metric).format_map(row.settings)


def evaluation_of(column: Column, table: Table) -> ExtraEvaluation | None:
    """What the column is counted from; None: the evaluation that every run makes itself."""
    if column.frames is not None:
        return ExtraEvaluation(frames=column.frames)
    asked = ExtraEvaluation(
        column.modality,
        table.regions,
        head=column.head,
        degradation=column.degradation,
        severity=column.severity,
    )
    return None if asked == ExtraEvaluation() else asked


def is_counted(column: Column) -> bool:
    """Whether the column is read from counts: not computed of others, no size and not missing."""
    return column.metric is not None


def is_of_runs(column: Column) -> bool:
    """Whether the column has a value where there are runs."""
    return column.needs is None and not column.parameters


def row_cells(table: Table, row: Row, outcomes: Mapping[int, CellRun]) -> dict[Place, TableCell]:
    """The cells of one row; columns that are not computed of runs or left out have none.

    Args:
        table: the table.
        row: one of its rows.
        outcomes: what became of the row's runs, by seed.
    """
    by_seed = {seed: _values(table, row, outcome) for seed, outcome in outcomes.items()}
    keys = tuple(run.key for outcome in outcomes.values() for run in outcome.found)
    cells = {}
    for column in filter(is_of_runs, table.columns_of(row)):
        found = {seed: values[column.name] for seed, values in by_seed.items() if values}
        if found:
            marks = {seed: _mark(outcomes[seed], value) for seed, value in found.items()}
            cells[row.label, column.name] = over_seeds(found, marks, keys)
    return cells


def _values(table: Table, row: Row, outcome: CellRun) -> dict[str, Value]:
    """Every column's value of one run."""
    counts: dict[ExtraEvaluation | None, Counts | str] = {}
    values: dict[str, Value] = {}
    columns = table.columns_of(row)
    for column in filter(is_counted, columns):
        evaluation = evaluation_of(column, table)
        if evaluation not in counts:
            counts[evaluation] = _counts(outcome, evaluation)
        values[column.name] = _value(metric_of(column, row), counts[evaluation], table)
    for column in columns:
        if column.needs is not None:
            values[column.name] = column.needs
    for column in columns:
        if column.sources:
            values[column.name] = derived(column, [values[name] for name in column.sources])
    return values


def _counts(outcome: CellRun, evaluation: ExtraEvaluation | None) -> Counts | str:
    if outcome.state != "finished" or not outcome.found:
        return outcome.reason or outcome.state
    try:
        return outcome.found[0].counts(evaluation)
    except (InputError, OSError) as error:
        return str(error)


def _value(metric: str, counts: Counts | str, table: Table) -> Value:
    if isinstance(counts, str):
        return counts
    try:
        found = value(metric, counts, table.absent or counts.absent)
    except InputError as error:
        return str(error)
    return f"'{metric}' has nothing to score" if math.isnan(found) else found


def derived(column: Column, values: Sequence[Value]) -> Value:
    """Difference or mean of the values of `column.sources`; where one is missing, why."""
    known = [each for each in values if not isinstance(each, str)]
    if len(known) < len(values):
        return next(each for each in values if isinstance(each, str))
    return statistics.fmean(known) if column.minus is None else known[0] - known[1]


def _mark(outcome: CellRun, found: Value) -> str:
    if not isinstance(found, str):
        return ""
    return NO_VALUE if outcome.state == "finished" else outcome.state


def over_seeds(
    found: Mapping[int, Value], marks: Mapping[int, str] | None = None, keys: tuple[str, ...] = ()
) -> TableCell:
    """Mean and spread of the values of several seeds.

    Args:
        found: by seed.
        marks: by seed, the reason in a word where a value is missing.
        keys: of the runs.
    """
    values = [each for each in found.values() if not isinstance(each, str)]
    reasons: dict[str, list[int]] = {}
    for seed, each in found.items():
        if isinstance(each, str):
            reasons.setdefault(each, []).append(seed)
    told = [f"{_seeds(seeds)}: {reason}" for reason, seeds in reasons.items()]
    return TableCell(
        mean=statistics.fmean(values) if values else math.nan,
        sd=statistics.stdev(values) if len(values) > 1 else math.nan,
        seeds=len(values),
        reason="; ".join(told),
        mark=next((mark for mark in (marks or {}).values() if mark), ""),
        keys=keys,
    )


def _seeds(seeds: Sequence[int]) -> str:
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"
