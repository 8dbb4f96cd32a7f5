"""Rare class sampling: training images drawn by a class that they show, rare classes more often.

It replaces the permutation of the split in every epoch (`data.sampling=rare_classes`). Each sample
has draws of its own (seed, purpose, epoch, number).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.labels import PixelCounts, pixels_of
from rgbt.data.loader_settings import LoaderSettings
from rgbt.dataset import LabelledDataset
from rgbt.types import Example

# Labels that are decoded at a time.
NUM_THREADS = 4

# Times that a crop is drawn again. Released: DAFormer, mmseg/datasets/uda_dataset.py.
MOST_REDRAWS = 10


def class_probabilities(pixels: PixelCounts, temperature: float) -> NDArray[np.float64]:
    """Compute the probability that each class is drawn, highest for the rarest.

        P(c) proportional to exp((1 - f_c) / T),   f_c the share of all pixels

    Source: DAFormer (Hoyer et al., CVPR 2022), Sec. 3.3.   Released: lhoyer/DAFormer (e6f6e04),
    mmseg/datasets/uda_dataset.py, get_rcs_class_probs: of the classes that occur; T = 0.01, in
    configs/daformer/gta2cs_uda_warm_fdthings_rcs_croppl_a999_daformer_mitb5_s0.py.

    `pixels` (C,) of each class, one at least above 0, give (C,) that sum to 1; a high `temperature`
    T > 0 draws all classes alike.
    """
    scaled = (1 - pixels / pixels.sum()) / temperature
    weights = np.exp(scaled - scaled.max())
    return np.asarray(weights / weights.sum())


@dataclass(frozen=True)
class RareClasses:
    """Draws images of a split by their classes.

    Attributes:
        classes: indices of the C classes that are drawn; `names` and `probabilities` (C,) are
            theirs.
        images: for each, positions in the list of the split of the images that show enough of it.
        min_crop_pixels: a crop with as many pixels of its class or fewer is drawn again, if given.
    """

    classes: tuple[int, ...]
    names: tuple[str, ...]
    probabilities: NDArray[np.float64]
    images: tuple[NDArray[np.int64], ...]
    min_crop_pixels: float | None

    def draw(self, rng: np.random.Generator) -> tuple[int, NDArray[np.int64]]:
        """Draw a class and the positions of its images: the drawn one, then the others in order."""
        number = int(rng.choice(len(self.classes), p=self.probabilities))
        images = self.images[number]
        return self.classes[number], np.roll(images, -int(rng.integers(len(images))))

    def shares(self) -> str:
        """Write the probability of each class, highest first: "fence 0.265, terrain 0.202"."""
        order = np.argsort(-self.probabilities, kind="stable")
        return ", ".join(f"{self.names[n]} {self.probabilities[n]:.3f}" for n in order)


def class_pixels(
    dataset: LabelledDataset, split: str, *, on_error: Literal["raise", "skip"] = "raise"
) -> PixelCounts:
    """Count pixels of each class in each label of a split as stored, (N, K), see `pixels_of`."""

    def counted(name: str) -> PixelCounts:
        return pixels_of(dataset, name, on_error)[:-1]

    with ThreadPoolExecutor(NUM_THREADS) as pool:
        return np.stack(list(pool.map(counted, dataset.names(split))))


def count_rare_classes(
    dataset: LabelledDataset, split: str, settings: LoaderSettings
) -> RareClasses:
    """Count the labels of a split, and decide how its images are drawn.

    An image is drawn for a class if it has more than `min_class_pixels` pixels of it, in the label
    as stored (Paper: any pixel.   Released: more than 3000). Classes that never occur are not
    drawn. Neither are those that no score has (`LabelledDataset.unscored`).

    InputError: a label cannot be read (on_error="raise"); a class occurs, but no image has enough
    of it; nothing is labelled.
    """
    pixels = class_pixels(dataset, split, on_error=settings.on_error)
    scored = np.array([name not in dataset.unscored for name in dataset.classes])
    classes = np.flatnonzero(scored & pixels.any(0))
    least = settings.min_class_pixels
    rare = [dataset.classes[index] for index in classes if pixels[:, index].max() <= least]
    if rare or not classes.size:
        raise InputError(
            f"data.min_class_pixels={least}: no image of {split} of {dataset.name} has more pixels "
            f"of '{rare[0] if rare else 'any class'}'; set a lower number, or "
            "data.sampling=shuffled."
        )
    return RareClasses(
        classes=tuple(classes.tolist()),
        names=tuple(dataset.classes[index] for index in classes),
        probabilities=class_probabilities(pixels.sum(0)[classes], settings.class_temperature),
        images=tuple(np.flatnonzero(pixels[:, index] > least) for index in classes),
        min_crop_pixels=settings.min_crop_ratio * least if settings.min_crop_ratio else None,
    )


def crop_showing(drawn: int, least: float | None, augment: Callable[[], Example]) -> Example:
    """Augment a sample until its crop shows more than `least` pixels of the class `drawn`.

    It is augmented again up to `MOST_REDRAWS` times; the last example is kept in any case.
    Released: more than half of 3000 pixels (DAFormer), or twice as many (HRDA, MIC). None: once.
    """
    example = augment()
    for _ in range(MOST_REDRAWS):
        if least is None or np.count_nonzero(example.label == drawn) > least:
            break
        example = augment()
    return example
