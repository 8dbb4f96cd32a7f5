"""Finished runs as rows of tables: which tables were run and how, and what their runs show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

from rgbt.checks import InputError
from rgbt.runs.result import RunResult
from rgbt.tables import TextTable
from sweeps.point import Outcome, Point
from sweeps.table.cells import ScoredTable, TableCell, score, size_marks
from sweeps.table.efficiency import exact_sizes
from sweeps.table.load_table import load_table, study_names, table_names
from sweeps.table.request import DEFAULT_SCALE, TAG, TableRequest
from sweeps.table.table import Form, Table
from sweeps.verdicts.effects import DesignEffects, DesignJudge, judged_claims
from sweeps.verdicts.forms import RELEASED, forms_grid
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
    """Finished runs by seed and key, and their experiments; one that is odd is a remark."""

    def __init__(self, runs: Iterable[RunResult]) -> None:
        self.by_seed: dict[int, dict[str, RunResult]] = {}
        self.experiments: set[str] = set()
        self.remarks: list[str] = []
        for run in runs:
            try:
                tags = run.tags
                self.by_seed.setdefault(int(tags[SEED]), {})[run.key] = run
                self.experiments.add(tags[EXPERIMENT])
            except (InputError, KeyError, ValueError, TypeError) as error:
                self.remarks.append(f"Run {run.key} belongs to no table: {error!r}.")

    def __iter__(self) -> Iterator[RunResult]:
        return (run for by_key in self.by_seed.values() for run in by_key.values())


def stored_runs(
    request: TableRequest, finished: FinishedRuns, planner: Planner, *, checked: bool = False
) -> dict[CellRunId, Outcome]:
    """The finished runs of every row; rows that cannot be composed have none.

    A row is composed if a finished run is of its experiment, or if its settings are `checked`.

    Raises:
        InputError: no row can be composed.
    """
    runs: dict[CellRunId, Outcome] = {}
    errors, rows = [], request.trained_rows
    for row in rows:
        words = request.overrides(row.label, 0)
        if not checked and words[0].removeprefix("+experiment=") not in finished.experiments:
            continue
        try:
            spec = planner.specify((*planner.base, *words), checked=checked)
            keys = {seed: spec.with_seed(seed).key for seed in finished.by_seed}
        except InputError as error:
            errors.append(error)
            continue
        for seed, key in sorted(keys.items()):
            if run := finished.by_seed[seed].get(key):
                runs[row.label, seed] = Outcome(Point(row.label, ()), "finished", results=(run,))
    if errors and len(errors) == len(rows):
        raise errors[0]  # of the command, and not of a row
    return runs


@dataclass(frozen=True, kw_only=True)
class TableResult:
    """What the finished runs of a table show.

    Attributes:
        claims: judged.
        forms: differences of the forms as text; None where one form was run.
        effects: of the factors of its design; None where it has none.
    """

    request: TableRequest
    runs: Mapping[CellRunId, Outcome]
    scored: ScoredTable
    claims: Sequence[JudgedClaim] = ()
    forms: TextTable | None = None
    effects: DesignEffects | None = None

    @classmethod
    def of(
        cls,
        request: TableRequest,
        runs: Mapping[CellRunId, Outcome],
        judge: TableJudge,
        sizes: Mapping[tuple[str, str], TableCell],
    ) -> TableResult:
        """Score a table and judge it; `sizes` are cells of efficiency."""
        table = request.table
        scored = score(
            request.name, table, runs, scale=request.scale, sizes=sizes, reader=judge.stored.counts
        )
        marks = judge.marks(scored, runs) | size_marks(table, sizes)
        design = DesignJudge(table, judge.resamples, judge.rule, judge.stored)
        return cls(
            request=request,
            runs=runs,
            scored=replace(scored, form=request.form, marks=marks),
            claims=judged_claims(judge, runs),
            forms=forms_grid(judge, runs),
            effects=None if table.design is None else design.effects(runs),
        )


@dataclass(frozen=True, order=True)
class Variant:
    """How a table was run; `extra` are overrides of every row."""

    scale: str = DEFAULT_SCALE
    form: Form = "paper"
    extra: tuple[str, ...] = ()


@dataclass
class TableResults:
    """The results of all tables of the papers, of ours, and of the user.

    Attributes:
        finished: the runs; a run belongs to every table with a row of its key.
        planner: composes the rows.
        resamples: of the images.
        counted: whether the sizes of networks are counted, which needs torch.
        remarks: what cannot be read or composed, one sentence each.
    """

    finished: FinishedRuns
    planner: Planner
    own: Path
    resamples: int = RESAMPLES
    counted: bool = False
    remarks: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.tables: dict[str, Table] = {}
        self.stored = StoredRuns()
        self.remarks += self.finished.remarks
        for name in dict.fromkeys([*table_names(self.own), *study_names()]):
            try:
                self.tables[name] = load_table(name, self.own)
            except InputError as error:
                self.remarks.append(f"Table '{name}' is left out: {error}")

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
            # Tables share runs: of one of them the row says what was typed beside its words.
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

        Raises:
            InputError: no row can be composed.
        """
        chosen = variant or Variant()
        request = TableRequest(
            name, self.tables[name], chosen.scale, (0,), chosen.extra, form=chosen.form
        )
        runs = stored_runs(request, self.finished, self.planner) if variant else {}
        sizes = exact_sizes(request) if self.counted else {}
        judge = TableJudge(
            name,
            request.table,
            rule_of(result for run in runs.values() for result in run.results),
            self.resamples,
            sizes,
            self.stored,
        )
        return TableResult.of(request, runs, judge, sizes)

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
                    found.append(self.of(name, variant))
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
