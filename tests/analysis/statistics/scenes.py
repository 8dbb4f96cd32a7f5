"""Data sets in memory and statistics made by hand, for the tests of this folder."""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.statistics.collect import SpatialStatistics
from rgbt.data.mfnet import CLASSES, PALETTE
from rgbt.types import Sample

Array = np.ndarray[Any, Any]


class InMemory:
    """A data set of given samples; day or night by the last letter of the name."""

    name = "memory"
    classes = CLASSES
    palette = PALETTE
    unscored: tuple[str, ...] = ()
    background: tuple[str, ...] = ("unlabeled",)

    def __init__(self, samples: list[Sample]) -> None:
        self.samples = {sample.name: sample for sample in samples}

    def names(self, split: str) -> tuple[str, ...]:
        return tuple(self.samples)

    def read(self, name: str) -> Sample:
        return self.samples[name]

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        if not all(name[-1] in "DN" for name in names):
            return None
        return tuple(name.endswith("N") for name in names)

    def fingerprint(self) -> str:
        return "f" * 64


def random_sample(name: str, hw: tuple[int, int], rng: np.random.Generator) -> Sample:
    """Noise everywhere, some pixels ignored."""
    label = rng.integers(0, 9, hw, dtype=np.uint8)
    label[rng.random(hw) < 0.1] = 255
    rgb = rng.integers(0, 256, (*hw, 3), dtype=np.uint8)
    return Sample(rgb, rng.integers(0, 256, hw, dtype=np.uint8), label, name)


def made(
    *,
    images: int = 40,
    regions: int = 3,
    classes: tuple[str, ...] = ("unlabeled", "car", "curve", "bump"),
    background: tuple[str, ...] = ("unlabeled",),
    partition: str = "",
    night: bool = True,
    **given: Array,
) -> SpatialStatistics:
    """Statistics of `images` images, half of them at night, all alike but for what is `given`."""
    values: dict[str, Any] = {
        "labels": np.full((images, regions, len(classes)), 100, np.int64),
        "ignored": np.zeros((images, regions), np.int64),
        "laplacian": np.full((images, 2, regions), 10.0),
        "mean": np.full((images, 2, regions), 100.0),
    }
    noise = given.pop("noise", np.full((images, 2, regions), 2.0))
    at_night = np.arange(images) >= images // 2
    region_map = np.repeat(np.arange(regions, dtype=np.uint8), 4).reshape(regions, 4)
    return SpatialStatistics(
        dataset="made",
        fingerprint="0" * 64,
        split="train",
        classes=classes,
        background=background,
        partition=partition or f"ring{regions}",
        region_map=region_map,
        kernel="four",
        names=tuple(f"{n:05d}{'DN'[int(late)]}" for n, late in enumerate(at_night)),
        night=at_night if night else None,
        occupied=np.zeros((2, len(classes), *region_map.shape), np.int32),
        noise=np.stack([noise] * 3, axis=1),
        **(values | given),
    )
