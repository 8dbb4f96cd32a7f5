"""Counts drawn from a population whose scores are known, to see how often intervals are right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbt.metrics.counts import Counts
from tests.analysis import counts

CLASSES = ("road", "car", "person", "cone")
REGIONS = 2


@dataclass(frozen=True)
class Population:
    """Images with classes of changing sizes, and trainings of changing skill.

    A pixel of image i is right with probability ``logistic(skill +- tilt + image_i + training_s +
    e_is)``, plus in the one region and minus in the other; `block` neighbouring images share their
    ``image_i`` and their sizes.
    """

    skill: float = 1.5
    tilt: float = 0.4
    image_sd: float = 0.6
    training_sd: float = 0.0
    noise_sd: float = 0.4
    block: int = 1

    def draw(self, rng: np.random.Generator, images: int, trainings: int) -> np.ndarray:
        """(trainings, images, R, K, K) counts."""
        shared = Shared.draw(rng, self, images)
        return np.stack([shared.training(rng, self) for _ in range(trainings)])

    def pair(self, rng: np.random.Generator, images: int, trainings: int, other: Population):
        """Counts of two methods on the same images."""
        shared = Shared.draw(rng, self, images)
        methods = [[shared.training(rng, own) for _ in range(trainings)] for own in (self, other)]
        return np.stack(methods[0]), np.stack(methods[1])


@dataclass(frozen=True)
class Shared:
    sizes: np.ndarray  # (images, R, K)
    effect: np.ndarray  # (images,)

    @classmethod
    def draw(cls, rng: np.random.Generator, population: Population, images: int) -> Shared:
        scenes = -(-images // population.block)
        there = rng.random((scenes, REGIONS, len(CLASSES))) < np.array([1.0, 0.8, 0.5, 0.3])
        sizes = rng.lognormal(np.array([7.0, 5.0, 4.0, 3.0]), 0.6, there.shape) * there
        effect = rng.normal(0, population.image_sd, scenes)
        index = np.arange(images) // population.block
        return cls(np.rint(sizes[index]).astype(np.int64), effect[index])

    def training(self, rng: np.random.Generator, population: Population) -> np.ndarray:
        """(images, R, K, K): errors are spread evenly over the other classes."""
        skill = population.skill + self.effect + rng.normal(0, population.training_sd)
        skill = skill + rng.normal(0, population.noise_sd, len(skill))
        skill = skill[:, None, None] + np.array([-population.tilt, population.tilt])[:, None]
        right = rng.binomial(self.sizes, 1 / (1 + np.exp(-skill)))
        others = len(CLASSES) - 1
        wrong = rng.multinomial(self.sizes - right, [1 / others] * others)
        found = np.zeros((*self.sizes.shape, len(CLASSES)), np.int64)
        for row in range(len(CLASSES)):
            columns = [column for column in range(len(CLASSES)) if column != row]
            found[..., row, row] = right[..., row]
            found[..., row, columns] = wrong[..., row, :]
        return found


def pairs_of(
    images: int, agree: float, seed: int = 0, night: tuple[bool, ...] | None = None, sets: int = 3
) -> Counts:
    """Counts of pairs of frames with the same labels for every `agree` and `seed`.

    A frame is right on 70 % of the pixels of each class; the second one repeats what the first one
    said on the share `agree` of all pixels, and is drawn anew on the others.
    """
    classes = len(CLASSES)
    sizes = np.random.default_rng(0).lognormal(5.0, 1.0, (images, sets, classes)).astype(np.int64)
    right = 0.6 * np.eye(classes) + 0.1
    cells = np.stack([agree * np.diag(row) + (1 - agree) * np.outer(row, row) for row in right])
    drawn = np.random.default_rng([1, seed]).multinomial(sizes, cells.reshape(classes, -1))
    array = np.zeros((images, sets, classes + 1, classes, classes), np.int32)
    array[:, :, :classes] = drawn.reshape(images, sets, classes, classes, classes)
    flat = array.reshape(images, -1, classes, classes)
    return counts_of(flat, partition=f"aligned{sets}", night=night)


def counts_of(array: np.ndarray, **changed: Any) -> Counts:
    """(N, R, K, K) counts of the classes of the population."""
    given = {"classes": CLASSES, "partition": "ring2", "dataset": "simulated"}
    return counts.counts_of(array, **(given | changed))
