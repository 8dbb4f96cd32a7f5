"""Counts, finished runs and judged tables with planted scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rgbt.metrics.counts import Counts
from sweeps.judge.judged_table import JudgedTable
from sweeps.plan.request import RowSeed, TableRequest
from sweeps.plan.table import Table
from sweeps.point import Outcome
from sweeps.score.cells import CellId, TableCell
from tests.sweeps.tabled import counts_of, outcome

IMAGES, PIXELS = 40, 400


def accuracy(percent: float, seed: int = 0) -> Counts:
    """Counts of images of two regions, `percent` right up to the noise of single pixels.

    The noise of an image is the same for equal seeds.
    """
    half = PIXELS // 2
    right = np.random.default_rng(seed).binomial(half, percent / 100, (IMAGES, 2, 2))
    matrices = np.stack([right, half - right], -1)  # row: label, column: prediction
    matrices[:, :, 1] = matrices[:, :, 1, ::-1]
    return counts_of(*matrices, night=None)


def planted(rows: Mapping[str, Sequence[float]]) -> dict[RowSeed, Outcome]:
    """Runs whose pixel accuracy is as given, by label and seed."""
    return {
        (label, seed): outcome(f"{label}{seed}", accuracy(share, seed))
        for label, shares in rows.items()
        for seed, share in enumerate(shares)
    }


def judged(
    table: Table,
    runs: Mapping[RowSeed, Outcome],
    sizes: Mapping[CellId, TableCell] | None = None,
    name: str = "own/t",
) -> JudgedTable:
    """A table with these runs, judged by few resamples."""
    request = TableRequest(name, table, "demo", (0,))
    return JudgedTable(request=request, runs=runs, sizes=sizes or {}, resamples=200)
