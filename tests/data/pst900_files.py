"""A small data set in the layout of PST900, with contents that follow from the names."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rgbt.randomness import numpy_generator
from tests.conftest import write_png

HW = (9, 16)
TRAIN = ("10_bag1_rect_rgb_frame0000000001", "11_bag1_rect_rgb_frame0000000009", "7_bag12_rect_f1")
TEST = ("58_bag21_rect_rgb_frame0000000440", "3_bag25_rect_rgb_frame0000000002")


def contents(name: str, hw: tuple[int, int] = HW) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGB, thermal, label of a name; thermal is nowhere 0."""
    rng = numpy_generator(0, name)
    rgb = rng.integers(0, 256, (*hw, 3), dtype=np.uint8)
    thermal = rng.integers(1, 256, hw, dtype=np.uint8)
    return rgb, thermal, rng.integers(0, 5, hw, dtype=np.uint8)


def write_triple(folder: Path, name: str, hw: tuple[int, int] = HW) -> None:
    """One name into folder/rgb, folder/thermal and folder/labels."""
    for kind, image in zip(("rgb", "thermal", "labels"), contents(name, hw), strict=True):
        write_png(folder / kind / f"{name}.png", image)


def write_pst900(root: Path, train: tuple[str, ...] = TRAIN, test: tuple[str, ...] = TEST) -> Path:
    """The archive: train and test in folders, and what else it holds of one image."""
    for part, names in (("train", train), ("test", test)):
        for name in names:
            write_triple(root / part, name)
    raw = np.full(HW, 30000, np.uint16)
    for kind in ("thermal_raw", "depth"):
        write_png(root / "train" / kind / f"{(train or TRAIN)[0]}.png", raw)
    return root
