"""Counts whose scores are planted: a mean, noise of the seed, noise of every image."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rgbt.metrics.counts import Counts
from rgbt.runs.folder import counts_name
from sweeps.point import Outcome, Point, State
from tests.sweeps.fakes import DATASET, finish
from tests.sweeps.tabled import outcome

IMAGES, PIXELS = 24, 1000
SEED_SD, IMAGE_SD = 0.5, 1.0
"""Of the accuracy in percent: over seeds, and over images."""


def planted(mean: float, name: str, seed: int, split: str = "test") -> Counts:
    """Counts of one region whose pixel accuracy is about `mean` percent.

    The noise of an image is that of all rows; the noise of a seed is the row's own.
    """
    images = np.random.default_rng(0).normal(0.0, IMAGE_SD, IMAGES)
    of_seed = np.random.default_rng([zlib.crc32(name.encode()), seed]).normal(0.0, SEED_SD)
    right = np.round(PIXELS * (mean + of_seed + images) / 100).astype(np.int64)
    counts = np.zeros((IMAGES, 1, 2, 2), np.int64)
    counts[:, 0, 0] = np.stack([right, PIXELS - right], axis=1)
    return Counts(
        counts=counts,
        names=tuple(f"{index:05d}" for index in range(IMAGES)),
        night=None,
        classes=("road", "car"),
        partition="ring1",
        dataset=DATASET,
        split=split,
    )


def finish_planted(folder: Path, mean: float, name: str, seed: int) -> None:
    """Write the finished run whose accuracy on both splits is about `mean` percent."""
    folder.mkdir(parents=True, exist_ok=True)
    made = planted(mean, name, seed, "val")
    made.save(folder / counts_name("val"))
    accuracy = float(made.counts[:, 0, 0, 0].sum() / (IMAGES * PIXELS))
    scores = {"pixel_accuracy": accuracy, "mIoU": accuracy / 2, "Var": 0.0}
    finish(folder, val=scores, test=scores)


def planted_outcome(point: Point, mean: float, name: str, seed: int) -> Outcome:
    """A finished run in memory."""
    return replace(outcome(f"{name} {seed}", planted(mean, name, seed)), point=point)


def in_state(outcomes: Sequence[Outcome], state: State, reason: str = "") -> list[Outcome]:
    """The same points without results, in another state."""
    return [Outcome(each.point, state, reason) for each in outcomes]
