"""Counts and finished runs with planted scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rgbt.metrics.counts import Counts
from sweeps.point import Outcome
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


def planted(rows: Mapping[str, Sequence[float]]) -> dict[tuple[str, int], Outcome]:
    """Runs whose pixel accuracy is as given, by label and seed."""
    return {
        (label, seed): outcome(f"{label}{seed}", accuracy(share, seed))
        for label, shares in rows.items()
        for seed, share in enumerate(shares)
    }
