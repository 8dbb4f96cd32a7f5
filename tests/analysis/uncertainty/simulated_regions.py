"""Counts by region whose variance over regions is known: a small split like MFNet's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from rgbt.metrics.counts import Counts
from rgbt.metrics.scores import miou, variance
from tests.analysis.counts import counts_of

CLASSES = ("road", "car", "person", "bike", "curve", "guardrail")
SIZES = np.array([7.0, 5.0, 4.5, 4.0, 4.0, 4.0])
"""Mean logarithm of a class's pixels in a region that shows it."""

THERE = np.array([1.0, 0.8, 0.5, 0.3, 0.2, 0.05])
"""Share of the scenes that show a class; a region of such a scene shows it with `NEARBY`."""

NEARBY = 0.6
EFFECT = 0.6
"""Standard deviation of a scene's difficulty, on the logistic scale; again by region."""

NOISE = 0.4
MANY, STEP = 100_000, 5_000


@dataclass(frozen=True)
class Tilted:
    """Methods whose skill changes evenly from the first region to the last.

    Attributes:
        tilt: half of the change, on the logistic scale; 0: all regions are equally good.
        regions: R.
        block: neighbouring images that show one scene.
    """

    tilt: float
    regions: int = 5
    block: int = 1

    def draw(self, rng: np.random.Generator, images: int, *others: Tilted) -> list[Counts]:
        """Counts of this method, and of others on the same images."""
        sizes, effect = self._scenes(rng, images)
        return [
            counts_of(rng.multinomial(sizes, each._rows(rng, effect)), classes=CLASSES)
            for each in (self, *others)
        ]

    @property
    def true_variance(self) -> float:
        """Variance over regions of the expected counts of many images; squared percent points."""
        expected = _expected(self.tilt, self.regions)
        return float(variance(miou(expected, "released", None))) if self.tilt else 0.0

    @property
    def true_miou(self) -> float:
        """mIoU of the expected counts of many images, percent."""
        return 100 * float(miou(_expected(self.tilt, self.regions).sum(0), "released", None))

    def _scenes(self, rng: np.random.Generator, images: int) -> tuple[np.ndarray, np.ndarray]:
        """(images, R, K) pixels, and difficulty."""
        scenes, classes = -(-images // self.block), len(CLASSES)
        shown = rng.random((scenes, 1, classes)) < THERE
        shown = shown & (rng.random((scenes, self.regions, classes)) < NEARBY)
        shown[..., 0] = True
        sizes = rng.lognormal(SIZES, 0.6, shown.shape) * shown
        effect = rng.normal(0, EFFECT, (scenes, 1, classes))
        effect = effect + rng.normal(0, EFFECT, shown.shape)
        index = np.arange(images) // self.block
        return np.rint(sizes[index]).astype(np.int64), effect[index]

    def _rows(self, rng: np.random.Generator, effect: np.ndarray) -> np.ndarray:
        """(images, R, K, K) probabilities of the prediction by label; most errors are road."""
        skill = 1.0 + effect + rng.normal(0, NOISE, effect.shape)
        skill = skill + np.linspace(-self.tilt, self.tilt, self.regions)[:, None]
        skill[..., 0] += 3.0
        right = 1 / (1 + np.exp(-skill))
        others = len(CLASSES) - 1
        errors = np.full((others + 1, others + 1), 0.15 / (others - 1))
        errors[:, 0] = 0.85
        errors[0] = 1 / others
        np.fill_diagonal(errors, 0.0)
        rows: np.ndarray = (1 - right)[..., None] * errors
        rows[..., range(others + 1), range(others + 1)] = right
        return rows


@cache
def _expected(tilt: float, regions: int) -> np.ndarray:
    """(R, K, K) expected counts; which images show one scene does not matter."""
    method, rng = Tilted(tilt, regions), np.random.default_rng(99)
    expected = np.zeros((regions, len(CLASSES), len(CLASSES)))
    for _ in range(MANY // STEP):
        sizes, effect = method._scenes(rng, STEP)
        expected += (sizes[..., None] * method._rows(rng, effect)).sum(0)
    return expected
