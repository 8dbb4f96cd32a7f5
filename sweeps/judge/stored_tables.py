"""Finished runs as rows of tables: which tables were run and how, and what their runs show."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, cast, get_args

from rgbt.checks import InputError, check_choice, one_line
from rgbt.config.compose import available
from rgbt.config.stored_config import check_words
from rgbt.runs.result import RunResult
from rgbt.runs.run_spec import RunSpec
from sweeps.judge.effects import Effects, effects_of
from sweeps.judge.judged_table import (
    RESAMPLES,
    CellRunId,
    JudgedClaim,
    StoredRuns,
    TableJudge,
    rule_of,
)
from sweeps.plan.planner import Planner
from sweeps.plan.request import DEFAULT_SCALE, REQUESTED, TAG, TableRequest
from sweeps.plan.table import RELEASED, Form, Table, load_table, study_names, table_names
from sweeps.point import Outcome, Point
from sweeps.score.cells import ScoredTable, score, size_marks
from sweeps.score.efficiency import network_sizes

SEED, EXPERIMENT = "rgbt.seed", "rgbt.experiment"

# Errors that the tags of a run may raise that somebody has edited.
ODD = (InputError, KeyError, ValueError, TypeError)


class FinishedRuns:
    """Finished runs by seed and key, and the seeds of experiments; one that is odd is a remark."""

    def __init__(self, runs: Iterable[RunResult]) -> None:
        self.by_seed: dict[int, dict[str, RunResult]] = {}
        self.seeds: dict[str, set[int]] = {}
        self.remarks: list[str] = []
        for run in runs:
            try:
                seed, experiment = int(run.tags[SEED]), run.tags[EXPERIMENT]
                self.by_seed.setdefault(seed, {})[run.key] = run
                self.seeds.setdefault(experiment, set()).add(seed)
            except ODD as error:
                self.remarks.append(f"Run {run.key} belongs to no table: {error!r}.")

    def run_of(self, spec: RunSpec) -> RunResult | None:
        """The run of a specification (`RunSpec.is_run`)."""
        return next((run for run in self.by_seed[spec.seed].values() if spec.is_run(run)), None)

    def __iter__(self) -> Iterator[RunResult]:
        return (run for by_key in self.by_seed.values() for run in by_key.values())


def stored_runs(
    request: TableRequest, finished: FinishedRuns, planner: Planner, *, checked: bool = False
) -> dict[CellRunId, Outcome]:
    """The finished runs of every row; rows that cannot be composed have none.

    A row is composed if a finished run is of its experiment, or if its settings are `checked`.
    InputError: no row can be composed.
    """
    runs: dict[CellRunId, Outcome] = {}
    errors, rows = [], request.trained_rows
    for row in rows:
        words = request.overrides(row.label, 0)
        seeds = finished.seeds.get(words[0].removeprefix("+experiment="), set())
        if not checked and not seeds:
            continue
        try:
            spec = planner.specify((*planner.base, *words), checked=checked)
            found = {seed: finished.run_of(spec.with_seed(seed)) for seed in sorted(seeds)}
        except InputError as error:
            errors.append(error)
            continue
        for seed, run in found.items():
            if run is not None:
                runs[row.label, seed] = Outcome(Point(row.label, ()), "finished", results=(run,))
    if errors and len(errors) == len(rows):
        raise errors[0]  # the command is wrong, and not a row
    return runs


@dataclass(frozen=True)
class TableResult:
    """What the finished runs of a table show; `words` were typed for every row, as they tell."""

    request: TableRequest
    runs: Mapping[CellRunId, Outcome]
    judge: TableJudge
    words: tuple[str, ...] = ()

    @cached_property
    def scored(self) -> ScoredTable:
        """Our values, with marks of the best rows."""
        request, judge, runs = self.request, self.judge, self.runs
        reader = judge.stored.counts
        scored = score(
            request.name, request.table, runs, scale=request.scale, sizes=judge.sizes, reader=reader
        )
        marks = judge.marks(scored, runs) | size_marks(request.table, judge.sizes)
        return replace(scored, form=request.form, marks=marks)

    @cached_property
    def claims(self) -> list[JudgedClaim]:
        """The claims of the table, judged."""
        return self.judge.claims(self.runs)

    @cached_property
    def effects(self) -> Effects | None:
        """The effects of the factors of its design; None where it has none."""
        return None if self.request.table.design is None else effects_of(self.judge, self.runs)


class Variant(NamedTuple):
    """How a table was run; `words` were typed for every row."""

    scale: str = DEFAULT_SCALE
    form: Form = "paper"
    words: tuple[str, ...] = ()


def _requested_rows(
    run: RunResult, tables: Collection[str]
) -> Iterator[tuple[str, Variant, str, str]]:
    """Table, variant, label and digest of every row that the tags of a run name; raises `ODD`."""
    for tag, labels in run.tags.items():
        name = tag.removeprefix(TAG)
        if tag == name or name not in tables:
            continue
        form, digest, *words = shlex.split(run.tags.get(REQUESTED + name, "paper ''"))
        check_words(words, f"the tag {REQUESTED}{name}")
        scale = run.settings["scale"]["name"]
        check_choice("form", form, get_args(Form))
        check_choice("scale", scale, available("scale"))
        for label in labels.split(" | "):
            own = label.removesuffix(RELEASED)
            way = form if own == label else "released"
            yield name, Variant(scale, cast(Form, way), tuple(words)), own, digest


def known_tables(remarks: list[str]) -> dict[str, Table]:
    """All tables of the papers, of ours, and of the user; one that is not read is a remark."""
    tables = {}
    for name in dict.fromkeys([*table_names(), *study_names()]):
        try:
            tables[name] = load_table(name)
        except InputError as error:
            remarks.append(f"Table '{name}' is left out: {error}")
    return tables


@dataclass
class TableResults:
    """The results of tables.

    Attributes:
        finished: the runs; a run belongs to every table with a row of its key.
        counted: whether the sizes of networks are counted, which needs torch.
        remarks: what cannot be read or composed, one sentence each.
    """

    finished: FinishedRuns
    planner: Planner
    tables: Mapping[str, Table] = field(default_factory=dict)
    resamples: int = RESAMPLES
    counted: bool = False
    remarks: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stored = StoredRuns()
        self.remarks += self.finished.remarks

    @cached_property
    def requested(self) -> dict[tuple[str, Variant], list[tuple[str, str, RunResult]]]:
        """Table and variant -> label of a row, its digest, and the run that was requested for it.

        The digest is that of the settings of the row alone, when it was requested.
        """
        found: dict[tuple[str, Variant], list[tuple[str, str, RunResult]]] = {}
        for run in self.finished:
            try:
                for name, variant, label, digest in _requested_rows(run, self.tables):
                    found.setdefault((name, variant), []).append((label, digest, run))
            except ODD as error:
                self.remarks.append(f"Run {run.key} belongs to no table: {one_line(error)}.")
        return found

    def of(self, name: str, variant: Variant | None = None) -> TableResult:
        """The result of one table; without a variant it has no runs.

        InputError: no row can be composed.
        """
        how = variant or Variant()
        request = TableRequest(name, self.tables[name], how.scale, (0,), form=how.form)
        if variant is None:
            return self.result(request, {})
        runs = self._by_tags(request, variant) if variant.words else None
        return self.result(request, runs, words=variant.words)

    def _by_tags(self, request: TableRequest, variant: Variant) -> dict[CellRunId, Outcome]:
        """The runs with further words, which are not composed: of rows that are the same today."""
        labels, runs = {row.label for row in request.trained_rows}, dict[CellRunId, Outcome]()
        for label, before, run in self.requested[request.name, variant]:
            digest = self.planner.row_digest(request.overrides(label, 0)) if label in labels else ""
            if digest and digest == before:
                outcome = Outcome(Point(label, ()), "finished", results=(run,))
                runs[label, int(run.tags[SEED])] = outcome
        return runs

    def result(
        self,
        request: TableRequest,
        runs: Mapping[CellRunId, Outcome] | None = None,
        *,
        words: tuple[str, ...] = (),
        checked: bool = False,
    ) -> TableResult:
        """The result of a request by `runs`; None: by all finished ones, see `stored_runs`."""
        if runs is None:
            runs = stored_runs(request, self.finished, self.planner, checked=checked)
        sizes = network_sizes(request) if self.counted and not words else {}
        rule = rule_of(result for run in runs.values() for result in run.results)
        name, table = request.name, request.table
        judge = TableJudge(name, table, rule, self.resamples, sizes, self.stored)
        return TableResult(request, runs, judge, words)

    def __iter__(self) -> Iterator[TableResult]:
        """Tables with runs in every way that they were run, then those without a run.

        Tables share runs, so a way without further words is tried for each of them.
        """
        plain = {variant for _, variant in self.requested if not variant.words}
        waiting = []
        for name in self.tables:
            own = {variant for table, variant in self.requested if table == name}
            found = []
            for variant in sorted(own | plain):
                try:
                    result = self.of(name, variant)
                    _ = result.runs and (result.scored, result.claims)  # an error is a remark here
                    found.append(result)
                except InputError as error:
                    self.remarks.append(f"Table '{name}' cannot be scored: {error}")
            found = [result for result in found if result.runs]
            yield from found
            waiting += [] if found else [name]
            if own and not found:
                self.remarks.append(
                    f"No run that is tagged with '{name}' has the key of a row today."
                )
        yield from (self.of(name) for name in waiting)
