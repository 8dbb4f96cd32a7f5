"""Our values of a table: of every run, then mean and spread over seeds, beside the printed ones."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from analysis.uncertainty.contrasts import FIXED
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.runs.result import RunResult
from sweeps.plan.measurement import Words, counts_of
from sweeps.plan.request import RowSeed
from sweeps.plan.table import Column, Form, Row, Table, is_counted, metric_of, words_of
from sweeps.point import Outcome

NO_VALUE = "no value"  # mark of a cell whose run is finished but has no value for the column

CellId = tuple[str, str]  # (label of the row, name of the column)
Value = float | str  # a score, or the reason why there is none
Reader = Callable[[RunResult, Words], Counts]  # reads the counts of a measurement of a run


@dataclass(frozen=True)
class TableCell:
    """Our value of one row and column.

    Attributes:
        mean: over seeds, percent (Var: squared percent points); NaN without any.
        sd: standard deviation over seeds with n - 1; NaN for fewer than two.
        seeds: number of seeds of the mean; 0 for the size of a network, which needs no run.
        reason: why seeds are missing, or ""; `mark` says it in a word, e.g. "failed".
        keys: of the runs.
    """

    mean: float
    sd: float
    seeds: int
    reason: str = ""
    mark: str = ""
    keys: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScoredTable:
    """A table with our values.

    Attributes:
        cells: only of rows that were run, and of sizes of networks.
        commits: git commit -> number of runs made by it.
        lists: label of a row that was run -> the lists of its runs, in words.
        marks: 1 for a row that is shown to be the best of the column, 2 for the second best.
    """

    name: str
    table: Table
    scale: str
    seeds: tuple[int, ...]
    cells: Mapping[CellId, TableCell]
    commits: Mapping[str, int]
    form: Form = "paper"
    lists: Mapping[str, str] = field(default_factory=dict)
    marks: Mapping[CellId, int] = field(default_factory=dict)

    def difference(self, row: Row, column: Column) -> float:
        """Subtract the printed value from ours; NaN where one is missing."""
        cell = self.cells.get((row.label, column.name))
        printed = published(row, column)
        return math.nan if cell is None or printed is None else cell.mean - printed


def score(
    name: str,
    table: Table,
    runs: Mapping[RowSeed, Outcome],
    *,
    scale: str,
    sizes: Mapping[CellId, TableCell] | None = None,
    reader: Reader = counts_of,
) -> ScoredTable:
    """Compute every cell of the rows with `runs`; `sizes` are those of networks."""
    seeds = sorted({seed for _, seed in runs})  # a row without seeds has a negative one
    cells: dict[CellId, TableCell] = {}
    for row in table.rows:
        outcomes = {seed: runs[row.label, seed] for seed in seeds if (row.label, seed) in runs}
        cells |= _row_cells(table, row, outcomes, reader)
    folds = table.folds.get(scale)
    of_folds = f"every seed on its fold of {folds}"
    lists: dict[str, set[str]] = {}
    made_by: dict[str, str | None] = {}
    for (label, _), outcome in runs.items():
        for run in outcome.results:
            made_by[run.key] = run.commit
            if run.lists:
                lists.setdefault(label, set()).add(of_folds if folds else run.lists)
    return ScoredTable(
        name=name,
        table=table,
        scale=scale,
        seeds=tuple(seed for seed in seeds if seed >= 0),
        cells=cells | dict(sizes or {}),
        commits=Counter(commit for commit in made_by.values() if commit is not None),
        lists={label: " or ".join(sorted(names)) for label, names in lists.items()},
    )


def is_of_runs(column: Column) -> bool:
    """Whether the column has values of runs."""
    return column.efficiency is None


def _row_cells(
    table: Table, row: Row, outcomes: Mapping[int, Outcome], reader: Reader
) -> dict[CellId, TableCell]:
    if not outcomes:
        return {}
    by_seed = {seed: _values(table, row, outcome, reader) for seed, outcome in outcomes.items()}
    keys = tuple(run.key for outcome in outcomes.values() for run in outcome.results)
    cells = {}
    for column in filter(is_of_runs, table.columns_of(row)):
        values = {seed: found[column.name] for seed, found in by_seed.items()}
        mark = ""
        for seed, found in values.items():
            if isinstance(found, str) and not mark:
                state = outcomes[seed].state
                mark = NO_VALUE if state == "finished" else state
        cells[row.label, column.name] = over_seeds(values, mark, keys)
    return cells


def _values(table: Table, row: Row, outcome: Outcome, reader: Reader) -> dict[str, Value]:
    counts: dict[Words, Counts | str] = {}
    values: dict[str, Value] = {}
    columns = table.columns_of(row)
    for column in columns:
        if is_counted(column):
            words = words_of(column, table)
            if words not in counts:
                counts[words] = _counts(outcome, words, reader)
            values[column.name] = _value(metric_of(column, row), counts[words], table)
    for column in columns:
        if column.sources:
            values[column.name] = _derived(column, [values[name] for name in column.sources])
    return values


def _counts(outcome: Outcome, words: Words, reader: Reader) -> Counts | str:
    if outcome.state != "finished" or not outcome.results:
        return outcome.reason or outcome.state
    run = outcome.results[0]
    try:
        return outcome.missing.get(words) or reader(run, words)
    except (InputError, OSError) as error:
        return str(error).replace(f"{run.folder}/", "")  # equal reasons of seeds are joined


def _value(metric: str, counts: Counts | str, table: Table) -> Value:
    if isinstance(counts, str):
        return counts
    try:
        score = value(metric, counts, table.absent or counts.absent)
    except InputError as error:
        return str(error)
    return f"'{metric}' has nothing to score" if math.isnan(score) else score


def _derived(column: Column, values: Sequence[Value]) -> Value:
    """Subtract or average the values of `column.sources`; or return why one is missing."""
    known: list[float] = []
    for found in values:
        if isinstance(found, str):
            return found
        known.append(found)
    return statistics.fmean(known) if column.minus is None else known[0] - known[1]


def over_seeds(
    by_seed: Mapping[int, Value], mark: str = "", keys: tuple[str, ...] = ()
) -> TableCell:
    """Return mean and spread of the values of seeds; for `mark` and `keys` see `TableCell`."""
    values: list[float] = []
    reasons: dict[str, list[int]] = {}
    for seed, found in by_seed.items():
        if isinstance(found, str):
            reasons.setdefault(found, []).append(seed)
        else:
            values.append(found)
    sentences = []
    for reason, seeds in reasons.items():
        which = f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}: "
        sentences.append(reason if seeds == [FIXED] else f"{which}{reason}")
    return TableCell(
        mean=statistics.fmean(values) if values else math.nan,
        sd=statistics.stdev(values) if len(values) > 1 else math.nan,
        seeds=len(values),
        reason="; ".join(sentences),
        mark=mark,
        keys=keys,
    )


def published(row: Row, column: Column) -> float | None:
    """Return the printed value, or None where there is none or a dash."""
    printed = row.values.get(column.name)
    return None if printed is None else float(printed)


def size_marks(table: Table, sizes: Mapping[CellId, TableCell]) -> dict[CellId, int]:
    """Mark sizes of networks, which are counted and so are exact: 1 best, 2 second best.

    Sizes that are equal as shown share a mark. Where all are equal none has one.
    """
    marks: dict[CellId, int] = {}
    for column in table.columns:
        if column.efficiency is None or column.best == "none":
            continue
        shown: dict[CellId, float] = {}
        for cell_id, cell in sizes.items():
            if cell_id[1] == column.name and not math.isnan(cell.mean):
                shown[cell_id] = round(cell.mean, 2)
        best = sorted(set(shown.values()), reverse=column.best == "highest")[:2]
        if len(best) < 2:
            continue
        for cell_id, size in shown.items():
            if size in best:
                marks[cell_id] = best.index(size) + 1
    return marks
