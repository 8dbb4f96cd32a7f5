"""Pictures: the data behind them, and that files of the right size are drawn."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.tracking.pictures import (
    IGNORED_COLOUR,
    colours,
    draw_panel,
    draw_region_heat,
    overlay,
)
from rgbt.types import Sample

PALETTE = np.array([[0, 0, 0], [64, 0, 128]], np.uint8)
NAMES = ("unlabelled", "car")


def painted_but(*background: str) -> Any:
    """A data set of which overlays leave these classes out."""
    return SimpleNamespace(classes=NAMES, palette=PALETTE, background=background)


def test_colours_by_hand() -> None:
    label = np.array([[0, 1, 255]], np.uint8)
    assert colours(label, PALETTE).tolist() == [[[0, 0, 0], [64, 0, 128], list(IGNORED_COLOUR)]]
    with pytest.raises(ValueError, match="label 2 has no colour"):
        colours(np.array([[2]], np.uint8), PALETTE)


def test_overlay_by_hand() -> None:
    rgb = np.full((1, 3, 3), 100, np.uint8)
    label = np.array([[0, 1, 255]], np.uint8)
    # 0.75 * 100 + 0.25 * (64, 0, 128), or + 0.25 * (0, 0, 0); background and ignored pixels stay.
    stays, black, violet = [100] * 3, [75] * 3, [91, 75, 107]
    for background, expected in (
        (NAMES[:1], [stays, violet, stays]),
        (NAMES[1:], [black, stays, stays]),
        ((), [black, violet, stays]),
    ):
        assert overlay(rgb, label, painted_but(*background), 0.25).tolist() == [expected]


def test_pictures_are_drawn(tmp_path: Path) -> None:
    path, label = tmp_path / "a.png", np.zeros((30, 40), np.uint8)
    label[5:15, 5:15] = 1
    for ious in ((math.nan, math.nan), (0.5, math.nan)):
        draw_region_heat("x", label, ious, path)
        image = cv2.imread(str(path))
        assert image is not None
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50
    rgb = np.random.default_rng(0).integers(0, 255, (30, 40, 3)).astype(np.uint8)
    sample: Any = Sample(rgb=rgb, thermal=rgb[..., 0], label=label, name="00001D")
    for count in (1, 3):
        draw_panel([(sample, label)] * count, painted_but("unlabelled"), path)
        image = cv2.imread(str(path))
        assert image is not None
        assert (image[..., ::-1] == PALETTE[1]).all(-1).sum() > 1000
