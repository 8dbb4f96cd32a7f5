"""Judges the claims of a table by its finished runs, and marks the rows that are shown to be best.

A contrast is formed for each seed that all its rows have, because the runs of one seed share their
initial weights and the order of their data.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import fmean

from analysis.uncertainty import Interval, Resampling
from analysis.uncertainty.contrasts import Evidence, Resampler, Term
from analysis.uncertainty.verdicts import AnyTime, FixedSeeds, Rule, Verdict, decide
from rgbt.checks import InputError
from rgbt.config.stored_config import read_settings
from rgbt.metrics.counts import Counts
from rgbt.runs.result import RunResult
from sweeps.point import Outcome
from sweeps.table.cells import (
    CellId,
    ScoredTable,
    TableCell,
    counts_path,
    is_counted,
    metric_of,
    published,
)
from sweeps.table.claim import HIGHER, LOWER, Claim
from sweeps.table.request import UNTIL_DECIDED
from sweeps.table.table import Column, Row, Table

RESAMPLES = 2_000
"""Of the images: enough for a standard error, which is known to 2 % then."""

CellRunId = tuple[str, int]
"""(label of the row, seed); the seed of a row that was not trained here is `FIXED`."""

UNKNOWN = "unknown"


@dataclass(frozen=True)
class Basis:
    """What a verdict is about, beside its numbers.

    Attributes:
        images: "synthetic", "real" or "unknown".
        scale: of the runs.
        starts: number of different initial weights of the runs.
    """

    images: str
    scale: str
    starts: int


class StoredRuns:
    """Counts and settings of finished runs, each file read once."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str], Counts] = {}
        self._settings: dict[str, tuple[str, str, str]] = {}

    def counts(self, run: RunResult, path: str) -> Counts:
        """Counts of a run; InputError where they are missing, damaged or cannot be read."""
        if (run.key, path) not in self._counts:
            try:
                self._counts[run.key, path] = run.counts(path)
            except OSError as error:
                raise InputError(f"run {run.key}: {error}") from error
        return self._counts[run.key, path]

    def basis(self, runs: Iterable[RunResult]) -> Basis:
        """What runs are about, by their stored settings; of several kinds of runs, all kinds."""
        each = []
        for run in runs:
            if run.key not in self._settings:
                self._settings[run.key] = _settings_of(run)
            each.append(self._settings[run.key])
        images, scales, starts = (set(values) for values in zip(*each, strict=True))
        return Basis(" and ".join(sorted(images)), " and ".join(sorted(scales)), len(starts))


def _settings_of(run: RunResult) -> tuple[str, str, str]:
    """Kind of images, scale and initial weights of a run."""
    config = run.folder / "config.yaml"
    if not config.is_file():
        return UNKNOWN, UNKNOWN, run.key
    settings = read_settings(config)
    seed, scale = str(settings["seed"]), str(settings["scale"]["name"])
    images = "synthetic" if ".synth" in str(settings["dataset"]["_target_"]) else "real"
    start = str(settings.get("pretrained") or settings["model"].get("weights") or "")
    is_common = start.startswith("common:") and settings["seeds"]["start"] == "common"
    is_file = bool(start) and not start.startswith(("common:", "experiment:"))
    return images, scale, "0" if is_common or is_file else seed


@dataclass(frozen=True)
class Contrast:
    """A row minus another one in a column; or the difference of two such differences.

    Attributes:
        row: its label.
        other: label of the row that is subtracted; None: the score of `row` itself.
        column: its name.
        minus_column: column whose difference is subtracted; None: there is none.
    """

    row: str
    other: str | None
    column: str
    minus_column: str | None = None

    @property
    def label(self) -> str:
        """As shown: "Ny/4 - CRM baseline, Var"."""
        columns = " - ".join(filter(None, (self.column, self.minus_column)))
        return f"{' - '.join(self.rows)}, {columns}"

    @property
    def rows(self) -> tuple[str, ...]:
        """The labels of its rows."""
        return (self.row,) if self.other is None else (self.row, self.other)

    def cells(self) -> Iterator[tuple[float, str, str]]:
        """(weight, row, column) of its cells."""
        columns = [(1.0, self.column)]
        columns += [] if self.minus_column is None else [(-1.0, self.minus_column)]
        for weight, column in columns:
            yield weight, self.row, column
            if self.other is not None:
                yield -weight, self.other, column


def contrasts_of(claim: Claim, table: Table) -> list[Contrast]:
    """The contrasts that a claim is made of, column by column; [] of one about a design."""
    labels = [row.label for row in table.rows if row.experiment is not None or row.values]
    return [
        Contrast(row, other, column, claim.minus_column)
        for column in (() if claim.effect else claim.columns)
        for row, other in claim.pairs(labels)
    ]


def printed_value(contrast: Contrast, table: Table) -> float | None:
    """The contrast of the printed values; None where one of them is not printed."""
    rows = {row.label: row for row in table.rows}
    columns = {column.name: column for column in table.columns}
    total = 0.0
    for weight, row, column in contrast.cells():
        value = published(rows[row], columns[column])
        if value is None:
            return None
        total += weight * value
    return total


