"""Finished runs as rows of tables: which tables were run and how, and what their runs show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import get_args

from rgbt.checks import InputError
from rgbt.runs.result import RunResult
from rgbt.runs.run_spec import RunSpec
from sweeps.point import Outcome, Point
from sweeps.table.cells import ScoredTable, score, size_marks
from sweeps.table.efficiency import network_sizes
from sweeps.table.request import DEFAULT_SCALE, TAG, TableRequest
from sweeps.table.table import RELEASED, Form, Table, load_table, study_names, table_names
from sweeps.verdicts.effects import Effects, effects_of
from sweeps.verdicts.judge import (
    RESAMPLES,
    CellRunId,
    JudgedClaim,
    StoredRuns,
    TableJudge,
    rule_of,
)
from sweeps.worker.planner import Planner

SEED, EXPERIMENT = "rgbt.seed", "rgbt.experiment"


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
            except (InputError, KeyError, ValueError, TypeError) as error:
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
    """What the finished runs of a table show."""

    request: TableRequest
    runs: Mapping[CellRunId, Outcome]
    judge: TableJudge

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


@dataclass(frozen=True, order=True)
class Variant:
    """How a table was run; `extra` are overrides of every row."""

    scale: str = DEFAULT_SCALE
    form: Form = "paper"
    extra: tuple[str, ...] = ()


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

    def variants(self) -> dict[str, list[Variant]]:
        """Name of every table that runs are tagged with -> how it was run."""
        found: dict[str, set[Variant]] = {}
        for run in self.finished:
            tagged = {
                tag.removeprefix(TAG): labels.split(" | ")
                for tag, labels in run.tags.items()
                if tag.startswith(TAG) and tag.removeprefix(TAG) in self.tables
            }
            words = [each for each in run.description.overrides if not each.startswith("seed=")]
            scales = [each.removeprefix("scale=") for each in words if each.startswith("scale=")]
            scale = scales[-1] if scales else DEFAULT_SCALE
            # Tables share runs: the rows of one of them tell what else was typed.
            fitting = [
                each for pair in tagged.items() for each in self._fitting(*pair, words, scale)
            ]
            variant = min(fitting, key=lambda each: len(each.extra), default=Variant(scale))
            for name in tagged:
                found.setdefault(name, set()).add(variant)
        return {name: sorted(each) for name, each in sorted(found.items())}

    def _fitting(
        self, name: str, labels: Sequence[str], words: Sequence[str], scale: str
    ) -> Iterator[Variant]:
        """How the command of a run with these words may have requested rows of a table."""
        known = {row.label for row in self.tables[name].rows}
        for label in known & {each.removesuffix(RELEASED) for each in labels}:
            for form in get_args(Form):
                request = TableRequest(name, self.tables[name], scale, (0,), form=form)
                own = request.overrides(label, 0)[:-1]
                if not Counter(own) - Counter(words):
                    yield Variant(scale, form, tuple(each for each in words if each not in own))

    def of(self, name: str, variant: Variant | None = None) -> TableResult:
        """The result of one table; without a variant it has no runs.

        InputError: no row can be composed.
        """
        how = variant or Variant()
        table = self.tables[name]
        request = TableRequest(name, table, how.scale, (0,), how.extra, form=how.form)
        return self.result(request, {} if variant is None else None)

    def result(
        self,
        request: TableRequest,
        runs: Mapping[CellRunId, Outcome] | None = None,
        *,
        checked: bool = False,
    ) -> TableResult:
        """The result of a request by `runs`; None: by all finished ones, see `stored_runs`."""
        if runs is None:
            runs = stored_runs(request, self.finished, self.planner, checked=checked)
        sizes = network_sizes(request) if self.counted else {}
        rule = rule_of(result for run in runs.values() for result in run.results)
        name, table = request.name, request.table
        judge = TableJudge(name, table, rule, self.resamples, sizes, self.stored)
        return TableResult(request, runs, judge)

    def __iter__(self) -> Iterator[TableResult]:
        """Tables with runs in every way that they were run, then those without a run.

        Tables share runs, so a way without further words is tried for each of them.
        """
        variants, waiting = self.variants(), []
        plain = {each for ways in variants.values() for each in ways if not each.extra}
        for name in self.tables:
            found = []
            for variant in sorted({*variants.get(name, ()), *plain}):
                try:
                    result = self.of(name, variant)
                    _ = result.runs and (result.scored, result.claims)  # an error is a remark here
                    found.append(result)
                except InputError as error:
                    self.remarks.append(f"Table '{name}' cannot be scored: {error}")
            found = [result for result in found if result.runs]
            yield from found
            waiting += [] if found else [name]
            if name in variants and not found:
                self.remarks.append(
                    f"No run that is tagged with '{name}' has the key of a row today."
                )
        yield from (self.of(name) for name in waiting)
