"""SpatialSeg, Figs. 1 and 4."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from analysis.figures.classes import class_regions
from analysis.figures.maps import (
    draw_regions,
    iou_heat,
    number_beside,
    occupancy_heat,
    occupancy_over,
)
from analysis.predictions.maps import PixelMaps
from analysis.predictions.scoring import ScoringOptions, score_folder
from analysis.predictions.table import ScoreKey, score_table
from analysis.statistics.derive import region_occupancy
from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.metrics.metric import Absent, Regions
from tests.analysis.figures.drawn import CLASSES, PALETTE, statistics, strips, texts

RINGS = strips(2, "ring")


def maps(intersection: np.ndarray, union: np.ndarray) -> PixelMaps:
    return PixelMaps(
        intersection=intersection.astype(np.int32),
        union=union.astype(np.int32),
        images=4,
        classes=CLASSES[:2],
        palette=tuple(map(tuple, PALETTE[:2].tolist())),
        dataset="fingerprint",
        split="test",
        name="RTFNet",
    )


def test_three_numbers_pool_pixels_before_dividing() -> None:
    """6 x 8 pixels: ring 1 is the 5 x 5 around the middle, ring 2 the 23 around it."""
    inner = RINGS.map((6, 8)) == 0
    assert inner.sum() == 25
    intersection, union = np.zeros((2, 6, 8)), np.zeros((2, 6, 8))
    union[0], intersection[0] = 4, np.where(inner, 1, 3)
    union[1], intersection[1] = np.where(inner, 2, 0), np.where(inner, 1, 0)
    heat = iou_heat(maps(intersection, union), RINGS)
    assert heat.centre == pytest.approx((1 / 4 + 1 / 2) / 2)
    assert heat.edge == pytest.approx((3 / 4 + 0) / 2)  # released: an absent class scores 0
    assert heat.whole == pytest.approx(((25 * 1 + 23 * 3) / (48 * 4) + 1 / 2) / 2)
    # The map leaves classes out that never occur at a pixel.
    np.testing.assert_allclose(heat.values[inner], 3 / 8)
    np.testing.assert_allclose(heat.values[~inner], 3 / 4)


@pytest.mark.parametrize("absent", ["released", "exclude"])
def test_the_three_numbers_are_those_of_the_tables(tmp_path: Path, absent: Absent) -> None:
    """One folder of predictions: Fig. 1 and the table of regions say the same."""
    names, rng = ("00001D", "00002N"), np.random.default_rng(0)
    for folder in ("images", "labels", "ours"):
        (tmp_path / folder).mkdir()
    (tmp_path / "test.txt").write_text("\n".join(names))
    for name in names:
        label = rng.integers(0, 3, (24, 32), np.uint8)
        label[8:16, 10:22] = 0  # the centre lacks classes 1 and 2
        predicted = np.where(rng.random(label.shape) < 0.7, label, 0)
        label[rng.random(label.shape) < 0.1] = 255
        cv2.imwrite(str(tmp_path / "labels" / f"{name}.png"), label)
        cv2.imwrite(str(tmp_path / "ours" / f"{name}.png"), predicted)
    scored = score_folder(
        tmp_path / "ours", MFNet(str(tmp_path)), "test", ScoringOptions(regions=5)
    )
    assert scored.maps is not None
    rings = Regions(partition="ring", regions=5, aspect="image", absent=absent)
    heat = iou_heat(scored.maps, rings)
    table = score_table(scored.counts[0], "ours").scores
    wanted = [table[ScoreKey(absent=absent, region=region)].value for region in (1, 5, None)]
    np.testing.assert_allclose([100 * heat.centre, 100 * heat.edge, 100 * heat.whole], wanted)


def test_occupancy_is_the_share_of_labels_that_are_not_background() -> None:
    labels = np.zeros((4, 6, 8), np.uint8)
    inner = RINGS.map((6, 8)) == 0
    labels[0][inner] = 1
    labels[1][inner] = 2
    labels[2][~inner] = 1
    heat = occupancy_heat(statistics(labels, strips(3), None), RINGS)
    assert (heat.centre, heat.edge) == (0.5, 0.25)
    assert heat.whole == pytest.approx((25 * 0.5 + 23 * 0.25) / 48)
    assert heat.source == "toy, train"


def test_occupancy_without_background_is_refused(tmp_path: Path) -> None:
    road = replace(statistics(np.zeros((2, 6, 8), np.uint8), strips(3), None), background=())
    with pytest.raises(InputError, match="no class of toy is stated as background"):
        occupancy_heat(road, RINGS)
    # Class 0 occurs everywhere and is drawn as every other class.
    assert class_regions(road).classes == road.classes
    np.testing.assert_allclose(class_regions(road).shares[0], 100)


def test_occupancy_over_measured_regions_equals_statistics() -> None:
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 3, (5, 12, 16), dtype=np.uint8)
    night = np.array([True, False, True, False, False])
    stats = statistics(labels, RINGS, night)
    for part in ("all", "day", "night"):
        found = occupancy_over(stats, stats.region_map, part)
        np.testing.assert_allclose(found, region_occupancy(stats, part))


@pytest.mark.parametrize("regions", [strips(9, "ring"), strips(5), strips(5, "horizontal")])
def test_every_region_is_numbered_inside(tmp_path: Path, regions: Regions) -> None:
    region_map = regions.map((480, 640))
    places = number_beside(region_map)
    assert [int(region_map[place]) for place in places if place] == list(range(regions.regions))
    found = texts(draw_regions(np.zeros((480, 640)), region_map), tmp_path)
    assert {str(number + 1) for number in range(regions.regions)} <= set(found)


def test_numbers_of_rings_are_separate() -> None:
    places = number_beside(strips(9, "ring").map((480, 640)))
    columns = sorted(place[1] for place in places if place)
    assert min(np.diff(columns)) > 15  # 7 point digits take 15 of 640 pixels in a column
