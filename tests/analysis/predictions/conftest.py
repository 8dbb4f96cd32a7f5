"""A data set of two 4x4 images whose scores are worked out by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.data.mfnet import MFNet

CLASSES = ("ground", "car", "person")
PALETTE = ((0, 0, 0), (64, 0, 128), (64, 64, 0))
LABELS = {
    "00001D": [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 2, 2], [0, 0, 2, 255]],
    "00002N": [[0, 0, 0, 0]] * 4,
}
PREDICTIONS = {
    "00001D": [[1, 0, 0, 0], [1, 1, 0, 0], [0, 0, 2, 0], [0, 0, 1, 2]],
    "00002N": [[0, 0, 0, 0]] * 4,
}
Write = Callable[[Mapping[str, object], str], Path]


@pytest.fixture
def tiny(tmp_path: Path) -> MFNet:
    """Split test: the two images; split val: 00003D, without a label on disk."""
    root = tmp_path / "data"
    (root / "images").mkdir(parents=True)
    (root / "labels").mkdir()
    for name, label in LABELS.items():
        cv2.imwrite(str(root / "labels" / f"{name}.png"), np.array(label, np.uint8))
    (root / "test.txt").write_text("\n".join(LABELS))
    (root / "val.txt").write_text("00003D")
    given: Any = {"num_classes": 3, "classes": CLASSES, "palette": PALETTE}
    return MFNet(str(root), name="tiny", background=CLASSES[:1], **given)


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Write arrays as index PNGs into a new folder; the keys are names without ".png"."""

    def written(arrays: Mapping[str, object], folder: str = "pred") -> Path:
        (tmp_path / folder).mkdir()
        for name, array in arrays.items():
            cv2.imwrite(str(tmp_path / folder / f"{name}.png"), np.array(array, np.uint8))
        return tmp_path / folder

    return written  # type: ignore[return-value]
