"""Judges the claims of a table by its finished runs, and marks the rows that are shown to be best.

A claim is made of contrasts of rows, or of effects of a design. Each is a weighted sum of scores,
formed for every seed that all its rows have, because the runs of one seed share their initial
weights and the order of their data.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from statistics import fmean
from typing import NamedTuple

from analysis.uncertainty import Interval, Resampling
from analysis.uncertainty.contrasts import Evidence, Resampler, Term
from analysis.uncertainty.verdicts import Rule, Verdict, decide
from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.runs.result import RunResult
from sweeps.evaluation import Words, counts_of, stored_at
from sweeps.point import Outcome
from sweeps.table.cells import (
    CellId,
    ScoredTable,
    TableCell,
    is_counted,
    metric_of,
    words_of,
    world_words,
)
from sweeps.table.claim import HIGHER, LOWER, Claim
from sweeps.table.design import sign_of
from sweeps.table.request import UNTIL_DECIDED
from sweeps.table.table import Column, Row, Table

# Resamples of the images: enough to know a standard error to 2 %.
RESAMPLES = 2_000

# (label of the row, seed); the seed of a row that was not trained here is `FIXED`.
CellRunId = tuple[str, int]


@dataclass(frozen=True)
class Basis:
    """What a verdict is about, beside its numbers.

    Attributes:
        images: "synthetic", "real" or "unknown".
        scale: of the runs.
        starts: number of different initial weights of the runs.
        warnings: rows of different lists; rows of one seed that were trained on different machines.
    """

    images: str
    scale: str
    starts: int
    warnings: tuple[str, ...] = ()


class StoredRuns:
    """Counts and settings of finished runs, each file read once."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, Words], Counts] = {}
        self._settings: dict[str, tuple[str, str, str, str, str]] = {}

    def counts(self, run: RunResult, words: Words) -> Counts:
        """Counts of a measurement of a run; InputError where they are missing or damaged."""
        if (run.key, words) not in self._counts:
            try:
                self._counts[run.key, words] = counts_of(run, words)
            except OSError as error:
                raise InputError(f"run {run.key}: {error}") from error
        return self._counts[run.key, words]

    def has(self, run: RunResult, words: Words) -> bool:
        """Whether a run has the counts of a measurement."""
        return (run.key, words) in self._counts or stored_at(run, words) is not None

    def basis(self, rows: Mapping[str, Mapping[int, RunResult]]) -> Basis:
        """What the runs of rows, by seed, are about; of several kinds of runs, all kinds."""
        each = []
        lists: dict[str, dict[str, None]] = {}
        machines: dict[int, set[str]] = {}
        for label, runs in rows.items():
            for seed, run in runs.items():
                if run.key not in self._settings:
                    self._settings[run.key] = _settings_of(run)
                *settings, run_lists, machine = self._settings[run.key]
                each.append(settings)
                lists.setdefault(run_lists, {})[label] = None
                machines.setdefault(seed, set()).add(machine)
        images, scales, starts = (sorted(set(values)) for values in zip(*each, strict=True))
        mixed = [str(seed) for seed, found in machines.items() if len(found - {""}) > 1]
        rows_of = "; ".join(f"{', '.join(labels)} {name}" for name, labels in lists.items() if name)
        warnings = (
            f"Different lists: {rows_of}." * (len(lists.keys() - {""}) > 1),
            f"Seeds {', '.join(mixed)} mix machines, which train differently." * bool(mixed),
        )
        shown = tuple(filter(None, warnings))
        return Basis(" and ".join(images), " and ".join(scales), len(starts), shown)


def _settings_of(run: RunResult) -> tuple[str, str, str, str, str]:
    """Kind of images, scale, initial weights, lists and machine of a run."""
    if not (run.folder / "config.yaml").is_file():
        return "unknown", "unknown", run.key, run.lists, run.machine
    settings = run.settings
    seed, scale = str(settings["seed"]), str(settings["scale"]["name"])
    images = "synthetic" if ".synth" in str(settings["dataset"]["_target_"]) else "real"
    start = str(settings.get("pretrained") or settings["model"].get("weights") or "")
    is_common = start.startswith("common:") and settings["seeds"]["start"] == "common"
    is_file = bool(start) and not start.startswith(("common:", "experiment:"))
    return images, scale, "0" if is_common or is_file else seed, run.lists, run.machine


class SameRunsError(InputError):
    """Rows that are compared are the same scores of the same runs."""


