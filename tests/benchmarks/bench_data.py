"""The data path: embedded scenes, and training samples of MFNet's recipe from files and cache.

The recipe: 480x640 pixels, a crop of 240x320 out of short edges 240 to 960, colours, flip. The
baseline is OpenCV reading the same two files and resizing them whole to the mean of these sizes,
as a release does before it crops. All ways take turns; CPU milliseconds of one thread.

Run: python -m tests.benchmarks.bench_data [folder in MFNet's layout with a train list]
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.benchmarks.timing import medians  # isort: skip - before torch

import cv2
import torch

from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.data.cache import CachedDataset
from rgbt.data.loaders import LoaderSettings, train_batches
from rgbt.data.mfnet import MFNet
from rgbt.dataset import LabelledDataset
from rgbt.synth.datasets import synth
from rgbt.synth.factors import SceneFactors
from rgbt.synth.scene import render_scene

SAMPLES, ROUNDS = 28, 5
MEAN_EDGE = 600


def samples(dataset: LabelledDataset) -> Iterator[object]:
    """Endless batches of one sample in this process, as a training reads them."""
    chain = build(compose(["transform=crm", "scale=paper"]).transform)
    return train_batches(dataset, "train", chain, LoaderSettings(1, 1, 0), 0, range(10**6))


def resized(root: Path, names: tuple[str, ...]) -> None:
    """Read and resize `SAMPLES` pairs with their labels."""
    for number in range(SAMPLES):
        name = f"{names[number % len(names)]}.png"
        image = cv2.imread(str(root / "images" / name), cv2.IMREAD_UNCHANGED)
        label = cv2.imread(str(root / "labels" / name), cv2.IMREAD_UNCHANGED)
        size = (MEAN_EDGE * image.shape[1] // image.shape[0], MEAN_EDGE)
        cv2.resize(image.astype("float32"), size, interpolation=cv2.INTER_LINEAR)
        cv2.resize(label, size, interpolation=cv2.INTER_NEAREST)


def take(batches: Iterator[object]) -> None:
    for _ in range(SAMPLES):
        next(batches)


def scenes(factors: SceneFactors) -> None:
    for index in range(SAMPLES):
        render_scene(0, index, factors)


def main(root: str | None) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    with TemporaryDirectory() as scratch:
        sizes = {"num_train": SAMPLES, "num_val": 1, "num_test": 1}
        files = MFNet(root) if root else synth(cache_dir=scratch, height=480, width=640, **sizes)
        cached = CachedDataset(files, str(Path(scratch, "decoded")))
        calls = {
            "files, resized whole": partial(resized, files.root, files.names("train")),
            "sample from files": partial(take, samples(files)),
            "sample from the cache": partial(take, samples(cached)),
            "embedded scene of 120x160": partial(scenes, SceneFactors()),
        }
        found = {name: 1e3 * cpu / SAMPLES for name, (cpu, _) in medians(calls, ROUNDS).items()}
    baseline = found["files, resized whole"]
    for name, ms in found.items():
        ratio = "" if "scene" in name else f"{baseline / ms:8.2f}x"
        print(f"{name:<28}{ms:8.2f} CPU ms{ratio}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
