"""Effects of the factors of a design, by method and outcome, and the claims about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from analysis.uncertainty import Resampling
from analysis.uncertainty.contrasts import Evidence, Resampler, Term, combine
from analysis.uncertainty.effects import Noise, estimate_effects
from analysis.uncertainty.estimates import Estimate
from analysis.uncertainty.verdicts import FixedSeeds, Rule, decide
from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from sweeps.point import Outcome
from sweeps.table.cells import counts_path, is_counted, metric_of, world_evaluations
from sweeps.table.claim import Claim
from sweeps.table.design import (
    TESTED,
    TRAINED,
    Design,
    DesignMethod,
    Part,
    cell_name,
    sign_of,
    tested_label,
    trained_label,
)
from sweeps.table.table import Column, Table
from sweeps.verdicts.judge import (
    RESAMPLES,
    CellRunId,
    JudgedClaim,
    StoredRuns,
    TableJudge,
    base_scores,
    finished_runs_of,
)

LEVEL = 0.95

Cell = Mapping[int, tuple[str, Counts]]
"""Seed -> (identity of the counts, counts)."""

MEAN = "mean of all cells"
"""Name of the line that is no effect: the outcome itself."""


@dataclass(frozen=True, kw_only=True)
class EffectLine:
    """One effect of one method.

    Attributes:
        part: "trained" or "tested".
        method: its name.
        against: method whose effect is subtracted; "": none.
        outcome: name of a column.
        effect: name of the effect, with its aliases; or `MEAN`.
        main: whether it is the effect of a single factor.
        estimate: over images and seeds where it has an interval `both`.
        corrected: its p-value, corrected for its family of effects (Holm).
        cells: number of cells.
    """

    part: str
    method: str
    against: str
    outcome: str
    effect: str
    main: bool
    estimate: Estimate
    corrected: float
    cells: int

    @property
    def is_shown(self) -> bool:
        """Whether the effect differs from 0, corrected for the number of effects."""
        return self.corrected < 1 - LEVEL


@dataclass(frozen=True)
class DesignEffects:
    """What the finished runs of a design show.

    Attributes:
        lines: in the order of parts, outcomes, methods and effects.
        missing: sentences on methods that cannot be analysed yet.
    """

    lines: tuple[EffectLine, ...]
    missing: tuple[str, ...]


@dataclass
class DesignJudge:
    """Estimates the effects of the design of a table; keeps counts and resampled scores.

    Attributes:
        table: with a design.
        resamples: of the images.
    """

    table: Table
    resamples: int = RESAMPLES
    rule: Rule = field(default_factory=FixedSeeds)
    stored: StoredRuns = field(default_factory=StoredRuns)

    def __post_init__(self) -> None:
        # Scenes of the generator are independent: no neighbouring frames.
        settings = Resampling(resamples=self.resamples, absent=self.table.absent, blocks="none")
        self._engine = Resampler(settings, "names")
        self._rows = {row.label: row for row in self.table.rows}

    def effects(self, runs: Mapping[CellRunId, Outcome]) -> DesignEffects:
        """Every effect that the finished ones of `runs` allow."""
        lines: list[EffectLine] = []
        missing: dict[str, None] = {}
        for part in _parts(self.table):
            found: dict[str, list[Cell]] = {}
            for method in part.design.methods:
                if all(label not in self._rows for label, _ in part.places(method.name)):
                    continue  # rows=... left it out
                try:
                    found[method.name] = self._cells(part, method.name, runs)
                except InputError as error:
                    missing[f"{part.name}, {method.name}: {error}"] = None
            for outcome, method in product(part.design.outcomes, part.design.methods):
                try:
                    lines += self._of_method(part, outcome, method, found)
                except InputError as error:
                    missing[f"{part.name}, {method.name}, {outcome}: {error}"] = None
        return DesignEffects(tuple(lines), tuple(missing))

    def _of_method(
        self, part: _Part, outcome: str, method: DesignMethod, found: Mapping[str, Sequence[Cell]]
    ) -> list[EffectLine]:
        """Effects on a method, and their difference to those on the method it is compared with."""
        own, other = found.get(method.name), found.get(method.against or "")
        if own is None:
            return []
        lines = part.lines(method.name, "", outcome, self._evidence(outcome, own, _common([own])))
        if other is not None and method.against is not None:
            seeds = _common([own, other])
            sides = (self._evidence(outcome, each, seeds) for each in (own, other))
            differences = [combine((1.0, -1.0), pair) for pair in zip(*sides, strict=True)]
            lines += part.lines(method.name, method.against, outcome, differences)
        return lines

    def judge(self, name: str, claim: Claim, runs: Mapping[CellRunId, Outcome]) -> JudgedClaim:
        """A claim about an effect: in the cells that networks are tested in, else trained in."""
        evidences: list[Evidence] = []
        labels: list[str] = []
        used: list[str] = []
        reasons: list[str] = []
        parts = sorted(_parts(self.table), key=lambda part: part.name != TESTED)
        for method, outcome in product(claim.rows, claim.columns):
            failed = ["no row of the design is among the rows."]
            for part in parts:
                try:
                    cells = self._cells(part, method, runs)
                    each = self._evidence(outcome, cells, _common([cells]))
                except InputError as error:
                    failed.append(str(error))
                    continue
                signs = [sign_of(levels, claim.effect) for levels in part.design.cells(part.part)]
                evidences.append(combine([2 * sign / len(signs) for sign in signs], each))
                labels.append(
                    f"{method}, {outcome}: {claim.effect}+ - {claim.effect}- ({part.name})"
                )
                used += [label for label, _ in part.places(method)]
                break
            else:
                reasons.append(failed[-1])
        if not evidences:
            return JudgedClaim(
                table=name, claim=claim, contrast=f"effect of {claim.effect}", reason=reasons[0]
            )
        basis = self.stored.basis(
            run for label in used for run in finished_runs_of(label, runs).values()
        )
        verdict = decide(
            evidences,
            claim.range,
            self.rule,
            claim.combine,
            starts=basis.starts,
            missing=f"Some methods have no score: {reasons[0]}" if reasons else "",
        )
        return JudgedClaim(
            table=name,
            claim=claim,
            contrast=labels[verdict.decisive],
            verdict=verdict,
            complete=not reasons,
            reason=verdict.reason,
            basis=basis,
        )

    def _evidence(
        self, outcome: str, cells: Sequence[Cell], seeds: Sequence[int]
    ) -> list[Evidence]:
        """The outcome in every cell: a sum of scores of the plain test images."""
        row = next(row for row in self.table.rows if row.group)
        weights: dict[str, float] = {}
        for weight, column in base_scores(self.table, row, outcome):
            if not is_counted(column) or counts_path(column, self.table) != self._plain_path:
                raise InputError(f"'{column.name}' is no score of the plain test images.")
            metric = metric_of(column, row)
            weights[metric] = weights.get(metric, 0.0) + weight
        found = []
        for cell in cells:
            keys = {seed: cell[seed][0] for seed in seeds}
            counts = {seed: cell[seed][1] for seed in seeds}
            terms = [
                Term(weight=weight, metric=metric, counts=counts, keys=keys)
                for metric, weight in weights.items()
            ]
            found.append(self._engine.evidence(terms))
        return found

    @property
    def _plain_path(self) -> str:
        """Path of the counts of the plain test images, relative to the run folder."""
        return counts_path(Column(name=names.MIOU, metric=names.MIOU), self.table)

    def _cells(self, part: _Part, method: str, runs: Mapping[CellRunId, Outcome]) -> list[Cell]:
        """The counts of a method in every cell; InputError where a cell has none."""
        cells: list[Cell] = []
        for label, world in part.places(method):
            finished = finished_runs_of(label, runs)
            if not finished:
                raise InputError(f"row '{label}' has no finished run.")
            path = self._plain_path
            if world:
                path = world_evaluations(self.table, self._rows[label])[world].path
            cells.append(
                {
                    seed: (f"{run.key}/{path}", self.stored.counts(run, path))
                    for seed, run in finished.items()
                }
            )
        return cells


def judged_claims(judge: TableJudge, runs: Mapping[CellRunId, Outcome]) -> list[JudgedClaim]:
    """Every claim of a table, about its rows or about its design, in their order."""
    table = judge.table
    design = DesignJudge(table, judge.resamples, judge.rule, judge.stored)
    return [
        design.judge(judge.name, claim, runs) if claim.effect else judge.judge(claim, runs)
        for claim in table.claims
    ]


@dataclass(frozen=True)
class _Part:
    """One of the two experiments of a design (`Design.trained`, `Design.tested`)."""

    design: Design
    name: str
    part: Part
    noise: Noise

    def places(self, method: str) -> list[tuple[str, str]]:
        """Label of the row, and name of the world that its network is tested in, of each cell."""
        cells = self.design.cells(self.part)
        if self.name == TESTED:
            return [(tested_label(method), cell_name(cell)) for cell in cells]
        return [(trained_label(method, cell), "") for cell in cells]

    def lines(
        self, method: str, against: str, outcome: str, cells: Sequence[Evidence]
    ) -> list[EffectLine]:
        """The mean of all cells, then every effect."""
        groups = self.design.effects(self.part)
        levels = self.design.cells(self.part)
        firsts = [next(iter(effects)) for effects in groups.values()]
        mains = [first for first in firsts if len(first) == 1]
        found = estimate_effects(cells, np.ones((1, len(levels))), self.noise, LEVEL)
        for family in (mains, firsts[len(mains) :]):  # p-values are corrected within each
            signs = np.array([[sign_of(cell, first) for cell in levels] for first in family], float)
            found += estimate_effects(cells, signs, self.noise, LEVEL) if family else []
        shown = [(MEAN, False), *((name, place < len(mains)) for place, name in enumerate(groups))]
        return [
            EffectLine(
                part=self.name,
                method=method,
                against=against,
                outcome=outcome,
                effect=effect,
                main=main,
                estimate=each.estimate,
                corrected=each.corrected,
                cells=len(levels),
            )
            for (effect, main), each in zip(shown, found, strict=True)
        ]


def _parts(table: Table) -> list[_Part]:
    """The parts of the design of which the table has rows."""
    design = table.design
    groups = {row.group for row in table.rows}
    found = []
    if design is not None and design.trained is not None and TRAINED in groups:
        found.append(_Part(design, TRAINED, design.trained, "cells"))
    if design is not None and design.tested is not None and TESTED in groups:
        found.append(_Part(design, TESTED, design.tested, "effects"))
    return found


def _common(methods: Sequence[Sequence[Cell]]) -> tuple[int, ...]:
    """Seeds that every cell of all methods has."""
    shared = set.intersection(*(set(cell) for cells in methods for cell in cells))
    if not shared:
        raise InputError("its cells have no seed in common; train the same seeds of each cell.")
    return tuple(sorted(shared))