class Cell(NamedTuple):
    """A score in a weighted sum: of a row in a column, tested in a `world` of its design or ""."""

    weight: float
    row: str
    column: str
    world: str = ""


class Contrast(NamedTuple):
    """A weighted sum of cells, and how it is shown: "Ny/4 - CRM baseline, Var"."""

    label: str
    cells: tuple[Cell, ...]

    @property
    def rows(self) -> set[str]:
        """Labels of its rows."""
        return {cell.row for cell in self.cells}

    def of_values(self, values: Mapping[CellId, float]) -> float | None:
        """The contrast of exact values of its cells; None where one is missing."""
        ids = [(cell.row, cell.column) for cell in self.cells]
        if not {*ids} <= values.keys():
            return None
        return sum(cell.weight * values[each] for cell, each in zip(self.cells, ids, strict=True))


def printed_values(table: Table) -> dict[CellId, float]:
    """The printed value of every row and column that has one."""
    values = ((row.label, *each) for row in table.rows for each in row.values.items())
    return {(label, name): float(value) for label, name, value in values if value is not None}


def contrasts_of(claim: Claim, table: Table) -> list[Contrast]:
    """The contrasts that a claim is made of, column by column; [] of one about a design."""
    labels = [row.label for row in table.rows if row.experiment is not None or row.values]
    pairs = list(claim.pairs(labels))
    return [
        difference(row, other, column, claim.minus_column)
        for column in (() if claim.effect else claim.columns)
        for row, other in pairs
    ]


def difference(row: str, other: str | None, column: str, minus: str | None = None) -> Contrast:
    """A row less another (None: the row itself) in a column, less that in the column `minus`."""
    columns = [(1.0, column), *([] if minus is None else [(-1.0, minus)])]
    rows = [(1.0, row), *([] if other is None else [(-1.0, other)])]
    cells = tuple(Cell(x * y, label, name) for x, name in columns for y, label in rows)
    names = " - ".join(name for _, name in columns)
    return Contrast(f"{' - '.join(label for _, label in rows)}, {names}", cells)


def base_scores(table: Table, row: Row, name: str) -> Iterator[tuple[float, Column]]:
    """The scores that a column is computed from, with weights; KeyError: the row has no such."""
    columns = {column.name: column for column in table.columns_of(row)}
    column = columns[name]
    if not column.sources:
        yield 1.0, column
        return
    weights = [1.0, -1.0] if column.minus else [1 / len(column.sources)] * len(column.sources)
    for weight, source in zip(weights, column.sources, strict=True):
        for inner, base in base_scores(table, row, source):
            yield weight * inner, base


