"""Tables that were run: which rows finished runs belong to, by their keys and their tags."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import cast, get_args

from rgbt.checks import InputError, check_choice, one_line
from rgbt.config.compose import DEFAULT_SCALE, available
from rgbt.config.stored_config import check_words
from rgbt.runs.folder import SEED
from rgbt.runs.result import RunResult
from rgbt.terminal import tracked
from sweeps.judge.judged_table import RESAMPLES, JudgedTable, Resamplers
from sweeps.plan.planner import Planner
from sweeps.plan.request import REQUESTED, TAG, RowSeed, TableRequest
from sweeps.plan.table import (
    OWN,
    PUBLISHED,
    RELEASED,
    STUDIES,
    Form,
    Table,
    load_table,
    table_names,
)
from sweeps.point import Outcome, Point
from sweeps.score.efficiency import network_sizes
from sweeps.score.reader import ODD, RunReader

# How a table was run: scale, form, and the words that were typed for every row.
Variant = tuple[str, Form, tuple[str, ...]]

# Table and variant -> label of a row, the digest of the settings of the row alone when it was
# requested, and the run that was requested for it.
Requested = dict[tuple[str, Variant], list[tuple[str, str, RunResult]]]


def runs_of_request(
    request: TableRequest, reader: RunReader, planner: Planner, *, checked: bool = False
) -> dict[RowSeed, Outcome]:
    """Return the finished runs of every row by their keys; rows that cannot be composed have none.

    A row is composed if a finished run is of its experiment and not of another scale, or if its
    settings are `checked`.

    InputError: no row can be composed.
    """
    runs: dict[RowSeed, Outcome] = {}
    errors = []
    for row in request.trained_rows:
        try:
            runs |= _runs_of_row(request, row.label, reader, planner, checked=checked)
        except InputError as error:
            errors.append(error)
    if errors and len(errors) == len(request.trained_rows):
        raise errors[0]  # the command is wrong, and not a row
    return runs


def _runs_of_row(
    request: TableRequest, label: str, reader: RunReader, planner: Planner, *, checked: bool
) -> dict[RowSeed, Outcome]:
    """Find the finished runs of a row; a fold of the images is composed for each seed."""
    experiment = request.overrides(label, 0)[0].removeprefix("+experiment=")
    seeds = reader.seeds(experiment, request.scale)
    runs = {}
    for seed in seeds or ([0] if checked else []):
        words = (*planner.base, *request.overrides(label, seed))
        run = reader.find(planner.specify(words, checked=checked))
        if run is not None:
            runs[label, seed] = _finished(label, run)
    return runs


def known_tables(remarks: list[str]) -> dict[str, Table]:
    """Read all tables of the papers, of ours, and of the user; one that is not read is a remark."""
    tables = {}
    for name in dict.fromkeys(table_names(PUBLISHED, OWN, STUDIES)):
        try:
            tables[name] = load_table(name)
        except InputError as error:
            remarks.append(f"Table '{name}' is left out: {error}")
    return tables


def judged_tables(
    reader: RunReader,
    planner: Planner,
    tables: Mapping[str, Table],
    remarks: list[str],
    *,
    resamples: int = RESAMPLES,
    counted: bool = False,
) -> Iterator[JudgedTable]:
    """Judge tables with runs in every way that they were run, then those without a run.

    A run belongs to every table with a row of its key, so that a way without further words is tried
    for each table. Sizes of networks are counted where `counted`, which needs torch. What was
    requested and cannot be read or composed is added to `remarks`, one sentence each.
    """
    resamplers: Resamplers = {}
    requested = _requested(reader, tables, remarks)
    shared = {variant for _, variant in requested if not variant[2]}
    without_runs = []
    for name, table in tracked(tables.items(), "judging", len(tables)):
        own = {variant for requested_table, variant in requested if requested_table == name}
        is_run = False
        for scale, form, words in sorted(own | shared):
            request = TableRequest(name, table, scale, (0,), words, form=form)
            rows = requested.get((name, (scale, form, words)), [])
            runs: dict[RowSeed, Outcome] = {}
            try:
                runs = _runs_of_variant(request, rows, reader, planner)
                sizes = network_sizes(request) if counted and runs and not words else {}
                judged = JudgedTable(
                    request=request,
                    runs=runs,
                    sizes=sizes,
                    resamples=resamples,
                    reader=reader,
                    resamplers=resamplers,
                )
                _ = judged.scored, judged.claims  # an error is a remark here
            except InputError as error:
                # Without runs and rows, other tables alone were run in this way.
                remark = f"Table '{name}' cannot be scored: {error}"
                remarks += [remark] if runs or rows else []
                continue
            if runs:
                is_run = True
                yield judged
        if is_run:
            continue
        without_runs.append(name)
        if own:
            remarks.append(f"No run that is tagged with '{name}' has the key of a row today.")
    for name in tracked(without_runs, "not run", len(without_runs)):
        request = TableRequest(name, tables[name], DEFAULT_SCALE, (0,))
        sizes = network_sizes(request) if counted else {}
        yield JudgedTable(request=request, sizes=sizes, resamples=resamples, reader=reader)


def _requested(reader: RunReader, tables: Collection[str], remarks: list[str]) -> Requested:
    """What the tags of the runs say that they were requested for."""
    requested: Requested = {}
    for run in reader:
        try:
            for table, variant, label, digest in _requested_rows(run, tables):
                requested.setdefault((table, variant), []).append((label, digest, run))
        except ODD as error:
            remarks.append(f"Run {run.key} belongs to no table: {one_line(error)}.")
    return requested


def _requested_rows(
    run: RunResult, tables: Collection[str]
) -> Iterator[tuple[str, Variant, str, str]]:
    """Table, variant, label and digest of every row that the tags of a run name; raises `ODD`."""
    tags = run.tags
    for tag, labels in tags.items():
        name = tag.removeprefix(TAG)
        if tag == name or name not in tables:
            continue
        form, digest, *words = shlex.split(tags.get(REQUESTED + name, "paper ''"))
        check_words(words, f"the tag {REQUESTED}{name}")
        scale = run.settings["scale"]["name"]
        check_choice("form", form, get_args(Form))
        check_choice("scale", scale, available("scale"))
        for label in labels.split(" | "):
            own = label.removesuffix(RELEASED)
            of_row = form if own == label else "released"
            yield name, (scale, cast(Form, of_row), tuple(words)), own, digest


def _runs_of_variant(
    request: TableRequest,
    rows: list[tuple[str, str, RunResult]],
    reader: RunReader,
    planner: Planner,
) -> dict[RowSeed, Outcome]:
    """The finished runs of a request; by tags, of rows that are the same today, where it has words.

    Stored words are not composed.
    """
    if not request.extra:
        return runs_of_request(request, reader, planner)
    alone = replace(request, extra=())
    labels = {row.label for row in request.trained_rows}
    runs = {}
    for label, before, run in rows:
        digest = planner.row_digest(alone.overrides(label, 0)) if label in labels else ""
        if digest and digest == before:
            runs[label, int(run.tags[SEED])] = _finished(label, run)
    return runs


def _finished(label: str, run: RunResult) -> Outcome:
    return Outcome(Point(label, ()), "finished", results=(run,))
