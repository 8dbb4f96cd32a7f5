"""Rare class sampling: its frequencies by hand, its crops, and its independence of workers."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from rgbt.data.loaders import LoaderSettings, train_batches
from rgbt.data.mfnet import MFNet
from rgbt.data.rare_classes import RareClassExamples, class_probabilities, count_rare_classes
from rgbt.randomness import numpy_generator
from rgbt.types import Batch
from tests.data.layouts import refused
from tests.transforms import recipes

PIXELS = {"1D": (768, 0, 0), "2D": (668, 100, 0), "3D": (628, 100, 40), "4D": (708, 0, 60)}
"""Pixels of the classes 0 to 2 in images of 24 x 32; 2772, 200 and 100 of 3072 in all."""


def settings(**changes: Any) -> LoaderSettings:
    base = LoaderSettings(2, 1, 0, class_temperature=0.5, min_class_pixels=50)
    return dataclasses.replace(base, sampling="rare_classes", **changes)


@pytest.fixture
def dataset(write_mfnet: Any, png: Callable[[Path, np.ndarray], None]) -> MFNet:
    found = MFNet(str(write_mfnet({"train": list(PIXELS)})))
    for name, counts in PIXELS.items():
        path = next(each for each in found.files(name) if "label" in str(each))
        png(path, np.repeat(np.arange(3, dtype=np.uint8), counts).reshape(24, 32))
    return found


def test_probability_by_hand() -> None:
    """Shares 0.6, 0.3 and 0.1: exp(4), exp(7) and exp(9) at T = 0.1."""
    weights = np.exp([4.0, 7.0, 9.0])
    found = class_probabilities(np.array([60, 30, 10]), 0.1)
    np.testing.assert_allclose(found, weights / weights.sum())
    assert class_probabilities(np.array([1, 10**9]), 1e-6).tolist() == [1.0, 0.0]


def test_images_are_drawn_with_the_frequencies_of_their_classes(dataset: MFNet) -> None:
    rare = count_rare_classes(dataset, "train", settings())
    weights = np.exp((1 - np.array([2772, 200, 100]) / 3072) / 0.5)
    p = weights / weights.sum()
    # Image 3 has too few pixels of class 2, which occurs in image 4 alone.
    expected = [p[0] / 4, p[0] / 4 + p[1] / 2, p[0] / 4 + p[1] / 2, p[0] / 4 + p[2]]
    count = 2000
    drawn = Counter(
        int(rare.draw(numpy_generator(0, "rare class", 0, number))[1][0]) for number in range(count)
    )
    for image, share in enumerate(expected):
        assert drawn[image] / count == pytest.approx(share, abs=4 * (share / count) ** 0.5)
    assert rare.classes == (0, 1, 2)
    assert rare.shares() == "person 0.473, car 0.444, unlabeled 0.083"


def test_unscored_classes_are_not_drawn(dataset: MFNet) -> None:
    dataset.unscored = ("unlabeled",)
    rare = count_rare_classes(dataset, "train", settings(class_temperature=0.1))
    weights = np.exp(np.array([1 / 3, 2 / 3]) / 0.1)
    assert rare.classes == (1, 2)
    np.testing.assert_allclose(rare.probabilities, weights / weights.sum())


def test_class_without_an_image_is_refused(dataset: MFNet) -> None:
    said = refused(lambda: count_rare_classes(dataset, "train", settings(min_class_pixels=60)))
    assert "pixels=60: no image of train of mfnet has more pixels of 'person'" in said
    dataset.unscored = dataset.classes
    assert "'any class'" in refused(lambda: count_rare_classes(dataset, "train", settings()))


@pytest.mark.parametrize(
    ("least", "pixels", "ratio", "calls"),
    [
        *[(50, [9, 25, 26, 99], 0.5, 3), (50, [0] * 20, 0.5, 11)],
        *[(50, [0, 99], 0.0, 1), (50, [26], 0.5, 1), (0, [0, 1], 0.5, 2), (0, [0], 0.0, 1)],
    ],
)
def test_crop_is_drawn_again_until_it_shows_enough(
    dataset: MFNet, least: int, pixels: list[int], ratio: float, calls: int
) -> None:
    """Half of 50 pixels, or one pixel, at most ten times again."""
    chosen = settings(min_class_pixels=least, min_crop_ratio=ratio)
    rare = count_rare_classes(dataset, "train", chosen)
    left: Iterator[int] = iter(pixels)
    seen = []

    def make(sample: Any, rng: np.random.Generator) -> Any:
        seen.append(rng.random())
        return SimpleNamespace(label=np.repeat(sample, next(left)))

    drawn, _ = rare.draw(numpy_generator(3, "rare class", 0, 5))
    source: Any = SimpleNamespace(
        names=list(PIXELS),
        first_readable=lambda names, skipped: drawn,
        transform=SimpleNamespace(train=make),
        seed=3,
    )
    RareClassExamples(source, rare)((0, 5), {})
    assert len(set(seen)) == len(seen) == calls
    # The draws of the augmentation are those of (seed, "augment", epoch, number) alone, and not
    # those that have chosen the class.
    assert seen == numpy_generator(3, "augment", 0, 5).random(calls).tolist()


def batches(dataset: MFNet, steps: range, seed: int = 7, **changes: Any) -> list[Batch]:
    given = settings(**changes)
    rare = count_rare_classes(dataset, "train", given)
    transform = recipes.crm(sizes=(16, 24, 40), crop_hw=(12, 16))
    found: Any = train_batches(dataset, "train", transform, given, seed, steps, rare)
    return list(found)


def test_same_batches_whatever_the_workers_and_the_first_step(dataset: MFNet) -> None:
    """Two steps per epoch; a run that resumes at step 3 has the batches of one that did not."""
    whole = batches(dataset, range(6))
    for workers in (0, 2):
        late = batches(dataset, range(3, 6), num_workers=workers)
        for one, other in zip(whole[3:], late, strict=True):
            assert one.name == other.name
            assert torch.equal(one.rgb, other.rgb)
    names = [batch.name for batch in whole]
    assert len(set(names)) > 1
    assert names != [batch.name for batch in batches(dataset, range(6), seed=8)]


def test_unreadable_images_are_skipped(dataset: MFNet) -> None:
    """Image 4 alone has class 2: without its label, images 2 and 3 are drawn."""
    for name in ("2D", "4D"):
        for path in dataset.files(name):
            path.write_bytes(b"damaged")
    found = batches(dataset, range(6), on_error="skip", min_class_pixels=30, class_temperature=0.01)
    assert {name for batch in found for name in batch.name} == {"3D"}
    assert "cannot be" in refused(lambda: count_rare_classes(dataset, "train", settings()))
