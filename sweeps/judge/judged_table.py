"""A table judged by its finished runs: scores, claims with verdicts, rows shown to be the best.

A claim is made of contrasts of rows, or of effects of a design. Each is a weighted sum of scores,
formed for every seed that all its rows have, because the runs of one seed share their initial
weights and the order of their data.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import fmean

from analysis.uncertainty import Interval, Resampling
from analysis.uncertainty.contrasts import FIXED, Evidence, Resampler, Term
from analysis.uncertainty.same_images import Alike
from analysis.uncertainty.verdicts import Verdict, decide
from rgbt.checks import InputError
from rgbt.runs.result import RunResult
from sweeps.judge.contrasts import (
    Cell,
    Contrast,
    as_claimed,
    base_scores,
    contrasts_of,
    difference,
    effects_claimed,
    is_level,
    printed_values,
)
from sweeps.judge.judged_claim import JudgedClaim, are_of_paper
from sweeps.judge.seeds import CONFIRMING, EXPLORING, of_declared, of_others, scores_of
from sweeps.plan.claim import HIGHER, LOWER, Claim
from sweeps.plan.request import RowSeed, TableRequest
from sweeps.plan.table import Column, is_counted, metric_of, words_of, world_words
from sweeps.point import Outcome
from sweeps.score.cells import CellId, ScoredTable, TableCell, score, size_marks
from sweeps.score.reader import RunReader

# Resamples of the images: enough to know a standard error to 2 %.
RESAMPLES = 2_000

SOME_SEEDS = "Some rows have no seed but declared ones."

# By what counts have in common, and how they are drawn; tables share runs, and with them draws.
Resamplers = dict[tuple[Alike, Resampling], Resampler]

# Of a contrast, the evidence of seeds that were not declared, and that of the declared ones.
BothSeeds = tuple[Evidence | None, Evidence | None]


@dataclass(frozen=True, kw_only=True)
class JudgedTable:
    """A table, the runs of its rows, and what they show.

    `replace(judged, runs=...)` judges further runs and keeps what was read and resampled.

    Attributes:
        request: of a table that is read from tags of runs, `extra` are words to show, not to
            compose.
        runs: by label of the row and seed.
        sizes: cells that are counted without a run.
    """

    request: TableRequest
    runs: Mapping[RowSeed, Outcome] = field(default_factory=dict)
    sizes: Mapping[CellId, TableCell] = field(default_factory=dict)
    resamples: int = RESAMPLES
    reader: RunReader = field(default_factory=RunReader)
    resamplers: Resamplers = field(default_factory=dict)

    @cached_property
    def values(self) -> ScoredTable:
        """Our values, without marks."""
        request = self.request
        scored = score(
            request.name,
            request.table,
            self.runs,
            scale=request.scale,
            sizes=self.sizes,
            reader=self.reader.counts,
        )
        return replace(scored, form=request.form)

    @cached_property
    def scored(self) -> ScoredTable:
        """Our values, with marks of the best rows (`score`)."""
        marks = self._marks(self.values) | size_marks(self.request.table, self.sizes)
        return replace(self.values, marks=marks)

    @cached_property
    def claims(self) -> list[JudgedClaim]:
        """Every claim of the table, judged by the finished runs."""
        judged: list[JudgedClaim] = []
        first: dict[object, str] = {}  # name of the first claim that asks the same of the same runs
        for claim in self.request.table.claims:
            found = self._judge(claim)
            if found.contrasts:
                place = (found.compared, found.requirement)
                found = replace(found, same_as=first.get(place, ""))
                first.setdefault(place, claim.name)
            judged.append(found)
        return judged

    def resampler(self, alike: Alike = "labels") -> Resampler:
        """Return the engine for images with equal labels, or "names" for the worlds of a design.

        Generated scenes are independent, and each world has its own labels.
        """
        table = self.request.table
        blocks = table.blocks.get(self.request.scale, "auto")
        settings = Resampling(resamples=self.resamples, absent=table.absent, blocks=blocks)
        if alike == "names":
            settings = replace(settings, blocks="none")
        place = (alike, settings)
        if place not in self.resamplers:
            self.resamplers[place] = Resampler(settings, alike)
        return self.resamplers[place]

    def terms(self, cells: Sequence[Cell]) -> list[Term]:
        """Return the scores of counts, by seed, that a weighted sum of cells is made of.

        InputError: a row has no finished run or not the score.
        """
        terms = []
        for cell in cells:
            terms += self._cell_terms(cell)
        return terms

    def _cell_terms(self, cell: Cell) -> list[Term]:
        table = self.request.table
        rows = {row.label: row for row in table.rows}
        runs = self._finished(cell.row)
        if cell.row not in rows or not runs:
            raise InputError(f"row '{cell.row}' has no finished run.")
        row = rows[cell.row]
        if cell.column not in {column.name for column in table.columns_of(row)}:
            raise InputError(f"row '{cell.row}' has no score '{cell.column}'.")
        terms = []
        for part, column in base_scores(table, row, cell.column):
            if not is_counted(column):
                raise InputError(f"column '{column.name}' is not a score of images.")
            words = words_of(column, table)
            if cell.world:
                words = world_words(column, table, row)[cell.world]
            # Another table may have trained further seeds, without this measurement.
            counted = {s: run for s, run in runs.items() if self.reader.has_counts(run, words)}
            used = counted or runs
            term = Term(
                weight=cell.weight * part,
                metric=metric_of(column, row),
                counts={seed: self.reader.counts(run, words) for seed, run in used.items()},
                keys={seed: f"{run.key}/{' '.join(words)}" for seed, run in used.items()},
            )
            terms.append(term)
        return terms

    def _finished(self, label: str) -> dict[int, RunResult]:
        """The finished runs of a row, by seed."""
        runs = {}
        for (row, seed), outcome in self.runs.items():
            if row == label and outcome.state == "finished" and outcome.results:
                runs[seed] = outcome.results[0]
        return runs

    def _judge(self, claim: Claim) -> JudgedClaim:
        """Judge one claim by the declared seeds, and by all others."""
        table = self.request.table
        contrasts = contrasts_of(claim, table)
        if claim.effect:
            assert table.design is not None, "a claim about an effect is about a design"
            contrasts = effects_claimed(claim, table.design)
        named = {cell.row for contrast in contrasts for cell in contrast.cells}
        labels = [row.label for row in table.rows if row.label in named]
        finished = {label: self._finished(label) for label in labels}
        values = printed_values(table)
        printed = [contrast.of_values(values) for contrast in contrasts]
        judged = JudgedClaim(
            table=self.request.name,
            claim=claim,
            label=contrasts[0].label,
            printed=printed[0],
            as_printed=as_claimed(claim, printed),
            rows=tuple(labels),
            missing=tuple(label for label, runs in finished.items() if not runs),
            is_level=any(is_level(contrast, table) for contrast in contrasts),
        )

        # Sizes of networks are counted, not estimated.
        sizes = {cell: size.mean for cell, size in self.sizes.items() if not math.isnan(size.mean)}
        exact = [contrast.of_values(sizes) for contrast in contrasts]
        is_so = as_claimed(claim, exact)
        if is_so is not None:
            verdict = _exact_verdict(exact[0] or 0.0, is_so=is_so)
            return replace(judged, exploration=verdict, complete=True)

        runs = [run for of_row in finished.values() for run in of_row.values()]
        origins = [self.reader.origin(run) for run in runs]
        images = " and ".join(sorted({origin.images for origin in origins}))
        scale = " and ".join(sorted({origin.scale for origin in origins}))
        is_changed = bool(self.request.deciding_words())
        judged = replace(
            judged,
            images=images,
            scale=scale,
            of_paper=are_of_paper(images, scale, is_changed=is_changed),
            warnings=self._warnings(finished),
        )
        groups = [contrasts] if claim.combine == "mean" else [[one] for one in contrasts]
        return self._with_verdicts(judged, groups)

    def _with_verdicts(
        self, judged: JudgedClaim, groups: Sequence[Sequence[Contrast]]
    ) -> JudgedClaim:
        """Add what the runs show about the mean of each group, and about the claim.

        A contrast without scores leaves a claim about all of them open.
        """
        singles: list[JudgedClaim] = []
        evidences: list[BothSeeds] = []
        reasons, same = [], []
        lost = ""
        for group in groups:
            try:
                single, terms = self._contrast(judged, group)
            except InputError as error:
                reasons.append(str(error))
                lost = lost or f"Some rows have no score: {error}"
                continue
            if single.scores in [other.scores for other in singles]:
                same.append(single.label)
                continue
            found, reason = self._evidences(judged.claim, terms)
            explored, confirmed = self._verdicts(judged, [found])
            singles.append(replace(single, exploration=explored, confirmation=confirmed))
            evidences.append(found)
            if reason:
                reasons.append(reason)
        if not singles:
            return replace(judged, reason=reasons[0])
        if same:
            warning = f"The same runs as another contrast, judged once: {'; '.join(same)}."
            judged = replace(judged, warnings=(*judged.warnings, warning))
        explored, confirmed = self._verdicts(judged, evidences, lost)
        if lost and explored is not None:  # the other seeds may have more rows
            confirmed = None
        judged = replace(
            judged,
            exploration=explored,
            confirmation=confirmed,
            contrasts=tuple(singles),
            reason=reasons[0] if reasons else "",
            complete=not reasons,
        )
        verdict = judged.verdict
        if verdict is None:
            return judged
        basis = 1 if judged.confirmation else 0
        used = [one for one, found in zip(singles, evidences, strict=True) if found[basis]]
        shown = used[verdict.decisive]
        return replace(judged, label=shown.label, printed=shown.printed, reason=verdict.reason)

    def _verdicts(
        self, judged: JudgedClaim, evidences: Sequence[BothSeeds], missing: str = ""
    ) -> tuple[Verdict | None, Verdict | None]:
        """Decide by the other seeds at any time, and by the declared ones if all rows have them.

        `missing`: why further contrasts of the claim have no evidence, see `decide`.
        """
        claim = judged.claim
        verdicts: list[Verdict | None] = []
        for rule, place in ((EXPLORING, 0), (CONFIRMING, 1)):
            found = [one for both in evidences if (one := both[place]) is not None]
            is_partial = len(found) < len(evidences)
            if not found or (is_partial and rule is CONFIRMING):
                verdicts.append(None)
                continue
            lost = missing or (SOME_SEEDS if is_partial else "")
            starts = self._starts(judged, {seed for one in found for seed in one.seeds})
            verdict = decide(found, judged.wanted, rule, claim.combine, starts=starts, missing=lost)
            verdicts.append(verdict)
        explored, confirmed = verdicts
        return explored, confirmed

    def _starts(self, judged: JudgedClaim, seeds: Collection[int]) -> int:
        """The number of different initial weights from which these seeds of its rows began."""
        starts = set()
        for label in judged.rows:
            for seed, run in self._finished(label).items():
                if seed in seeds or seed == FIXED:
                    starts.add(self.reader.origin(run).start)
        return len(starts)

    def _contrast(
        self, judged: JudgedClaim, group: Sequence[Contrast]
    ) -> tuple[JudgedClaim, list[Term]]:
        """The claim about the mean of a group alone; InputError: `terms`, or equal runs."""
        terms: list[Term] = []
        for contrast in group:
            of_contrast = self.terms(contrast.cells)
            if not scores_of(of_contrast):
                rows = " and ".join(dict.fromkeys(f"'{cell.row}'" for cell in contrast.cells))
                raise InputError(f"rows {rows} are the same runs at this scale.")
            for term in of_contrast:
                terms.append(replace(term, weight=term.weight / len(group)))
        values = printed_values(self.request.table)
        label = group[0].label if len(group) == 1 else f"mean of {len(group)} contrasts"
        # Claims that A is above B and that B is below A are one.
        sign = -1.0 if judged.claim.expected == "lower" else 1.0
        printed = _mean([contrast.of_values(values) for contrast in group])
        scores = scores_of(terms, sign)
        return replace(judged, label=label, printed=printed, scores=scores), terms

    def _evidences(self, claim: Claim, terms: Sequence[Term]) -> tuple[BothSeeds, str]:
        """The evidence of the other seeds and of the declared ones; why the first is missing."""
        declared = () if claim.exploratory else self.request.table.confirm
        resampler = self.resampler("names" if claim.effect else "labels")
        fixed = of_declared(terms, declared)
        confirmed = resampler.evidence(fixed) if fixed else None
        try:
            return (resampler.evidence(of_others(terms, declared)), confirmed), ""
        except InputError as error:
            return (None, confirmed), str(error)

    def _warnings(self, rows: Mapping[str, Mapping[int, RunResult]]) -> tuple[str, ...]:
        """What differs between the runs of a seed, which are compared: their lists and machines."""
        by_seed: dict[int, dict[str, dict[str, None]]] = {}  # seed -> lists -> labels of rows
        machines: dict[int, set[str]] = {}
        for label, runs in rows.items():
            for seed, run in runs.items():
                origin = self.reader.origin(run)
                of_seed = by_seed.setdefault(seed, {})
                if origin.lists:
                    of_seed.setdefault(origin.lists, {})[label] = None
                machines.setdefault(seed, set())
                if origin.machine:
                    machines[seed].add(origin.machine)
        warnings = []
        lists: dict[str, dict[str, None]] = {}
        for of_seed in by_seed.values():
            for text, labels in of_seed.items() if len(of_seed) > 1 else ():
                lists[text] = lists.get(text, {}) | labels
        if lists:
            shown = "; ".join(f"{', '.join(labels)} {text}" for text, labels in lists.items())
            warnings.append(f"Different lists: {shown}.")
        mixed = [str(seed) for seed, known in machines.items() if len(known) > 1]
        if mixed:
            warnings.append(f"Seeds {', '.join(mixed)} mix machines, which train differently.")
        return tuple(warnings)

    def _marks(self, scored: ScoredTable) -> dict[CellId, int]:
        """Rank 1 of a row that is shown to be better than all others of a column; 2 the next.

        A row is shown to be better where the interval of its difference to each other row excludes
        0; a row without a score may be better than all others. Rows of the same runs share a mark.
        Nothing is marked with fewer than two seeds.
        """
        marks: dict[CellId, int] = {}
        present = {label for label, _ in self.runs}
        for column in self.request.table.columns:
            if column.best == "none" or not (is_counted(column) or column.sources):
                continue
            cells = {
                label: cell
                for (label, name), cell in scored.cells.items()
                if name == column.name and label in present
            }
            if any(cell.reason or math.isnan(cell.mean) for cell in cells.values()):
                continue
            left = {label: cell.mean for label, cell in cells.items()}
            for rank in (1, 2):
                best = self._best(column, left)
                if not best:
                    break
                for label in best:
                    marks[label, column.name] = rank
                    del left[label]
        return marks

    def _best(self, column: Column, means: Mapping[str, float]) -> list[str]:
        """The row, and others of the same runs, that is shown to be better than all others."""
        if len(means) < 2:
            return []
        if column.best == "highest":
            best, wanted = max(means, key=lambda label: means[label]), HIGHER
        else:
            best, wanted = min(means, key=lambda label: means[label]), LOWER
        same = [best]
        others = means.keys() - {best}
        # The nearest row first: if it cannot be distinguished, the others need no interval.
        for label in sorted(others, key=lambda other: abs(means[other] - means[best])):
            try:
                terms = self.terms(difference(best, label, column.name).cells)
                if not scores_of(terms):
                    same.append(label)
                    continue
                fixed = of_declared(terms, self.request.table.confirm)
                used = fixed or of_others(terms, self.request.table.confirm)
                evidence = self.resampler().evidence(used)
            except InputError:
                return []
            rule = CONFIRMING if fixed else EXPLORING
            if decide([evidence], wanted, rule, "all").kind != "holds":
                return []
        return same if len(same) < len(means) else []


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
