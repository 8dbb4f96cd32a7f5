"""A small data set, its exported pairs of frames, and predictions of two methods."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from rgbt.evaluation.pairs.frames import composed_pairs
from rgbt.evaluation.pairs.others import write_images

NAMES = ("00001N", "00000D")
METHODS = ("a", "b")


def write_framed(folder: Path) -> None:
    """Write mf (data set of 48 x 64 pixels), pairs (export), a and b (predictions)."""
    rng = np.random.default_rng(0)
    root = folder / "mf"
    for kind in ("images", "labels"):
        (root / kind).mkdir(parents=True)
    (root / "test.txt").write_text("\n".join(NAMES))
    for name in NAMES:
        pair = rng.integers(0, 256, (48, 64, 4), dtype=np.uint8)
        cv2.imwrite(str(root / "images" / f"{name}.png"), pair)
        cv2.imwrite(str(root / "labels" / f"{name}.png"), blocks(rng))
    words = ["dataset=mfnet", f"dataset.root={root}", "consistency=views"]
    listed = write_images(composed_pairs(words, "test"), folder / "pairs")
    predict(folder, listed.images, rng)


def predict(folder: Path, names: tuple[str, ...], rng: np.random.Generator) -> None:
    """Write random predictions of both methods."""
    for method in METHODS:
        (folder / method).mkdir()
        for name in names:
            cv2.imwrite(str(folder / method / f"{name}.png"), blocks(rng))


def blocks(rng: np.random.Generator) -> np.ndarray:
    """(48, 64) uint8: squares of random classes 0..8."""
    return np.kron(rng.integers(0, 9, (6, 8), dtype=np.uint8), np.ones((8, 8), np.uint8))
