"""Counts of one 480x640 image with 9 classes in 9 rings: ours against scikit-learn, one run.

Run: python -m tests.benchmarks.bench_counts
"""

from __future__ import annotations

import sys
from typing import Any

import cv2
import numpy as np
import torch
from sklearn.metrics import confusion_matrix

from rgbt.metrics.counting import RegionCounter
from rgbt.metrics.metric import Regions, ring_rectangle
from tests.benchmarks.timing import medians

HW = (480, 640)
CLASSES = 9
RINGS = 9
AT_LEAST = 60.0
ROUNDS = 31


def images(rng: np.random.Generator) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """A label of blocks with 2 % ignored pixels, and a prediction that is right in about 80 %."""
    coarse = rng.integers(0, CLASSES, (24, 32)).astype(np.uint8)
    label = cv2.resize(coarse, HW[::-1], interpolation=cv2.INTER_NEAREST)
    guess = rng.integers(0, CLASSES, HW).astype(np.uint8)
    prediction = np.where(rng.random(HW) < 0.2, guess, label)
    label[rng.random(HW) < 0.02] = 255
    return label, prediction


def by_masks(label, prediction, region_map) -> np.ndarray[Any, Any]:
    classes = range(CLASSES)
    return np.stack(
        [
            confusion_matrix(label[region_map == r], prediction[region_map == r], labels=classes)
            for r in range(RINGS)
        ]
    )


def by_slices(label, prediction) -> np.ndarray[Any, Any]:
    """As the release reads a ring: strips above, below, left and right of the next inner one."""
    matrices = []
    for ring in range(RINGS, 0, -1):
        rows, columns = ring_rectangle(HW, RINGS, ring, "image")
        pieces = [(rows, columns)]
        if ring > 1:
            y, x = ring_rectangle(HW, RINGS, ring - 1, "image")
            pieces = [
                (slice(rows.start, y.start), columns),
                (slice(y.stop, rows.stop), columns),
                (y, slice(columns.start, x.start)),
                (y, slice(x.stop, columns.stop)),
            ]
        flat = [np.concatenate([m[piece].ravel() for piece in pieces]) for m in (label, prediction)]
        matrices.append(confusion_matrix(*flat, labels=range(CLASSES)))
    return np.stack(matrices[::-1])


def main() -> int:
    torch.set_num_threads(1)
    regions = Regions(partition="ring", regions=RINGS, aspect="image", absent="released")
    counter = RegionCounter(CLASSES, regions)
    label, prediction = images(np.random.default_rng(0))
    wide = label.astype(np.int64), prediction.astype(np.int64)
    tensors = torch.from_numpy(wide[0]), torch.from_numpy(prediction)
    ours = {
        "uint8 label": lambda: counter(label, prediction),
        "int64 label": lambda: counter(*tensors),
    }
    theirs = {
        "sklearn masks, uint8": lambda: by_masks(label, prediction, regions.map(HW)),
        "sklearn slices, uint8": lambda: by_slices(label, prediction),
        "sklearn masks, int64": lambda: by_masks(*wide, regions.map(HW)),
        "sklearn slices, int64": lambda: by_slices(*wide),
    }
    expected = counter(label, prediction)
    for name, call in {**ours, **theirs}.items():
        assert np.array_equal(call(), expected), f"{name}: counts differ"
    ms = {name: 1e3 * wall for name, (_, wall) in medians({**ours, **theirs}, ROUNDS).items()}
    print(f"{HW[0]}x{HW[1]}, {CLASSES} classes, {RINGS} rings; equal counts; medians, one thread")
    for name, value in ms.items():
        print(f"  {name:21s} {value:8.3f} ms")
    released = ms["sklearn slices, int64"] / ms["int64 label"]
    closest = ms["sklearn slices, uint8"] / ms["uint8 label"]
    print(f"ratio to the released way (int64, ring slices): {released:.0f}, wanted {AT_LEAST:.0f}")
    print(f"ratio with bytes given to scikit-learn as well:  {closest:.0f}")
    return 0 if released >= AT_LEAST else 1


if __name__ == "__main__":
    sys.exit(main())
