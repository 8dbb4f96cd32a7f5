"""Training samples per second, from files to tensors, compared with the CRM release.

Run: python -m tests.benchmarks.bench_loading [folder in MFNet's layout with a train list] [draws]

The recipe of MFNet: 480x640 pixels, a crop of 240x320 out of short edges 240 to 960, colours, flip.
Every way is measured in the same rounds, one after the other: CPU time where the process itself
reads, wall time with two worker processes. "device" leaves the pixels to the device: its rows count
what the CPU does up to there. With a number of draws, the distribution of both is compared as well
(10,000 take ten minutes on an idle machine).
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader

from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.data.cache import CachedDataset
from rgbt.data.loaders import LoaderSettings, train_batches
from rgbt.data.mfnet import MFNet
from rgbt.dataset import LabelledDataset
from rgbt.synth.datasets import synth
from rgbt.transforms.crm import CrmTransform
from tests.benchmarks.released_loading import ReleasedSamples
from tests.benchmarks.timing import seconds

WANTED = 10.0
ROUNDS = 3
BATCH = 14
STEPS = 8
NUM_CLASSES = 9

Way = Callable[[int], Iterator[Any]]


def transform(name: str) -> CrmTransform:
    made: CrmTransform = build(compose([f"transform={name}", "scale=paper"]).transform)
    return made


def ours(dataset: LabelledDataset) -> Way:
    chain = transform("crm")

    def batches(workers: int) -> Iterator[Any]:
        settings = LoaderSettings(BATCH, 1, workers)
        return train_batches(dataset, "train", chain, settings, 0, range(10**6))

    return batches


def released(dataset: MFNet) -> Way:
    samples = ReleasedSamples(dataset.root, dataset.names("train"))

    def batches(workers: int) -> Iterator[Any]:
        loader = DataLoader(
            samples, BATCH, shuffle=True, num_workers=workers, collate_fn=list, drop_last=True
        )
        while True:
            yield from loader

    return batches


def per_sample(batches: Iterator[Any]) -> tuple[float, float]:
    """CPU and wall seconds of one sample, after a first batch."""
    next(batches)
    cpu, wall = seconds(lambda: [next(batches) for _ in range(STEPS)])
    return cpu / STEPS / BATCH, wall / STEPS / BATCH


def speeds(dataset: MFNet, cache: Path) -> None:
    mapped = CachedDataset(dataset, str(cache))
    _, built = seconds(lambda: [mapped.read(name) for name in dataset.names("train")])
    ways: dict[str, Way] = {
        "release": released(dataset),
        "files": ours(dataset),
        "cache": ours(mapped),
    }
    found = np.full((2, len(ways), ROUNDS), math.nan)
    for turn in range(ROUNDS):
        for row, way in enumerate(ways.values()):
            found[0, row, turn] = per_sample(way(0))[0]
            found[1, row, turn] = per_sample(way(2))[1]
    best = found.min(-1) * 1e3
    print(f"cache of {len(dataset.names('train'))} images built in {built:.1f} s")
    print(f"{'':<16}{'one process, CPU':>24}{'two workers':>24}")
    for row, name in enumerate(ways):
        cells = (f"{best[c, row]:8.2f} ms {best[c, 0] / best[c, row]:6.1f}x" for c in (0, 1))
        print(f"{name:<16}{'':>5}{'     '.join(cells)}")
    print(f"a sample, best of {ROUNDS}; wanted: {WANTED:.0f}x")


def moments(images: Iterator[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """(draws, 4 + 4 + 9): mean and standard deviation of each channel, share of each class."""
    rows = []
    for image, label in images:
        pixels = image.reshape(4, -1)
        shares = np.bincount(label.ravel(), minlength=NUM_CLASSES)[:NUM_CLASSES] / label.size
        rows.append(np.concatenate([pixels.mean(1), pixels.std(1), shares]))
    return np.array(rows)


def compare(dataset: MFNet, cache: Path, draws: int) -> None:
    """Means over draws of the release's chain, of ours set as released, and of ours as meant."""
    names = dataset.names("train")
    samples = ReleasedSamples(dataset.root, names)
    rng = np.random.default_rng(1)
    mapped = CachedDataset(dataset, str(cache))

    def theirs() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for index in rng.integers(len(names), size=draws):
            made = samples[int(index)]
            yield made["image"].numpy(), made["label"].numpy()

    def mine(chain: CrmTransform) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        settings = LoaderSettings(10, 1, 0)
        for batch in train_batches(mapped, "train", chain, settings, 0, range(draws // 10)):
            moved = batch.to("cpu")
            images = torch.cat([moved.rgb, moved.thermal], 1).numpy() * 255
            yield from zip(images, moved.label.numpy(), strict=True)

    found = {
        "release": moments(theirs()),
        "crm_released": moments(mine(transform("crm_released"))),
        "crm": moments(mine(transform("crm"))),
    }
    titles = [f"{what} {c}" for what in ("mean", "std") for c in "RGBT"]
    titles += [f"class {k} %" for k in range(NUM_CLASSES)]
    factor = np.array([1.0] * 8 + [100.0] * NUM_CLASSES)
    print(f"{draws} draws; in brackets the difference to the release in standard errors")
    print(f"{'':<10}" + "".join(f"{name:>24}" for name in found))
    base = found["release"]
    for column, title in enumerate(titles):
        cells = []
        for values in found.values():
            both = (base[:, column], values[:, column])
            error = math.sqrt(sum(each.var() / len(each) for each in both)) or math.inf
            gap = (both[1].mean() - both[0].mean()) / error
            cells.append(f"{both[1].mean() * factor[column]:>15.3f} ({gap:+5.1f})")
        print(f"{title:<10}" + "".join(f"{cell:>24}" for cell in cells))


def main(root: str | None, draws: int) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    with tempfile.TemporaryDirectory() as scratch:
        if root is None:
            small = {"num_train": 28, "num_val": 1, "num_test": 1}
            dataset = synth(cache_dir=scratch, height=480, width=640, **small)
        else:
            dataset = MFNet(root)
        speeds(dataset, Path(scratch) / "decoded")
        if draws:
            compare(dataset, Path(scratch) / "decoded", draws)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None, int(sys.argv[2]) if len(sys.argv) > 2 else 0)
