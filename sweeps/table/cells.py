"""Our values of a table: the value of every run, then mean and spread over seeds."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import details_of_metric
from rgbt.metrics.named import value
from sweeps.evaluation import ExtraEvaluation
from sweeps.point import Outcome
from sweeps.table.table import Column, Row, Table

HEADLINES = (names.MIOU, names.VAR, names.TC, names.CA, names.CA_RELEASED)
"""The scores that a table is about, where it has them."""

NO_VALUE = "no value"
"""Mark of a cell whose run is finished but has no value for the column."""

OWN_COUNTS = "counts_test.npz"
"""Path of the counts of the evaluation that every run makes itself, relative to the run folder."""

NO_SEED = "-1"
"""The seed of a row that was not trained here, as text (`analysis.uncertainty.contrasts.FIXED`)."""

CellId = tuple[str, str]
"""(label of the row, name of the column)."""

Value = float | str
"""A score, or the reason why there is none."""


@dataclass(frozen=True)
class TableCell:
    """Our value of one row and column.

    Attributes:
        mean: over seeds, percent (Var: squared percent points); NaN without any.
        sd: standard deviation over seeds with n - 1; NaN for fewer than two.
        seeds: number of seeds of the mean; 0 for the efficiency of a network, which needs no run.
        reason: why seeds are missing, or "".
        mark: the reason in a word, e.g. "failed".
        keys: of the runs.
        ratio: to the first row, of memory and speed; NaN for all else.
        device: that memory and speed were measured on; "" for all else.
    """

    mean: float
    sd: float
    seeds: int
    reason: str = ""
    mark: str = ""
    keys: tuple[str, ...] = ()
    ratio: float = math.nan
    device: str = ""


def metric_of(column: Column, row: Row) -> str:
    """The column's metric with placeholders such as ``{class}`` filled from the row's settings."""
    return str(column.metric).format_map(row.settings)


def evaluation_of(column: Column, table: Table) -> ExtraEvaluation | None:
    """The evaluation that the column needs; None: the one that every run makes itself."""
    if column.frames is not None:
        return ExtraEvaluation(frames=column.frames)
    details = details_of_metric(str(column.metric))
    needed = ExtraEvaluation(
        column.modality,
        table.regions,
        head=column.head,
        corruption=column.corruption,
        severity=column.severity,
        batch_norm=column.batch_norm,
        batch_norm_splits=column.batch_norm_splits,
        details=None if details is None else details.kind,
    )
    return None if needed == ExtraEvaluation() else needed


def world_evaluations(table: Table, row: Row) -> dict[str, ExtraEvaluation]:
    """Name -> evaluation of the row's network in every world of `Row.tested_in`."""
    return {
        name: ExtraEvaluation(regions=table.regions, world=name, dataset=overrides)
        for name, overrides in row.tested_in.items()
    }


def counts_path(column: Column, table: Table) -> str:
    """Path of the column's counts, relative to the run folder."""
    evaluation = evaluation_of(column, table)
    return OWN_COUNTS if evaluation is None else evaluation.path


def headline_columns(columns: Sequence[Column]) -> list[Column]:
    """Those of `HEADLINES`, over all images or those of the day or the night."""
    parts = ("", f"{names.DAY}/", f"{names.NIGHT}/")
    headlines = {part + score for part in parts for score in HEADLINES}
    return [column for column in columns if column.metric in headlines]


def is_counted(column: Column) -> bool:
    """Whether the column is a score of counts, not computed from other columns."""
    return column.metric is not None


def is_of_runs(column: Column) -> bool:
    """Whether the column has values of runs."""
    return column.efficiency is None


def row_cells(table: Table, row: Row, outcomes: Mapping[int, Outcome]) -> dict[CellId, TableCell]:
    """The cells of one row, whose runs are given by seed, in columns with values of runs."""
    by_seed = {seed: _values(table, row, outcome) for seed, outcome in outcomes.items()}
    keys = tuple(run.key for outcome in outcomes.values() for run in outcome.results)
    cells = {}
    for column in filter(is_of_runs, table.columns_of(row)):
        by_column = {seed: values[column.name] for seed, values in by_seed.items() if values}
        missing = [outcomes[seed] for seed, each in by_column.items() if isinstance(each, str)]
        marks = [NO_VALUE if run.state == "finished" else run.state for run in missing]
        if by_column:
            cells[row.label, column.name] = over_seeds(by_column, "".join(marks[:1]), keys)
    return cells


def _values(table: Table, row: Row, outcome: Outcome) -> dict[str, Value]:
    """Every column's value of one run."""
    counts: dict[str, Counts | str] = {}
    values: dict[str, Value] = {}
    columns = table.columns_of(row)
    for column in filter(is_counted, columns):
        path = counts_path(column, table)
        if path not in counts:
            counts[path] = _counts(outcome, path)
        values[column.name] = _value(metric_of(column, row), counts[path], table)
    for column in columns:
        if column.sources:
            values[column.name] = derived(column, [values[name] for name in column.sources])
    return values


def _counts(outcome: Outcome, path: str) -> Counts | str:
    if outcome.state != "finished" or not outcome.results:
        return outcome.reason or outcome.state
    try:
        return outcome.missing.get(path) or outcome.results[0].counts(path)
    except (InputError, OSError) as error:
        return str(error)


def _value(metric: str, counts: Counts | str, table: Table) -> Value:
    if isinstance(counts, str):
        return counts
    try:
        score = value(metric, counts, table.absent or counts.absent)
    except InputError as error:
        return str(error)
    return f"'{metric}' has nothing to score" if math.isnan(score) else score


def derived(column: Column, values: Sequence[Value]) -> Value:
    """Difference or mean of the values of `column.sources`, or the reason why one is missing."""
    known = [each for each in values if not isinstance(each, str)]
    if len(known) < len(values):
        return next(each for each in values if isinstance(each, str))
    return statistics.fmean(known) if column.minus is None else known[0] - known[1]


def over_seeds(
    by_seed: Mapping[int, Value], mark: str = "", keys: tuple[str, ...] = ()
) -> TableCell:
    """Mean and spread of the values of several seeds; for `mark` and `keys` see `TableCell`."""
    values = [each for each in by_seed.values() if not isinstance(each, str)]
    reasons: dict[str, list[str]] = {}
    for seed, each in by_seed.items():
        if isinstance(each, str):
            reasons.setdefault(each, []).append(str(seed))
    sentences = [
        why if seeds == [NO_SEED] else f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)}: {why}"
        for why, seeds in reasons.items()
    ]
    return TableCell(
        mean=statistics.fmean(values) if values else math.nan,
        sd=statistics.stdev(values) if len(values) > 1 else math.nan,
        seeds=len(values),
        reason="; ".join(sentences),
        mark=mark,
        keys=keys,
    )
