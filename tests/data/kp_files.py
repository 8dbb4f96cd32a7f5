"""A small data set in the layout of KP, with contents that follow from the names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from rgbt.randomness import numpy_generator
from tests.conftest import write_png

HW = (16, 24)
TRAIN = ("set00_V000_I00050", "set02_V004_I01640", "set03_V001_I00117")
VAL = ("set06_V000_I00253", "set10_V001_I00130")
TEST = ("set07_V000_I00050", "set08_V002_I02488", "set09_V000_I00184", "set11_V001_I01512")
NAMES = (*TRAIN, *VAL, *TEST)
LISTS = {"train": TRAIN, "val": VAL, "test": TEST}
NIGHTS = ("set03", "set04", "set05", "set09", "set10", "set11")


def contents(name: str, hw: tuple[int, int] = HW) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGB, thermal and label of a name; the label as on disk, the images constant in 8x8 pixels.

    JPEG keeps such blocks to within two levels.
    """
    rng = numpy_generator(0, name)
    rows, columns = np.indices(hw) // 8
    shape = (hw[0] // 8 + 1, hw[1] // 8 + 1)
    rgb = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)[rows, columns]
    thermal = rng.integers(0, 256, shape, dtype=np.uint8)[rows, columns]
    return rgb, thermal, rng.integers(0, 20, hw, dtype=np.uint8)


def write_jpeg(path: Path, rgb: np.ndarray) -> None:
    """At the best quality and with all of its colour, so that it can be compared."""
    path.parent.mkdir(parents=True, exist_ok=True)
    best = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    assert cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]), best)


def image_path(root: Path, name: str, kind: str) -> Path:
    """Of "visible" or "lwir"."""
    recording, video, frame = name.split("_")
    return root / "images" / recording / video / kind / f"{frame}.jpg"


def write_kp(root: Path, names: Iterable[str] = NAMES) -> Path:
    """Images and labels as the CRM release has them, without lists."""
    for name in names:
        rgb, thermal, label = contents(name)
        write_jpeg(image_path(root, name, "visible"), rgb)
        write_jpeg(image_path(root, name, "lwir"), np.dstack([thermal] * 3))
        write_png(root / "labels" / f"{name}.png", label)
    return root


def write_lists(
    root: Path, lists: Mapping[str, Iterable[str]] = LISTS, ending: str = ".png"
) -> Path:
    """Lists alone, with the ending that the CRM release has in them."""
    for split, names in lists.items():
        (root / f"{split}.txt").write_text("".join(f"{name}{ending}\n" for name in names))
    return root
