"""Pictures: the data behind them, and that files of the right size are drawn."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt.tracking.pictures import (
    HALF_SPAN,
    IGNORED_COLOUR,
    Legend,
    PanelExample,
    RegionHeat,
    _broken,
    colour_limits,
    colours,
    draw_panel,
    draw_region_heat,
    number_places,
    overlay,
    region_values,
)

PALETTE = np.array([[0, 0, 0], [64, 0, 128]], np.uint8)
NAMES = ("unlabelled", "car")


def rings() -> np.ndarray:
    ring = np.ones((40, 60), np.int64)
    ring[10:30, 15:45] = 0
    return ring


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
        ((0,), [stays, violet, stays]),
        ((1,), [black, stays, stays]),
        ((), [black, violet, stays]),
    ):
        assert overlay(rgb, label, Legend(NAMES, PALETTE, background), 0.25).tolist() == [expected]
    with pytest.raises(ValueError, match="one size"):
        overlay(rgb, label[:, :2], Legend(NAMES, PALETTE, (0,)))


def test_region_values_by_hand() -> None:
    heat = RegionHeat("x", np.array([[0, 1]]), (0.25, 0.5))
    assert region_values(heat).tolist() == [[25.0, 50.0]]
    with pytest.raises(ValueError, match="but there are 1 IoUs"):
        region_values(RegionHeat("x", np.array([[0, 1]]), (0.25,)))


def test_numbers_lie_inside_their_regions() -> None:
    ring = rings()
    inner, outer, empty = number_places(ring, 3)
    assert inner is not None
    assert outer is not None
    assert empty is None
    assert ring[inner] == 0
    assert ring[outer] == 1
    assert outer[0] < 10, "the outer ring's number stands above the inner ring"


def test_colour_limits_are_equally_wide_for_similar_runs() -> None:
    assert colour_limits((0.5, 0.6)) == pytest.approx((55 - HALF_SPAN, 55 + HALF_SPAN))
    assert colour_limits((0.1, 0.9, math.nan)) == pytest.approx((10, 90))


def test_heat_map_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "heat.png"
    draw_region_heat(RegionHeat("x", rings(), (0.5, math.nan)), path)
    image = cv2.imread(str(path))
    assert image is not None
    assert image.shape[1] > image.shape[0] > 300
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50


def test_panel_is_drawn_with_every_class_colour(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    label = np.zeros((30, 40), np.uint8)
    label[5:15, 5:15] = 1
    rgb = generator.integers(0, 255, (30, 40, 3)).astype(np.uint8)
    example = PanelExample("00001D", rgb, rgb[..., 0], label, label)
    sizes = []
    for count in (1, 3):
        path = tmp_path / f"panel_{count}.png"
        draw_panel([example] * count, Legend(NAMES, PALETTE, (0,)), path)
        image = cv2.imread(str(path))
        assert image is not None
        assert (image[..., ::-1] == PALETTE[1]).all(-1).sum() > 1000
        sizes.append(image.shape)
    assert sizes[0][1] == sizes[1][1]
    assert sizes[1][0] > 2 * sizes[0][0]
    with pytest.raises(ValueError, match="at least one example"):
        draw_panel([], Legend(NAMES, PALETTE, (0,)), tmp_path / "none.png")


def test_long_names_are_broken_after_underscores() -> None:
    name = "test_day_1570001920_541752960"
    assert _broken(name, 22) == "test_day_1570001920_\n541752960"
    assert _broken(name, 40) == name
    assert _broken("x" * 30, 22) == "x" * 30
