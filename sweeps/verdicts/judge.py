"""Judges the claims of a table by its finished runs, and marks the rows that are shown to be best.

A contrast is formed for each seed that all its rows have, because the runs of one seed share their
initial weights and the order of their data.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean

from analysis.uncertainty import Interval, Resampling
from analysis.uncertainty.contrasts import Evidence, Resampler, Term
from analysis.uncertainty.verdicts import FixedSeeds, Rule, Verdict, decide
from rgbt.checks import InputError
from rgbt.runs.result import RunResult
from sweeps.point import Outcome
from sweeps.table.cells import CellId, counts_path, is_counted, metric_of
from sweeps.table.claim import HIGHER, LOWER, Claim
from sweeps.table.table import Column, Table
from sweeps.verdicts.contrasts import Contrast, base_scores, contrasts_of, printed_value
from sweeps.verdicts.loaded_counts import LoadedCounts

RESAMPLES = 2_000
"""Of the images: enough for a standard error, which is known to 2 % then."""

CellRunId = tuple[str, int]
"""(label of the row, seed); the seed of a row that was not trained here is `FIXED`."""


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
    """

    table: str
    claim: Claim
    verdict: Verdict | None
    contrast: str
    printed: float | None
    as_printed: bool | None
    missing: tuple[str, ...] = ()
    complete: bool = False
    reason: str = ""

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
    """

    name: str
    table: Table
    rule: Rule = field(default_factory=FixedSeeds)
    resamples: int = RESAMPLES
    sizes: Mapping[CellId, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._rows = {row.label: row for row in self.table.rows}
        settings = Resampling(resamples=self.resamples, absent=self.table.absent)
        self._resampler = Resampler(settings)
        self._counts = LoadedCounts()

    def claims(self, runs: Mapping[CellRunId, Outcome]) -> list[JudgedClaim]:
        """Every claim of the table, judged by the finished ones of `runs`."""
        return [self.judge(claim, runs) for claim in self.table.claims]

    def judge(self, claim: Claim, runs: Mapping[CellRunId, Outcome]) -> JudgedClaim:
        """One claim; a contrast without scores leaves a claim about all of them undecided."""
        contrasts = contrasts_of(claim, self.table)
        exact = [self._exact(each) for each in contrasts]
        printed = [printed_value(each, self.table) for each in contrasts]
        agrees = as_claimed(claim, printed)
        counted = as_claimed(claim, exact)
        if counted is not None:
            return JudgedClaim(
                table=self.name,
                claim=claim,
                verdict=_exact_verdict(exact, is_so=counted),
                contrast=contrasts[0].label,
                printed=printed[0],
                as_printed=agrees,
                complete=True,
            )
        known: list[int] = []
        evidences: list[Evidence] = []
        reasons: dict[str, None] = {}
        if claim.combine == "mean":
            weights = [(1 / len(contrasts), each) for each in contrasts]
            groups = [weights]
        else:
            groups = [[(1.0, each)] for each in contrasts]
        for index, group in enumerate(groups):
            try:
                evidences.append(self.evidence(group, runs))
                known.append(index)
            except InputError as error:
                reasons[str(error)] = None
        missing = self._missing(contrasts, runs)
        if not evidences:
            return JudgedClaim(
                table=self.name,
                claim=claim,
                verdict=None,
                contrast=contrasts[0].label,
                printed=_mean(printed) if claim.combine == "mean" else printed[0],
                as_printed=agrees,
                missing=missing,
                reason=next(iter(reasons), ""),
            )
        verdict = decide(evidences, claim.range, self.rule, claim.combine)
        shown = known[verdict.decisive]
        is_partial = len(evidences) < len(groups)
        if is_partial:
            verdict = _of_a_part(verdict, claim, next(iter(reasons)))
        mean = claim.combine == "mean"
        return JudgedClaim(
            table=self.name,
            claim=claim,
            verdict=verdict,
            contrast=f"mean of {len(contrasts)} contrasts" if mean else contrasts[shown].label,
            printed=_mean(printed) if mean else printed[shown],
            as_printed=agrees,
            missing=missing,
            complete=not is_partial,
            reason=verdict.reason,
        )

    def _exact(self, contrast: Contrast) -> float | None:
        """The value of a contrast of exact cells; None where one of them is not."""
        cells = [(weight, self.sizes.get((row, name))) for weight, row, name in contrast.cells()]
        known = [weight * value for weight, value in cells if value is not None]
        return sum(known) if len(known) == len(cells) else None

    def evidence(
        self, contrasts: Sequence[tuple[float, Contrast]], runs: Mapping[CellRunId, Outcome]
    ) -> Evidence:
        """What finished runs say about a weighted sum of contrasts.

        Raises:
            InputError: a row without a finished run, or counts that cannot be compared.
        """
        for _, contrast in contrasts:
            self._check_differ(contrast, runs)
        terms = [
            term
            for weight, contrast in contrasts
            for part, row, column in contrast.cells()
            for term in self._terms(weight * part, row, column, runs)
        ]
        return self._resampler.evidence(terms)

    def marks(self, runs: Mapping[CellRunId, Outcome]) -> dict[CellId, int]:
        """Rank 1 of a row that is shown to be better than all others of a column; 2 the next.

        A row is shown to be better where the interval of its difference to each other row excludes
        0. Rows of the same runs share a mark. Nothing is marked with fewer than two seeds.
        """
        marks: dict[CellId, int] = {}
        for column in self.table.columns:
            if column.best == "none" or not (is_counted(column) or column.sources):
                continue
            left = self._labels(column.name, runs)
            for rank in (1, 2):
                best = self._best(column.name, column.best == "highest", left, runs)
                if not best:
                    break
                marks |= {(label, column.name): rank for label in best}
                left = [label for label in left if label not in best]
        return marks

    def _best(
        self, column: str, highest: bool, labels: Sequence[str], runs: Mapping[CellRunId, Outcome]
    ) -> list[str]:
        """The row, and others of the same runs, that is shown to be better than all of `labels`."""
        means: dict[str, float] = {}
        for label in labels:
            try:
                found = self.evidence([(1.0, Contrast(label, None, column))], runs)
            except InputError:
                return []  # a row without a score may be better than all others
            means[label] = fmean(found.values)
        if len(means) < 2:
            return []
        best = (max if highest else min)(means, key=lambda label: means[label])
        same = [label for label in means if self._is_same(Contrast(best, label, column), runs)]
        others = [Contrast(best, label, column) for label in means if label not in same]
        if not others:
            return []
        wanted = HIGHER if highest else LOWER
        try:
            shown = [self.evidence([(1.0, each)], runs) for each in others]
        except InputError:
            return []
        return same if decide(shown, wanted, self.rule, "all").kind == "holds" else []

    def _labels(self, column: str, runs: Mapping[CellRunId, Outcome]) -> list[str]:
        present = dict.fromkeys(label for label, _ in runs)
        names = {label: self.table.columns_of(self._rows[label]) for label in present}
        return [label for label in present if column in {each.name for each in names[label]}]

    def _check_differ(self, contrast: Contrast, runs: Mapping[CellRunId, Outcome]) -> None:
        """Refuse two rows of the same runs: their difference is 0 and says nothing."""
        if contrast.other is not None and self._is_same(contrast, runs):
            raise InputError(
                f"rows '{contrast.row}' and '{contrast.other}' are the same runs at this scale."
            )

    def _is_same(self, contrast: Contrast, runs: Mapping[CellRunId, Outcome]) -> bool:
        """Whether both rows of a contrast are the same scores of the same runs."""
        keys = [_keys(label, runs) for label in contrast.rows]
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
    ) -> Iterable[Term]:
        row = self._rows[label]
        if name not in {column.name for column in self.table.columns_of(row)}:
            raise InputError(f"row '{label}' has no score '{name}'.")
        finished = finished_runs_of(label, runs)
        for part, column in base_scores(self.table, row, name):
            if not is_counted(column):
                raise InputError(f"column '{column.name}' is not a score of images.")
            path = counts_path(column, self.table)
            yield Term(
                weight=weight * part,
                metric=metric_of(column, row),
                counts={seed: self._counts.of(run, path) for seed, run in finished.items()},
                keys={seed: f"{run.key}/{path}" for seed, run in finished.items()},
            )

    def _missing(
        self, contrasts: Sequence[Contrast], runs: Mapping[CellRunId, Outcome]
    ) -> tuple[str, ...]:
        """Rows of the contrasts without a finished run."""
        needed = {label for each in contrasts for label in each.rows}
        finished = {label for (label, _), run in runs.items() if run.state == "finished"}
        return tuple(label for label in self._rows if label in needed - finished)


def _keys(label: str, runs: Mapping[CellRunId, Outcome]) -> frozenset[str]:
    """Keys of the finished runs of a row."""
    found = (run for (each, _), run in runs.items() if each == label)
    return frozenset(result.key for run in found for result in run.results)


def finished_runs_of(label: str, runs: Mapping[CellRunId, Outcome]) -> dict[int, RunResult]:
    """The finished runs of a row, by seed.

    Raises:
        InputError: it has none.
    """
    finished = {
        seed: run.results[0]
        for (each, seed), run in runs.items()
        if each == label and run.state == "finished" and run.results
    }
    if not finished:
        raise InputError(f"row '{label}' has no finished run.")
    return finished


def as_claimed(claim: Claim, contrasts: Sequence[float | None]) -> bool | None:
    """Whether exact values of its contrasts agree with a claim; None where some are missing."""
    values = [value for value in contrasts if value is not None]
    if len(values) < len(contrasts):
        return None
    low, high = claim.range
    if claim.combine == "mean":
        return low < fmean(values) < high
    inside = sum(low < value < high for value in values)
    least = {"all": len(values), "most": len(values) // 2 + 1, "any": 1}[claim.combine]
    return inside >= least


def _exact_verdict(values: Sequence[float | None], *, is_so: bool) -> Verdict:
    first = values[0] or 0.0
    return Verdict(
        kind="holds" if is_so else "contradicted",
        estimate=first,
        interval=Interval(first, first),
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


def _of_a_part(verdict: Verdict, claim: Claim, reason: str) -> Verdict:
    """The verdict of a claim of which some contrasts have no scores.

    "all" cannot hold and "any" cannot be contradicted without them; "most" stays open.
    """
    stands = {"all": "contradicted", "any": "holds"}.get(claim.combine)
    if verdict.kind == stands:
        return verdict
    reason = f"Some rows have no score: {reason}"
    return replace(verdict, kind="undecided", seeds_needed=math.nan, reason=reason)
