"""Effects of the factors of a design, by method and outcome, as one frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from analysis.uncertainty.contrasts import Evidence, Term, combine
from analysis.uncertainty.effects import Noise, estimate_effects
from analysis.uncertainty.estimates import Estimate
from rgbt.checks import InputError
from rgbt.tables import ABSENT
from sweeps.point import Outcome
from sweeps.table.design import Design, sign_of
from sweeps.verdicts.judge import Cell, CellRunId, TableJudge

if TYPE_CHECKING:
    import pandas as pd

NOISE: Mapping[str, Noise] = {"trained": "cells", "tested": "effects"}

# Name of the line that is no effect: the outcome itself.
MEAN = "mean of all cells"

NUMBERS = ("value", "low", "high", "p", "p_holm")
COLUMNS = (
    "part",
    "outcome",
    "method",
    "against",
    "effect",
    *NUMBERS,
    "shown",
    "error_seeds",
    "error_images",
    "seeds",
    "cells",
)


class Effects(NamedTuple):
    """What the finished runs of a design show, and sentences on methods that lack runs.

    `frame` has one effect a row and the columns `COLUMNS`. `low` and `high` are the ends of the
    interval over images and seeds. `p_holm` is corrected for the main effects, or the interactions,
    of a method; `shown` says whether the effect differs from 0 by it. Errors are standard errors.
    """

    frame: pd.DataFrame
    missing: tuple[str, ...]


def effects_of(judge: TableJudge, runs: Mapping[CellRunId, Outcome]) -> Effects:
    """Every effect on a method that finished runs allow, and its difference to that on another."""
    import pandas as pd

    design, labels = judge.table.design, {row.label for row in judge.table.rows}
    assert design is not None, "effects are those of a design"
    rows: list[dict[str, Any]] = []
    missing: dict[str, None] = {}
    for part, outcome, method in product(design.parts, design.outcomes, design.methods):
        if labels.isdisjoint(row for row, _ in design.places(part, method.name)):
            continue  # rows=... left it out
        try:
            own = _cells(judge, part, method.name, outcome, runs)
            found = {"": _evidence(judge, own, _common(own))}
        except InputError as error:
            missing[f"{part}, {method.name}: {error}"] = None
            continue
        try:
            other = _cells(judge, part, method.against or "", outcome, runs)
            seeds = _common([*own, *other])
            sides = (_evidence(judge, each, seeds) for each in (own, other))
            differences = [combine((1.0, -1.0), pair) for pair in zip(*sides, strict=True)]
            found[method.against or ""] = differences
        except InputError:  # its missing runs are named with that method
            pass
        for against, cells in found.items():
            place = {"part": part, "outcome": outcome, "method": method.name, "against": against}
            rows += [{**place, **each} for each in _lines(design, part, against, cells)]
    return Effects(pd.DataFrame(rows, columns=list(COLUMNS)), tuple(missing))


def _cells(
    judge: TableJudge, part: str, method: str, outcome: str, runs: Mapping[CellRunId, Outcome]
) -> list[list[Term]]:
    """The scores of the outcome in every cell; InputError where a cell has none."""
    assert judge.table.design is not None, "cells are those of a design"
    places = judge.table.design.places(part, method)
    return [judge.terms([Cell(1.0, row, outcome, world)], runs) for row, world in places]


def _common(cells: Sequence[Sequence[Term]]) -> list[int]:
    """Seeds that every cell has."""
    shared = set.intersection(*(set(term.counts) for cell in cells for term in cell))
    if not shared:
        raise InputError("its cells have no seed in common; train the same seeds of each cell.")
    return sorted(shared)


def _evidence(
    judge: TableJudge, cells: Sequence[Sequence[Term]], seeds: Sequence[int]
) -> list[Evidence]:
    return [
        judge.worlds.evidence(
            [
                replace(
                    term,
                    counts={seed: term.counts[seed] for seed in seeds},
                    keys={seed: term.keys[seed] for seed in seeds},
                )
                for term in cell
            ]
        )
        for cell in cells
    ]


def _lines(
    design: Design, part: str, against: str, cells: Sequence[Evidence]
) -> Iterator[dict[str, Any]]:
    """The mean of all cells, then every effect; p-values are corrected within each family."""
    levels, groups = design.cells(part), design.effects(part)
    firsts = [next(iter(effects)) for effects in groups.values()]
    mains = sum(len(first) == 1 for first in firsts)
    found = estimate_effects(cells, np.ones((1, len(levels))), NOISE[part])
    for family in filter(None, (firsts[:mains], firsts[mains:])):
        signs = np.array([[sign_of(cell, first) for cell in levels] for first in family], float)
        found += estimate_effects(cells, signs, NOISE[part])
    for name, estimate in zip((MEAN, *groups), found, strict=True):
        evidence, around = estimate.evidence, estimate.both
        ends = (math.nan,) * 3 if around is None else (around.low, around.high, estimate.p)
        yield {
            "effect": name,
            **dict(zip(NUMBERS, (estimate.value, *ends, estimate.p_corrected), strict=True)),
            "shown": ABSENT if name == MEAN and not against else _word(estimate),
            "error_seeds": evidence.trainings.error if evidence.trainings else math.nan,
            "error_images": evidence.error,
            "seeds": estimate.seeds,
            "cells": len(levels),
        }


def _word(estimate: Estimate) -> str:
    if estimate.both is None:
        return "2 seeds needed" if estimate.seeds < 2 else "too few images"
    if not estimate.is_shown():
        return "no"
    return "higher" if estimate.value > 0 else "lower"
