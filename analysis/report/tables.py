"""Every table beside its paper: our cells from counts with intervals, and tables without runs."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

from analysis.report.claims import claim_entries, forms_entry, judge_of, seeds_were_added
from analysis.report.data import CellEntry, TableEntry, Uncertainty
from analysis.report.runs import ReportRun
from analysis.report.store import MlflowRun, read_each
from analysis.report.tables_recorded import (
    NO_CELL,
    RecordedCell,
    RecordedTable,
    read_recorded,
    reproduce_command,
)
from analysis.report.tables_rescored import CountsSource, RescoredTable, score_again
from analysis.uncertainty import Interval, Resampling, compare, estimate
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from sweeps.table.cells import published
from sweeps.table.load_table import load_table, study_names, table_names
from sweeps.table.request import DEFAULT_SCALE
from sweeps.table.table import Column, Form, Row, Table
from sweeps.verdicts.judge import TableJudge

Track = Callable[[Sequence[Any], str], Iterable[Any]]
"""Goes over a sequence and shows how far it is: (sequence, what is done)."""

DEFAULT_SEEDS = (0, 1, 2)
"""Of a table without runs."""

NOT_HERE = "counts of some runs are not in the store; the value is as recorded, without interval."


@dataclass(frozen=True)
class CellInterval:
    """An interval, and what it is over; without one, why there is none."""

    interval: Interval | None
    covers: Uncertainty
    reason: str = ""


Intervals = Mapping[tuple[CountsSource, str], CellInterval]
"""Intervals by source and metric."""


def table_entries(
    records: Sequence[MlflowRun],
    runs: Mapping[str, ReportRun],
    resamples: int,
    track: Track,
    remarks: list[str],
) -> tuple[TableEntry, ...]:
    """All tables: those with runs first, then the published ones without runs.

    Args:
        records: runs of MLflow of the kind "table".
        runs: opened runs by key.
        resamples: of the images, for intervals.
        track: shows how far it is.
        remarks: gets a sentence for everything that cannot be read or does not agree.
    """
    files: dict[str, Table] = {}
    studies = study_names()
    for name in track(list(dict.fromkeys([*table_names(), *studies])), "tables"):
        try:
            files[name] = load_table(name)
        except InputError as error:
            remarks.append(f"Table '{name}' is omitted: {error}")
    recorded = read_each(records, read_recorded, remarks)
    recorded.sort(key=lambda each: (each.name, each.scale, each.form, each.extra))
    drafts = [score_again(each, files.get(each.name) or _file_of(each), runs) for each in recorded]
    wanted = (
        draft.interval_key(row, column)
        for draft in drafts
        for row in draft.scored.table.rows
        for column in draft.scored.table.columns
    )
    intervals = find_intervals(filter(None, wanted), runs, resamples, track)
    made = [_judged(draft, intervals, resamples, remarks) for draft in track(drafts, "claims")]
    known = {each.name for each in recorded}
    for each in recorded:
        if each.name not in files:
            remarks.append(f"Table '{each.name}' has no file any more; it is shown as recorded.")
    known |= set(studies)  # shown only where they were run
    return (*made, *(_waiting(name, files[name]) for name in files if name not in known))


def find_intervals(
    wanted: Iterable[tuple[CountsSource, str]],
    runs: Mapping[str, ReportRun],
    resamples: int,
    track: Track,
) -> dict[tuple[CountsSource, str], CellInterval]:
    """Intervals of scores: every set of runs is resampled once, for all of its metrics.

    Args:
        wanted: sources, and metrics of them.
        runs: opened runs by key.
        resamples: of the images.
        track: shows how far it is.
    """
    metrics_of: dict[CountsSource, dict[str, None]] = {}
    for source, metric in wanted:
        metrics_of.setdefault(source, {})[metric] = None
    found: dict[tuple[CountsSource, str], CellInterval] = {}
    for source in track(list(metrics_of), "intervals"):
        metrics = tuple(metrics_of[source])
        settings = Resampling(resamples=resamples, absent=source.absent)
        try:
            counts = [[runs[key].counts(path) for key in source.keys] for path in source.paths]
            intervals = _resampled(counts, metrics, settings)
        except InputError as error:
            intervals = dict.fromkeys(metrics, CellInterval(None, "none", str(error)))
        found |= {(source, metric): each for metric, each in intervals.items()}
    return found


def _resampled(
    counts: Sequence[Sequence[Counts]], metrics: Sequence[str], settings: Resampling
) -> dict[str, CellInterval]:
    """Intervals of scores, or of the difference of two evaluations of the same runs."""
    if len(counts) == 1:
        estimates = estimate(counts[0], metrics, settings)
        parts = [(name, each.images, each.both, each.said) for name, each in estimates.items()]
    else:
        first, second = counts
        compared = compare(second, first, metrics, settings, paired=True)
        parts = [
            (each.metric, each.difference.images, each.difference.both, compared.said)
            for each in compared.differences
        ]
    found = {}
    for metric, images, both, said in parts:
        if both is not None:
            found[metric] = CellInterval(both, "images and seeds")
        elif images is not None:
            found[metric] = CellInterval(images, "images")
        else:
            found[metric] = CellInterval(None, "none", f"no interval: {said} are too few.")
    return found


def cell_of(draft: RescoredTable, row: Row, column: Column, intervals: Intervals) -> CellEntry:
    """One cell of a table that was run."""
    scored, place = draft.scored, (row.label, column.name)
    plain = replace(_printed(row, column), values=draft.values(row, column))
    line, cell = draft.line(row, column), scored.cells.get(place)
    if cell is None or cell.seeds < line.seeds:
        return _as_recorded(plain, line)
    mean = None if math.isnan(cell.mean) else cell.mean
    entry = replace(
        plain,
        mean=mean,
        sd=None if math.isnan(cell.sd) else cell.sd,
        seeds=cell.seeds,
        difference=_difference(mean, plain.published),
        reason=line.reason or cell.reason or plain.reason,
        runs=line.keys,
        rank=scored.marks.get(place, 0),
    )
    key = draft.interval_key(row, column)
    found = None if key is None else intervals.get(key)
    if found is None:
        return entry
    if found.interval is None:
        return replace(entry, reason=entry.reason or found.reason)
    low, high = found.interval.low, found.interval.high
    return replace(entry, low=low, high=high, covers=found.covers)


def _printed(row: Row, column: Column) -> CellEntry:
    """What is known of a cell without any run."""
    reason = "shown as published only" if row.experiment is None else ""
    return CellEntry(published=published(row, column), reason=reason)


def _as_recorded(plain: CellEntry, line: RecordedCell) -> CellEntry:
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


def _judged(
    draft: RescoredTable, intervals: Intervals, resamples: int, remarks: list[str]
) -> TableEntry:
    """A table that was run, with marks and with the verdicts of its claims."""
    judge = judge_of(draft, resamples)
    marked = replace(draft.scored, marks=judge.marks(draft.outcomes))
    entry = _entry(replace(draft, scored=marked), intervals, remarks)
    return replace(
        entry,
        claims=claim_entries(judge, draft.outcomes),
        forms=forms_entry(judge, draft.outcomes),
    )


def _entry(draft: RescoredTable, intervals: Intervals, remarks: list[str]) -> TableEntry:
    recorded, scored = draft.recorded, draft.scored
    table = scored.table
    gone = [label for label in recorded.rows() if label not in {row.label for row in table.rows}]
    if gone:
        remarks.append(
            f"Table '{recorded.name}': row '{gone[0]}' was run but is no longer in its file."
        )
    remarks += draft.changed()
    return _laid_out(
        recorded.name,
        table,
        lambda row, column: cell_of(draft, row, column, intervals),
        scale=recorded.scale,
        notes=tuple(dict.fromkeys((*_notes(table), *_form_notes(draft), *recorded.remarks))),
        command=_command(draft),
        extra=_words(draft),
        form=recorded.form,
    )


def _notes(table: Table) -> tuple[str, ...]:
    """What the file says beside its values, one sentence each."""
    columns = [f"{each.name}: not in the paper." for each in table.columns if not each.printed]
    rows = [f"{row.label}: {remark}" for row in table.rows for remark in row.remarks]
    return (*table.remarks, *columns, *rows)


def _form_notes(draft: RescoredTable) -> Iterable[str]:
    """What the rows of the shown form are run as, as far as the file says it."""
    forms: tuple[Form, ...] = get_args(Form)
    shown = forms if draft.recorded.form == "both" else (draft.scored.form,)
    sentences = draft.scored.table.forms
    return (sentences[form] for form in shown if form in sentences)


def _words(draft: RescoredTable) -> str:
    """Further words of the command as typed: the selected rows, and overrides of every row."""
    recorded, table = draft.recorded, draft.scored.table
    labels = recorded.rows()
    is_selected = recorded.form != "both" and set(labels) < {row.label for row in table.rows}
    rows = shlex.quote(f"rows={','.join(labels)}") if is_selected else ""
    return " ".join(filter(None, (rows, recorded.extra)))


def _command(draft: RescoredTable) -> str:
    recorded = draft.recorded
    return reproduce_command(
        recorded.name,
        recorded.seeds or DEFAULT_SEEDS,
        recorded.scale or DEFAULT_SCALE,
        _words(draft),
        form=recorded.form,
        until_decided=seeds_were_added(draft),
    )


def _waiting(name: str, table: Table) -> TableEntry:
    """A table without runs."""
    return _laid_out(
        name,
        table,
        _printed,
        scale="",
        claims=claim_entries(TableJudge(name, table)),
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


def _file_of(recorded: RecordedTable) -> Table:
    """What is known of a table whose file is gone: it is shown as recorded, without intervals."""
    rows, columns = recorded.rows(), recorded.columns()
    printed = {
        row: {name: recorded.lines.get((row, name), NO_CELL).published for name in columns}
        for row in rows
    }
    return Table(
        paper=recorded.name.rpartition("/")[0],
        number=recorded.name,
        caption="",
        data="",
        # As recorded, like the sizes of networks: how the values were made is not known.
        columns=tuple(Column(name=name, best="none", efficiency="parameters") for name in columns),
        rows=tuple(Row(label=row, experiment="", values=printed[row]) for row in rows),
        remarks=("Its file is gone: values as recorded, without intervals.",),
    )
