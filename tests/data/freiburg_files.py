"""A small data set in the layout of Freiburg Thermal, with contents that follow from the names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rgbt.data.freiburg import Freiburg
from rgbt.randomness import numpy_generator
from tests.conftest import write_png

HW = (13, 26)
CROP = (1, 12, 5, 23)
SEQUENCES = {"seq_00_day/00": 2, "seq_00_day/01": 1, "seq_04_day/00": 2, "seq_00_night/00": 3}
TEST = {"day": 2, "night": 2}


def contents(stamp: str, hw: tuple[int, int] = HW) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGB, counts, label of a time stamp."""
    rng = numpy_generator(0, stamp)
    rgb = rng.integers(0, 256, (*hw, 3), dtype=np.uint8)
    counts = rng.integers(21000, 25000, hw, dtype=np.uint16)
    return rgb, counts, rng.integers(0, 14, hw, dtype=np.uint8)


def write_training(root: Path, piece: str, stamp: str) -> None:
    """One frame of a training sequence; those at night get no label."""
    rgb, counts, label = contents(stamp)
    folder = root / "train" / piece
    write_png(folder / "fl_rgb" / f"fl_rgb_{stamp}.png", rgb)
    write_png(folder / "fl_ir_aligned" / f"fl_ir_aligned_{stamp}.png", counts)
    if "night" not in piece:
        write_png(folder / "fl_rgb_labels" / f"fl_rgb_labels_{stamp}.png", label)


def write_test(
    root: Path, time: str, stamp: str, *, thermal: str = "", folders: tuple[str, ...] = ()
) -> None:
    """One frame of the test part; `thermal` is the stamp of its thermal image."""
    rgb, counts, label = contents(stamp)
    of_rgb, of_thermal, of_label = folders or ("ImagesRGB", "ImagesIR", "SegmentationClass")
    write_png(root / "test" / time / of_rgb / f"{stamp}_rgb.png", rgb)
    write_png(root / "test" / time / of_thermal / f"{thermal or stamp}_ir.png", counts)
    path = root / "test" / time / of_label / f"{stamp}_rgb.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, label.astype(np.int64))


def write_freiburg(root: Path) -> Path:
    """Three day frames to train on and two to validate on, three at night, four to test on."""
    number = 0
    for piece, frames in SEQUENCES.items():
        for _ in range(frames):
            write_training(root, piece, f"{1570 + number}_{number:03d}0")
            number += 1
    for time, frames in TEST.items():
        for _ in range(frames):
            write_test(root, time, f"{1570 + number}_{number:03d}0")
            number += 1
    return root


def reader(root: Path, **keys: Any) -> Freiburg:
    """The reader of what `write_freiburg` writes, with one day sequence held out as "val"."""
    return Freiburg(str(root), **{"crop": CROP, "val_sequences": ("seq_04_day",), **keys})
