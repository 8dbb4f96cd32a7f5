"""Effects of the factors of a design, by method and outcome, from the finished runs of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from analysis.uncertainty import Resampling
from analysis.uncertainty.contrasts import Evidence, Resampler, Term, combine
from analysis.uncertainty.effects import Noise, estimate_effects
from analysis.uncertainty.estimates import Estimate
from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from sweeps.point import Outcome
from sweeps.table.cells import counts_path, is_counted, metric_of, world_evaluations
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
from sweeps.verdicts.contrasts import base_scores
from sweeps.verdicts.judge import RESAMPLES, CellRunId, finished_runs_of
from sweeps.verdicts.loaded_counts import LoadedCounts

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
    _counts: LoadedCounts = field(default_factory=LoadedCounts, init=False)

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
            found, reasons = self._counts_of(part, runs)
            missing |= dict.fromkeys(reasons)
            for outcome, method in product(part.design.outcomes, part.design.methods):
                try:
                    lines += self._of_method(part, outcome, method, found)
                except InputError as error:
                    missing[f"{part.name}, {method.name}, {outcome}: {error}"] = None
        return DesignEffects(tuple(lines), tuple(missing))

    def _counts_of(
        self, part: _Part, runs: Mapping[CellRunId, Outcome]
    ) -> tuple[dict[str, list[Cell]], list[str]]:
        """Counts of the methods that have them in every cell, and why others have not."""
        found, reasons = {}, []
        for method in part.design.methods:
            if all(label not in self._rows for label, _ in part.places(method.name)):
                continue  # rows=... left it out
            try:
                found[method.name] = self._cells(part, method.name, runs)
            except InputError as error:
                reasons.append(f"{part.name}, {method.name}: {error}")
        return found, reasons

    def _of_method(
        self,
        part: _Part,
        outcome: str,
        method: DesignMethod,
        found: Mapping[str, Sequence[Cell]],
    ) -> list[EffectLine]:
        """Effects on a method, and their difference to those on the method it is compared with."""
        own, other = found.get(method.name), found.get(method.against or "")
        if own is None:
            return []
        cells = self._evidence(outcome, own, _common([own]))
        lines = part.lines(method.name, "", outcome, cells)
        if other is not None and method.against is not None:
            seeds = _common([own, other])
            pairs = zip(
                *(self._evidence(outcome, each, seeds) for each in (own, other)), strict=True
            )
            differences = [combine((1.0, -1.0), pair) for pair in pairs]
            lines += part.lines(method.name, method.against, outcome, differences)
        return lines

    def _evidence(
        self, outcome: str, cells: Sequence[Cell], seeds: Sequence[int]
    ) -> list[Evidence]:
        """The outcome in every cell."""
        weights = self._weights(outcome)
        return [
            self._engine.evidence(
                [
                    Term(
                        weight=weight,
                        metric=metric,
                        counts={seed: cell[seed][1] for seed in seeds},
                        keys={seed: cell[seed][0] for seed in seeds},
                    )
                    for metric, weight in weights.items()
                ]
            )
            for cell in cells
        ]

    def _weights(self, outcome: str) -> dict[str, float]:
        """Metric -> weight of an outcome."""
        row = next(row for row in self.table.rows if row.group)
        weights: dict[str, float] = {}
        for weight, column in base_scores(self.table, row, outcome):
            if not is_counted(column) or counts_path(column, self.table) != self._plain_path:
                raise InputError(f"'{column.name}' is no score of the plain test images.")
            metric = metric_of(column, row)
            weights[metric] = weights.get(metric, 0.0) + weight
        return weights

    @property
    def _plain_path(self) -> str:
        """Path of the counts of the plain test images, relative to the run folder."""
        return counts_path(Column(name=names.MIOU, metric=names.MIOU), self.table)

    def _cells(self, part: _Part, method: str, runs: Mapping[CellRunId, Outcome]) -> list[Cell]:
        """The counts of a method in every cell.

        Raises:
            InputError: a cell without a finished run, or counts that are missing or damaged.
        """
        cells: list[Cell] = []
        for label, world in part.places(method):
            finished = finished_runs_of(label, runs)
            path = self._plain_path
            if world:
                path = world_evaluations(self.table, self._rows[label])[world].path
            cells.append(
                {
                    seed: (f"{run.key}/{path}", self._counts.of(run, path))
                    for seed, run in finished.items()
                }
            )
        return cells


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
