"""A small data set in a layout of somebody's own, with contents that follow from the names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.folder import Folder
from rgbt.randomness import numpy_generator
from tests.conftest import write_png

HW = (6, 8)
CLASSES = ("background", "person", "car")
RANGE = (20000, 24000)
FRAMES = {"train": 3, "val": 1, "test": 2}
PATTERNS = {
    "rgb": "{split}/rgb/{name}.png",
    "thermal": "{split}/ir/{name}_ir.tif",
    "label": "{split}/mask/{name}.png",
}


def contents(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGB, counts and class indices of a sample."""
    rng = numpy_generator(0, name)
    rgb = rng.integers(0, 256, (*HW, 3), dtype=np.uint8)
    counts = rng.integers(*RANGE, HW, dtype=np.uint16)
    return rgb, counts, rng.integers(0, 3, HW, dtype=np.uint8)


def write_tiff(path: Path, image: np.ndarray) -> None:
    """At its own depth."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_frame(root: Path, split: str, name: str) -> None:
    """The three files of one frame."""
    rgb, counts, label = contents(f"{split}_{name}")
    write_png(root / split / "rgb" / f"{name}.png", rgb)
    write_tiff(root / split / "ir" / f"{name}_ir.tif", counts)
    write_png(root / split / "mask" / f"{name}.png", label)


def write_folder(root: Path, frames: dict[str, int] = FRAMES) -> Path:
    """Frames 1, 2, ... of every split, in folders by split."""
    for split, number in frames.items():
        for index in range(1, number + 1):
            write_frame(root, split, str(index))
    return root


def folder(root: Path, **keys: Any) -> Folder:
    """The reader of what `write_folder` writes."""
    values = {**PATTERNS, "num_classes": 3, "classes": CLASSES, "thermal_range": RANGE, **keys}
    return Folder(str(root), **values)


def listed(root: Path, *lines: str, **keys: Any) -> Folder:
    """The reader of what `write_folder` writes, its split "train" being these lines."""
    (root / "list.txt").write_text("\n".join(lines))
    plain = {key: text.replace("{split}", "{part}") for key, text in PATTERNS.items()}
    return folder(root, **{**plain, "lists": {"train": "list.txt", "val": "val.txt"}, **keys})


def refused(make: Callable[[], object]) -> str:
    """The one sentence of the InputError that `make` raises."""
    with pytest.raises(InputError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)
