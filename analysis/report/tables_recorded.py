"""Records of tables in the store, which `sweeps.reproduce` wrote, scored again from counts."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analysis.report.runs import ReportRun
from analysis.report.store import MlflowRun
from rgbt.checks import InputError
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import value
from rgbt.tracking.csv_files import read_csv
from sweeps.table.cells import TableCell, counts_path, derived, is_counted, is_of_runs, metric_of
from sweeps.table.scoring import ScoredTable, score
from sweeps.table.table import Column, Row, Table

CSV_FILE = "table.csv"
HEADER = ("table", "row", "column", "mean", "sd", "n", "published", "difference", "reason", "runs")
"""Columns of `CSV_FILE`, which is one line per row and column."""

EXTRA = re.compile(r"Every row of ours was run with (.*)\.")
SHOWN = ("Bold:", "rho:", "Published:", "Ours:", "scale=demo:")
"""Beginnings of remarks that the page shows by itself: marks, data, seeds and scale."""

AGREES = 1e-4
"""A recorded mean has six digits: a larger difference is another number."""


@dataclass(frozen=True)
class RecordedCell:
    """One cell as it was recorded; None where there was nothing."""

    mean: float | None
    sd: float | None
    seeds: int
    published: float | None
    reason: str
    keys: tuple[str, ...]


NO_CELL = RecordedCell(None, None, 0, None, "", ())


@dataclass(frozen=True, kw_only=True)
class RecordedTable:
    """A table that was run.

    Attributes:
        name: e.g. "spatialseg/table3".
        scale: "demo" or "paper".
        lines: (row, column) -> cell, in the order of the file.
        remarks: sentences that stood below it.
        extra: overrides that were added to every row, as typed.
        orders: column -> rank correlation as MLflow has it.
    """

    name: str
    scale: str
    seeds: tuple[int, ...]
    lines: Mapping[tuple[str, str], RecordedCell]
    remarks: tuple[str, ...] = ()
    extra: str = ""
    orders: Mapping[str, float]

    def rows(self) -> tuple[str, ...]:
        """Labels in order."""
        return tuple(dict.fromkeys(row for row, _ in self.lines))

    def columns(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(dict.fromkeys(column for _, column in self.lines))


def read_recorded(record: MlflowRun) -> RecordedTable:
    """Read the record of a table.

    Raises:
        InputError: its CSV is missing or damaged.
    """
    text = record.files.text(CSV_FILE)
    if text is None:
        raise InputError(
            f"table '{record.name}' has no {CSV_FILE} in the store; rerun its command."
        )
    markdown = (record.files.text("table.md") or "").splitlines()
    listed = [line[2:] for line in markdown if line.startswith("- ")]
    below = [line for line in listed if not line.startswith(SHOWN)]
    extra = [found.group(1) for line in below if (found := EXTRA.fullmatch(line))]
    return RecordedTable(
        name=record.tags.get("rgbt.table", record.name),
        scale=record.tags.get("rgbt.scale", ""),
        seeds=tuple(int(seed) for seed in re.findall(r"\d+", record.tags.get("rgbt.seeds", ""))),
        lines=_lines(text, record.name),
        remarks=tuple(below),
        extra=extra[0] if extra else "",
        orders={n.removeprefix("order/"): v for n, v in record.metrics.items() if "order/" in n},
    )


def _lines(text: str, name: str) -> dict[tuple[str, str], RecordedCell]:
    header, lines = read_csv(text)
    missing = [column for column in HEADER if column not in header]
    if missing:
        raise InputError(
            f"table '{name}': its {CSV_FILE} lacks the column '{missing[0]}'; rerun its command."
        )
    try:
        return {
            (line["row"], line["column"]): RecordedCell(
                mean=float(line["mean"]) if line["mean"] else None,
                sd=float(line["sd"]) if line["sd"] else None,
                seeds=int(line["n"] or 0),
                published=float(line["published"]) if line["published"] else None,
                reason=line["reason"],
                keys=tuple(line["runs"].split()),
            )
            for line in lines
        }
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"table '{name}': its {CSV_FILE} is damaged ({error}).") from error


def reproduce_command(name: str, seeds: Sequence[int], scale: str, extra: str = "") -> str:
    """The command that runs what is missing of a table.

    Args:
        name: of the table.
        seeds: 0, 1, 2 is "3"; a single other one needs brackets.
        scale: "demo" or "paper".
        extra: overrides of every row, as typed.
    """
    if tuple(seeds) == tuple(range(len(seeds))):
        text = str(len(seeds))
    else:
        listed = ",".join(map(str, seeds))
        text = listed if len(seeds) > 1 else f"[{listed}]"
    words = [f"table={name}", f"seeds={text}", f"scale={scale}"]
    return shlex.join(["rgbt", "reproduce", *words]) + (f" {extra}" if extra else "")


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
class _Outcome:
    """The outcome of a cell's run, as `sweeps.table.scoring` reads it."""

    state: str
    reason: str = ""
    results: tuple[ReportRun, ...] = ()


@dataclass(frozen=True)
class RescoredTable:
    """A recorded table with its file, scored from the counts of the runs that the record names."""

    recorded: RecordedTable
    scored: ScoredTable
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
    """Means, ranks and orders from the counts of the runs that the record names."""
    labels = {row.label for row in table.rows}
    outcomes: dict[tuple[str, int], _Outcome] = {}
    for label in recorded.rows():
        lines = [line for (row, _), line in recorded.lines.items() if row == label]
        keys = tuple(dict.fromkeys(key for line in lines for key in line.keys))
        if keys and label in labels:
            found = _by_seed(keys, recorded.seeds, runs)
            outcomes |= {(label, seed): outcome for seed, outcome in found.items()}
    # Columns of efficiency as recorded: a network is not known here.
    names = {column.name for column in table.columns if column.efficiency is not None}
    sizes = {
        place: TableCell(math.nan if line.mean is None else line.mean, math.nan, 0, line.reason)
        for place, line in recorded.lines.items()
        if place[0] in labels and place[1] in names and (line.mean is not None or line.reason)
    }
    scored = score(recorded.name, table, outcomes, scale=recorded.scale, sizes=sizes)
    return RescoredTable(recorded, scored, runs)


def _by_seed(
    keys: Sequence[str], seeds: Sequence[int], runs: Mapping[str, ReportRun]
) -> dict[int, _Outcome]:
    """The outcome of every seed of a row; a seed without a run here has an empty outcome."""
    outcomes = {seed: _Outcome("failed", "not finished") for seed in seeds}
    here = {seed: key for key in keys if key in runs and (seed := runs[key].entry.seed) is not None}
    outcomes |= {seed: _Outcome("finished", results=(runs[key],)) for seed, key in here.items()}
    rest = [seed for seed in seeds if seed not in here]
    gone = [key for key in keys if key not in runs]
    for seed, key in zip(rest, gone, strict=False):
        outcomes[seed] = _Outcome("missing", f"run {key} is not in the store")
    return outcomes
