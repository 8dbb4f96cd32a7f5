"""Count the pixels of every class in the labels of a split."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.dataset import LabelledDataset
from rgbt.types import IGNORE

NUM_THREADS = 4
"""Labels that are decoded at a time."""

PixelCounts = NDArray[np.int64]


def label_pixels(label: NDArray[np.uint8], num_classes: int) -> PixelCounts:
    """(K + 1,) pixels of each class in a label (H, W); the last are ignored."""
    counts = np.bincount(label.ravel(), minlength=IGNORE + 1)
    return np.append(counts[:num_classes], counts[IGNORE])


def class_pixels(
    dataset: LabelledDataset, names: Sequence[str], *, skip_errors: bool
) -> PixelCounts:
    """(N, K) pixels of each class in each of N labels; 0 of an image without a label.

    Raises:
        InputError: a label cannot be read, unless `skip_errors`, where it counts 0.
    """

    def counted(name: str) -> PixelCounts:
        try:
            label = dataset.label(name)
        except InputError:
            if not skip_errors:
                raise
            label = None
        if label is None:
            return np.zeros(dataset.num_classes, np.int64)
        return label_pixels(label, dataset.num_classes)[:-1]

    with ThreadPoolExecutor(NUM_THREADS) as pool:
        return np.stack(list(pool.map(counted, names)))
