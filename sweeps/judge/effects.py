"""Effects of the factors of a design, by method and outcome, as one frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.uncertainty.contrasts import Evidence, Term, combine
from analysis.uncertainty.effects import Noise, estimate_effects
from analysis.uncertainty.estimates import Estimate
from rgbt.checks import InputError
from rgbt.tables import ABSENT
from sweeps.judge.contrasts import Cell
from sweeps.judge.judged_table import JudgedTable
from sweeps.judge.seeds import with_seeds
from sweeps.plan.design import TESTED, TRAINED, Design, sign_of

if TYPE_CHECKING:
    import pandas as pd

NOISE: dict[str, Noise] = {TRAINED: "cells", TESTED: "effects"}

# Name of the line that is no effect: the outcome itself.
MEAN = "mean of all cells"

# Word for an effect of seeds whose number may depend on results: its interval is no verdict.
EXPLORED = "explored"

COLUMNS = ["part", "outcome", "method", "against", "effect", "value", "low", "high", "p"]
COLUMNS += ["p_holm", "shown", "error_seeds", "error_images", "seeds", "cells"]


def effects_of(judged: JudgedTable) -> tuple[pd.DataFrame, list[str]]:
    """Estimate every effect on a method that finished runs allow, and its difference to another.

    Returns:
        one effect a row, with the columns `COLUMNS`: `low` and `high` are the ends of the interval
        over images and seeds, `p_holm` is corrected for the main effects, or the interactions, of a
        method, `shown` says whether the effect differs from 0 by it (of declared seeds alone),
        errors are standard errors. And a sentence on each method that lacks runs. Both are empty
        without a design.
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    lacking: list[str] = []
    design = judged.request.table.design
    if design is None:
        return pd.DataFrame(columns=COLUMNS), []
    labels = {row.label for row in judged.request.table.rows}
    for part, outcome, method in product(design.parts, design.outcomes, design.methods):
        if labels.isdisjoint(row for row, _ in design.places(part, method.name)):
            continue  # rows=... left it out
        try:
            own = _cells(judged, design, part, method.name, outcome)
            seeds, is_declared = _seeds_of(judged, own)
            evidences = _evidences(judged, own, seeds)
        except InputError as error:
            lacking.append(f"{part}, {method.name}: {error}")
            continue
        start = {"part": part, "outcome": outcome, "method": method.name, "against": ""}
        rows += _lines(start, design, evidences, is_declared=is_declared)
        if method.against is None:
            continue
        try:
            other = _cells(judged, design, part, method.against, outcome)
            seeds, is_declared = _seeds_of(judged, [*own, *other])
        except InputError:  # its missing runs are named with that method
            continue
        sides = (_evidences(judged, own, seeds), _evidences(judged, other, seeds))
        differences = [combine((1.0, -1.0), pair) for pair in zip(*sides, strict=True)]
        start["against"] = method.against
        rows += _lines(start, design, differences, is_declared=is_declared)
    return pd.DataFrame(rows, columns=COLUMNS), list(dict.fromkeys(lacking))


def _cells(
    judged: JudgedTable, design: Design, part: str, method: str, outcome: str
) -> list[list[Term]]:
    """The scores of the outcome in every cell; InputError where a cell has none."""
    places = design.places(part, method)
    return [judged.terms([Cell(1.0, row, outcome, world)]) for row, world in places]


def _seeds_of(judged: JudgedTable, cells: Sequence[Sequence[Term]]) -> tuple[list[int], bool]:
    """The seeds of all cells: those that the table declares, or others; and whether declared."""
    shared = set.intersection(*(set(term.counts) for cell in cells for term in cell))
    declared = set(judged.request.table.confirm)
    if declared and declared <= shared:
        return sorted(declared), True
    if not shared - declared:
        raise InputError("its cells have no seed in common; train the same seeds of each cell.")
    return sorted(shared - declared), False


def _evidences(
    judged: JudgedTable, cells: Sequence[Sequence[Term]], seeds: Sequence[int]
) -> list[Evidence]:
    """The evidence about every cell, by these seeds alone."""
    evidences = []
    for cell in cells:
        terms = [with_seeds(term, seeds) for term in cell]
        evidences.append(judged.resampler("names").evidence(terms))
    return evidences


def _lines(
    start: dict[str, Any], design: Design, cells: Sequence[Evidence], *, is_declared: bool
) -> list[dict[str, Any]]:
    """The mean of all cells, then every effect; p-values are corrected within each family."""
    part = start["part"]
    levels, groups = design.cells(part), design.effects(part)
    firsts = [next(iter(effects)) for effects in groups.values()]
    mains = sum(len(first) == 1 for first in firsts)
    estimated = estimate_effects(cells, np.ones((1, len(levels))), NOISE[part])
    for family in (firsts[:mains], firsts[mains:]):
        if family:
            signs = np.array([[sign_of(cell, first) for cell in levels] for first in family], float)
            estimated += estimate_effects(cells, signs, NOISE[part])
    lines = []
    for name, estimate in zip((MEAN, *groups), estimated, strict=True):
        evidence, interval = estimate.evidence, estimate.both
        trainings = evidence.trainings
        is_plain_mean = name == MEAN and not start["against"]
        lines.append(
            {
                **start,
                "effect": name,
                "value": estimate.value,
                "low": math.nan if interval is None else interval.low,
                "high": math.nan if interval is None else interval.high,
                "p": math.nan if interval is None else estimate.p,
                "p_holm": estimate.p_corrected,
                "shown": ABSENT if is_plain_mean else _word(estimate, is_declared=is_declared),
                "error_seeds": trainings.error if trainings else math.nan,
                "error_images": evidence.error,
                "seeds": estimate.seeds,
                "cells": len(levels),
            }
        )
    return lines


def _word(estimate: Estimate, *, is_declared: bool) -> str:
    if not is_declared:
        return EXPLORED
    if estimate.both is None:
        return "2 seeds needed" if estimate.seeds < 2 else "too few images"
    if not estimate.is_shown():
        return "no"
    return "higher" if estimate.value > 0 else "lower"