def as_claimed(claim: Claim, contrasts: Sequence[float | None]) -> bool | None:
    """Whether exact values of its contrasts agree with a claim; None where some are missing."""
    values = [value for value in contrasts if value is not None]
    if not values or len(values) < len(contrasts):
        return None
    low, high = claim.range
    if claim.combine == "mean":
        return low < fmean(values) < high
    inside = sum(low < value < high for value in values)
    least = {"all": len(values), "most": len(values) // 2 + 1, "any": 1}[claim.combine]
    return inside >= least


@dataclass(frozen=True, kw_only=True)
class JudgedClaim:
    """A claim with its verdict.

    Attributes:
        table: its name, e.g. "spatialseg/table3".
        verdict: None where no contrast could be computed.
        contrast: the one whose numbers the verdict shows; of a mean, the claim itself.
        printed: the same contrast of the printed values; None where one is missing.
        as_printed: whether the printed values agree with the claim; None: some are missing.
        missing: labels of rows without a finished run, in the order of the table.
        complete: whether every contrast of it could be computed.
        reason: why there is no verdict, or why it is undecided; one sentence, or "".
        basis: of its runs; None without any.
    """

    table: str
    claim: Claim
    contrast: str
    printed: float | None = None
    as_printed: bool | None = None
    verdict: Verdict | None = None
    missing: tuple[str, ...] = ()
    complete: bool = False
    reason: str = ""
    basis: Basis | None = None

    @property
    def word(self) -> str:
        """The kind of the verdict: "holds", "contradicted", "undecided"; or "not run"."""
        return "not run" if self.verdict is None else self.verdict.kind


@dataclass
class TableJudge:
    """Judges claims of one table; keeps counts and resampled scores between calls.

    `rule` says when a claim is decided; `sizes` are cells that are counted without a run.
    """

    name: str
    table: Table
    rule: Rule = field(default_factory=Rule)
    resamples: int = RESAMPLES
    sizes: Mapping[CellId, TableCell] = field(default_factory=dict)
    stored: StoredRuns = field(default_factory=StoredRuns)

    def __post_init__(self) -> None:
        self._rows = {row.label: row for row in self.table.rows}
        self._printed = printed_values(self.table)
        sizes = {each: cell.mean for each, cell in self.sizes.items()}
        self._exact = {each: size for each, size in sizes.items() if not math.isnan(size)}
        settings = Resampling(resamples=self.resamples, absent=self.table.absent)
        self.images = Resampler(settings)
        # Worlds of a design: generated scenes are independent, and each world has its own labels.
        self.worlds = Resampler(replace(settings, blocks="none"), "names")

    def claims(self, runs: Mapping[CellRunId, Outcome]) -> list[JudgedClaim]:
        """Every claim of the table, judged by the finished ones of `runs`."""
        return [self.judge(claim, runs) for claim in self.table.claims]

    def judge(self, claim: Claim, runs: Mapping[CellRunId, Outcome]) -> JudgedClaim:
        """One claim; a contrast without scores leaves a claim about all of them undecided."""
        contrasts = contrasts_of(claim, self.table) or self._effects(claim)
        printed = [each.of_values(self._printed) for each in contrasts]
        rows = {label for each in contrasts for label in each.rows}
        finished = {label: finished_runs_of(label, runs) for label in self._rows if label in rows}
        judged = partial(
            JudgedClaim,
            table=self.name,
            claim=claim,
            as_printed=as_claimed(claim, printed),
            missing=tuple(label for label, each in finished.items() if not each),
        )
        exact = [each.of_values(self._exact) for each in contrasts]
        if (is_so := as_claimed(claim, exact)) is not None:
            verdict = _exact_verdict(exact[0] or 0.0, is_so=is_so)
            label = contrasts[0].label
            return judged(contrast=label, printed=printed[0], verdict=verdict, complete=True)

        mean = claim.combine == "mean"
        groups = [contrasts] if mean else [[each] for each in contrasts]
        evidences: dict[int, Evidence] = {}
        reasons: list[str] = []
        for index, group in enumerate(groups):
            try:
                terms = [term for each in group for term in self.terms(each.cells, runs)]
                scaled = [replace(each, weight=each.weight / len(group)) for each in terms]
                engine = self.worlds if claim.effect else self.images
                evidences[index] = engine.evidence(scaled)
            except InputError as error:
                reasons.append(str(error))
        if not evidences:
            shown = _mean(printed) if mean else printed[0]
            return judged(contrast=contrasts[0].label, printed=shown, reason=reasons[0])
        basis = self.stored.basis(finished)
        verdict = decide(
            list(evidences.values()),
            claim.range,
            self.rule,
            claim.combine,
            starts=basis.starts,
            missing=f"Some rows have no score: {reasons[0]}" if reasons else "",
        )
        index = list(evidences)[verdict.decisive]
        return judged(
            contrast=f"mean of {len(contrasts)} contrasts" if mean else contrasts[index].label,
            printed=_mean(printed) if mean else printed[index],
            verdict=verdict,
            complete=not reasons,
            reason=verdict.reason,
            basis=basis,
        )

    def _effects(self, claim: Claim) -> list[Contrast]:
        """An effect on each method and outcome, in worlds that it is tested or trained in."""
        design = self.table.design
        assert design is not None, "a claim about an effect is about a design"
        part = claim.part or next(iter(design.parts))
        signs = [sign_of(levels, claim.effect) for levels in design.cells(part)]
        found = []
        for method, outcome in product(claim.rows, claim.columns):
            cells = tuple(
                Cell(2 * sign / len(signs), row, outcome, world)
                for sign, (row, world) in zip(signs, design.places(part, method), strict=True)
            )
            label = f"{method}, {outcome}: {claim.effect}+ - {claim.effect}- ({part})"
            found.append(Contrast(label, cells))
        return found

    def terms(self, cells: Sequence[Cell], runs: Mapping[CellRunId, Outcome]) -> list[Term]:
        """The scores of counts, by seed, that a weighted sum of cells is made of.

        InputError: a row has no finished run or not the score, or the rows are the same runs.
        """
        found = [term for cell in cells for term in self._terms(cell, runs)]
        sums: dict[tuple[str, ...], float] = {}
        for term in found:
            source = (term.metric, *term.keys.values())
            sums[source] = sums.get(source, 0.0) + term.weight
        if not any(sums.values()):
            rows = " and ".join(dict.fromkeys(f"'{cell.row}'" for cell in cells))
            raise SameRunsError(f"rows {rows} are the same runs at this scale.")
        return found

    def _terms(self, cell: Cell, runs: Mapping[CellRunId, Outcome]) -> Iterator[Term]:
        row = self._rows.get(cell.row)
        finished = finished_runs_of(cell.row, runs)
        if row is None or not finished:
            raise InputError(f"row '{cell.row}' has no finished run.")
        if cell.column not in {column.name for column in self.table.columns_of(row)}:
            raise InputError(f"row '{cell.row}' has no score '{cell.column}'.")
        for part, column in base_scores(self.table, row, cell.column):
            if not is_counted(column):
                raise InputError(f"column '{column.name}' is not a score of images.")
            words = words_of(column, self.table)
            if cell.world:
                plain = Column(name=names.MIOU, metric=names.MIOU)
                if words != words_of(plain, self.table):
                    raise InputError(f"'{column.name}' is no score of the plain test images.")
                words = world_words(self.table, row)[cell.world]
            # Another table may have trained further seeds, without this measurement.
            counted = {s: run for s, run in finished.items() if self.stored.has(run, words)}
            runs_of = counted or finished
            yield Term(
                weight=cell.weight * part,
                metric=metric_of(column, row),
                counts={seed: self.stored.counts(run, words) for seed, run in runs_of.items()},
                keys={seed: f"{run.key}/{' '.join(words)}" for seed, run in runs_of.items()},
            )

    def marks(self, scored: ScoredTable, runs: Mapping[CellRunId, Outcome]) -> dict[CellId, int]:
        """Rank 1 of a row that is shown to be better than all others of a column; 2 the next.

        A row is shown to be better where the interval of its difference to each other row excludes
        0; a row without a score may be better than all others. Rows of the same runs share a mark.
        Nothing is marked with fewer than two seeds.
        """
        marks: dict[CellId, int] = {}
        present = {label for label, _ in runs}
        for column in self.table.columns:
            if column.best == "none" or not (is_counted(column) or column.sources):
                continue
            cells = {
                label: cell
                for (label, name), cell in scored.cells.items()
                if name == column.name and label in present
            }
            left = {label: cell.mean for label, cell in cells.items()}
            if any(map(math.isnan, left.values())) or any(cell.reason for cell in cells.values()):
                continue
            for rank in (1, 2):
                best = self._best(column, left, runs)
                if not best:
                    break
                marks |= {(label, column.name): rank for label in best}
                left = {label: mean for label, mean in left.items() if label not in best}
        return marks

    def _best(
        self, column: Column, means: Mapping[str, float], runs: Mapping[CellRunId, Outcome]
    ) -> list[str]:
        """The row, and others of the same runs, that is shown to be better than all others."""
        if len(means) < 2:
            return []
        highest = column.best == "highest"
        best = (max if highest else min)(means, key=lambda label: means[label])
        wanted = HIGHER if highest else LOWER
        same = [best]
        # The nearest row first: if it cannot be told apart, the others need no interval.
        for label in sorted(means.keys() - {best}, key=lambda each: abs(means[each] - means[best])):
            cells = difference(best, label, column.name).cells
            try:
                shown = self.images.evidence(self.terms(cells, runs))
            except SameRunsError:
                same.append(label)
                continue
            except InputError:
                return []
            if decide([shown], wanted, self.rule, "all").kind != "holds":
                return []
        return same if len(same) < len(means) else []


def finished_runs_of(label: str, runs: Mapping[CellRunId, Outcome]) -> dict[int, RunResult]:
    """The finished runs of a row, by seed."""
    return {
        seed: run.results[0]
        for (each, seed), run in runs.items()
        if each == label and run.state == "finished" and run.results
    }


def rule_of(results: Iterable[RunResult]) -> Rule:
    """The rule that runs allow, by their tags: valid at any time where results decided how many.

    The tag of any table counts, because tables share runs.
    """
    is_added = any(name.startswith(UNTIL_DECIDED) for run in results for name in run.tags)
    return Rule(any_time=is_added)


def _exact_verdict(value: float, *, is_so: bool) -> Verdict:
    return Verdict(
        kind="holds" if is_so else "contradicted",
        estimate=value,
        interval=Interval(value, value),
        covers="none",
        smallest=0.0,
        seeds=0,
        seeds_needed=0,
        decisive=0,
        reason="Counted, not estimated.",
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None