def base_scores(table: Table, row: Row, name: str) -> Iterator[tuple[float, Column]]:
    """(weight, column) of the scores of counts that a column of a row is computed from.

    Raises:
        KeyError: the row has no such column.
    """
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

    Attributes:
        name: of the table.
        rule: when a claim is decided.
        resamples: of the images.
        sizes: exact values of cells that are counted without a run.
        stored: the runs that were read.
    """

    name: str
    table: Table
    rule: Rule = field(default_factory=FixedSeeds)
    resamples: int = RESAMPLES
    sizes: Mapping[CellId, TableCell] = field(default_factory=dict)
    stored: StoredRuns = field(default_factory=StoredRuns)

    def __post_init__(self) -> None:
        self._rows = {row.label: row for row in self.table.rows}
        self._resampler = Resampler(Resampling(resamples=self.resamples, absent=self.table.absent))

    def claims(self, runs: Mapping[CellRunId, Outcome]) -> list[JudgedClaim]:
        """Every claim about rows of the table, judged by the finished ones of `runs`."""
        return [self.judge(claim, runs) for claim in self.table.claims if not claim.effect]

    def judge(self, claim: Claim, runs: Mapping[CellRunId, Outcome]) -> JudgedClaim:
        """One claim; a contrast without scores leaves a claim about all of them undecided."""
        contrasts = contrasts_of(claim, self.table)
        printed = [printed_value(each, self.table) for each in contrasts]
        rows = {label for each in contrasts for label in each.rows}
        finished = {label: finished_runs_of(label, runs) for label in self._rows if label in rows}
        judged = partial(
            JudgedClaim,
            table=self.name,
            claim=claim,
            as_printed=as_claimed(claim, printed),
            missing=tuple(label for label, each in finished.items() if not each),
        )
        exact = [self._exact(each) for each in contrasts]
        if (is_so := as_claimed(claim, exact)) is not None:
            verdict = _exact_verdict(exact[0] or 0.0, is_so=is_so)
            label = contrasts[0].label
            return judged(contrast=label, printed=printed[0], verdict=verdict, complete=True)

        mean = claim.combine == "mean"
        groups = [[(1.0, each)] for each in contrasts]
        if mean:
            groups = [[(1 / len(contrasts), each) for each in contrasts]]
        evidences: dict[int, Evidence] = {}
        reasons: list[str] = []
        for index, group in enumerate(groups):
            try:
                evidences[index] = self.evidence(group, runs)
            except InputError as error:
                reasons.append(str(error))
        if not evidences:
            shown = _mean(printed) if mean else printed[0]
            return judged(contrast=contrasts[0].label, printed=shown, reason=reasons[0])
        basis = self.stored.basis(run for each in finished.values() for run in each.values())
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

    def _exact(self, contrast: Contrast) -> float | None:
        """The value of a contrast of exact cells; None where one of them is not."""
        cells = [(weight, self.sizes.get((row, name))) for weight, row, name in contrast.cells()]
        known = [weight * cell.mean for weight, cell in cells if cell is not None]
        return sum(known) if len(known) == len(cells) else None

    def evidence(
        self, contrasts: Sequence[tuple[float, Contrast]], runs: Mapping[CellRunId, Outcome]
    ) -> Evidence:
        """What finished runs say about a weighted sum of contrasts.

        Raises:
            InputError: a row without a finished run, two rows of the same runs, or counts that
                cannot be compared.
        """
        for _, contrast in contrasts:
            if contrast.other is not None and self._is_same(contrast, runs):
                raise InputError(
                    f"rows '{contrast.row}' and '{contrast.other}' are the same runs at this scale."
                )
        terms = [
            term
            for weight, contrast in contrasts
            for part, row, column in contrast.cells()
            for term in self._terms(weight * part, row, column, runs)
        ]
        return self._resampler.evidence(terms)

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
        same = [each for each in means if self._is_same(Contrast(best, each, column.name), runs)]
        others = [Contrast(best, label, column.name) for label in means if label not in same]
        try:
            shown = [self.evidence([(1.0, each)], runs) for each in others]
        except InputError:
            return []
        wanted = HIGHER if highest else LOWER
        is_best = bool(shown) and decide(shown, wanted, self.rule, "all").kind == "holds"
        return same if is_best else []

    def _is_same(self, contrast: Contrast, runs: Mapping[CellRunId, Outcome]) -> bool:
        """Whether both rows of a contrast are the same scores of the same runs."""
        keys = [
            {run.key for run in finished_runs_of(label, runs).values()} for label in contrast.rows
        ]
        metrics = [
            [metric_of(base, self._rows[label]) for base in self._bases(contrast, label)]
            for label in contrast.rows
        ]
        return bool(keys[0]) and keys[0] == keys[-1] and metrics[0] == metrics[-1]

    def _bases(self, contrast: Contrast, label: str) -> list[Column]:
        names = {column for _, _, column in contrast.cells()}
        present = {each.name for each in self.table.columns_of(self._rows[label])}
        return [
            base
            for name in sorted(names & present)
            for _, base in base_scores(self.table, self._rows[label], name)
        ]

    def _terms(
        self, weight: float, label: str, name: str, runs: Mapping[CellRunId, Outcome]
    ) -> Iterator[Term]:
        row = self._rows[label]
        if name not in {column.name for column in self.table.columns_of(row)}:
            raise InputError(f"row '{label}' has no score '{name}'.")
        finished = finished_runs_of(label, runs)
        if not finished:
            raise InputError(f"row '{label}' has no finished run.")
        for part, column in base_scores(self.table, row, name):
            if not is_counted(column):
                raise InputError(f"column '{column.name}' is not a score of images.")
            path = counts_path(column, self.table)
            yield Term(
                weight=weight * part,
                metric=metric_of(column, row),
                counts={seed: self.stored.counts(run, path) for seed, run in finished.items()},
                keys={seed: f"{run.key}/{path}" for seed, run in finished.items()},
            )


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
    return AnyTime() if is_added else FixedSeeds()


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
