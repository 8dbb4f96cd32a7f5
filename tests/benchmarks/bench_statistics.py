"""Statistics of 200 images of 480x640 in 9 rings: ours against a mask per ring, one run.

Run: python -m tests.benchmarks.bench_statistics
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from analysis.statistics.collect import MeasurementSettings, collect
from analysis.statistics.data import SpatialStatistics
from analysis.statistics.measure import ESTIMATORS, MEDIAN_OF_NORMAL
from rgbt.data.mfnet import MFNet
from rgbt.metrics.metric import Regions
from rgbt.types import Sample
from tests.analysis.statistics.scenes import InMemory
from tests.benchmarks.timing import seconds

HW = (480, 640)
CLASSES = 9
IMAGES = 200
RINGS = Regions(partition="ring", regions=9, aspect="image", absent="released")
DIFFERENCE = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float64)
Arrays = dict[str, np.ndarray[Any, Any]]


def scenes(rng: np.random.Generator) -> list[Sample]:
    """Blurred noise with blocks of classes: 40 different pairs, five times each."""

    def texture(channels: int) -> np.ndarray[Any, Any]:
        noise = rng.integers(0, 256, (*HW, channels), dtype=np.uint8)
        return cv2.GaussianBlur(noise, (5, 5), 1.0)

    made = []
    for index in range(IMAGES // 5):
        coarse = np.where(rng.random((24, 32)) < 0.1, rng.integers(1, CLASSES, (24, 32)), 0)
        label = cv2.resize(coarse.astype(np.uint8), HW[::-1], interpolation=cv2.INTER_NEAREST)
        made.append(Sample(texture(3), texture(1), label, f"{index:05d}{'DN'[index % 2]}"))
    return [
        Sample(each.rgb, each.thermal, each.label, f"{copy}{each.name}")
        for copy in range(5)
        for each in made
    ]


def by_masks(samples: list[Sample], region_map: np.ndarray[Any, Any]) -> Arrays:
    """As one would write it: a boolean mask per ring, for every image and modality."""
    regions = range(int(region_map.max()) + 1)
    occupied = np.zeros((2, CLASSES, *HW), np.int32)
    labels = np.zeros((len(samples), len(regions), CLASSES), np.int64)
    values = np.zeros((2 + len(ESTIMATORS), len(samples), 2, len(regions)))
    for n, sample in enumerate(samples):
        for k in range(CLASSES):
            occupied[int(sample.name.endswith("N")), k] += sample.label == k
        for r in regions:
            labels[n, r] = np.bincount(sample.label[region_map == r], minlength=CLASSES)
        for m, image in enumerate((cv2.cvtColor(sample.rgb, cv2.COLOR_RGB2GRAY), sample.thermal)):
            for r in regions:
                values[:, n, m, r] = one_region(image, region_map == r)
    laplacian, mean, *noise = values
    found = {"occupied": occupied, "labels": labels, "laplacian": laplacian, "mean": mean}
    return found | dict(zip(ESTIMATORS, noise))


def filters(image: np.ndarray[Any, Any]) -> tuple[np.ndarray[Any, Any], ...]:
    wide = image.astype(np.float64)
    laplacian = cv2.Laplacian(wide, cv2.CV_64F)
    difference = np.abs(cv2.filter2D(wide, cv2.CV_64F, DIFFERENCE))
    haar = np.abs(wide[::2, ::2] - wide[::2, 1::2] - wide[1::2, ::2] + wide[1::2, 1::2])
    return laplacian, difference, haar


_last: list[Any] = [None, None]


def one_region(image: np.ndarray[Any, Any], mask: np.ndarray[Any, Any]) -> tuple[float, ...]:
    # Filtered once per image, not once per region: the masks alone are the difference.
    if _last[0] is not image:
        _last[:] = [image, filters(image)]
    laplacian, difference, haar = _last[1]
    inside = mask[1:-1, 1:-1]
    spread = np.sqrt(np.pi / 2) / 6 * difference[1:-1, 1:-1][inside].mean()
    magnitudes = haar[mask[::2, ::2]]
    values, counts = np.unique(magnitudes, return_counts=True)
    edges = np.append(np.maximum(values - 0.5, 0), values[-1] + 0.5)
    # Values that do not occur leave gaps, which hold no mass: the upper end is of the last one.
    k = int(np.searchsorted(counts.cumsum(), len(magnitudes) / 2))
    share = (len(magnitudes) / 2 - counts[:k].sum()) / counts[k]
    median = edges[k] + (values[k] + 0.5 - edges[k]) * share
    pixels = image[mask]
    return (
        laplacian[mask].var(),
        pixels.mean(),
        spread,
        median / 2 / MEDIAN_OF_NORMAL,
        pixels.std(),
    )


def same(stats: SpatialStatistics, expected: Arrays) -> None:
    for name in ("occupied", "labels"):
        np.testing.assert_array_equal(getattr(stats, name), expected[name])
    for name in ("laplacian", "mean"):
        np.testing.assert_allclose(getattr(stats, name), expected[name], rtol=1e-9)
    for name in ESTIMATORS:
        np.testing.assert_allclose(stats.noise[name], expected[name], rtol=1e-9)


def written(samples: list[Sample], folder: Path) -> MFNet:
    """The samples as files, in the packed layout."""
    for name in ("images", "labels"):
        (folder / name).mkdir()
    for each in samples:
        packed = np.dstack([each.rgb[..., ::-1], each.thermal])
        cv2.imwrite(str(folder / "images" / f"{each.name}.png"), packed)
        cv2.imwrite(str(folder / "labels" / f"{each.name}.png"), each.label)
    (folder / "train.txt").write_text("\n".join(each.name for each in samples) + "\n")
    return MFNet(str(folder))


def main() -> int:
    cv2.setNumThreads(1)
    samples = scenes(np.random.default_rng(0))
    memory = InMemory(samples)
    region_map = RINGS.map(HW)
    results: dict[str, Any] = {}

    def timed(call: Callable[[], Any], clock: int) -> float:
        """CPU (0) or wall (1) milliseconds per image; what came back is in `results`."""
        return 1e3 * seconds(lambda: results.update(last=call()))[clock] / IMAGES

    def ours(dataset: Any, workers: int) -> Callable[[], SpatialStatistics]:
        return lambda: collect(
            dataset, "train", MeasurementSettings(regions=RINGS, workers=workers)
        )

    ours(InMemory(samples[:10]), 1)()
    print(f"{IMAGES} images of {HW[0]}x{HW[1]}, both modalities, 9 rings, all estimators")
    masks_ms = timed(lambda: by_masks(samples, region_map), 0)
    expected = results["last"]
    one_ms = timed(ours(memory, 1), 0)
    same(results["last"], expected)
    print("equal results; CPU ms per image, images in memory, one thread")
    print(f"  mask per ring  {masks_ms:7.2f}")
    print(f"  ours           {one_ms:7.2f}   ratio {masks_ms / one_ms:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        files = written(samples, Path(folder))
        read_ms = timed(lambda: [files.read(name) for name in files.names("train")], 1)
        print(f"wall ms per image, {os.cpu_count()} cores (reading PNG files alone {read_ms:.2f})")
        for where, dataset in (("memory", memory), ("files", files)):
            for workers in (1, 2):
                found = timed(ours(dataset, workers), 1)
                same(results["last"], expected)
                print(f"  from {where:6s} {workers} worker(s) {found:7.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
