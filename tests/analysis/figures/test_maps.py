"""SpatialSeg, Figs. 1 and 4."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from analysis.figures.maps import (
    RegionPicture,
    draw_heats,
    draw_regions,
    iou_heat,
    is_around,
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


def test_absent_classes_can_be_left_out() -> None:
    union = np.ones((2, 6, 8))
    union[1] = 0
    rings = Regions(partition="ring", regions=2, aspect="image", absent="exclude")
    assert iou_heat(maps(np.zeros_like(union) + union, union), rings).whole == 1.0


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


def test_occupancy_over_the_measured_regions_is_what_the_statistics_say() -> None:
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 3, (5, 12, 16), dtype=np.uint8)
    night = np.array([True, False, True, False, False])
    stats = statistics(labels, RINGS, night)
    for part in ("all", "day", "night"):
        found = occupancy_over(stats, stats.region_map, part)
        np.testing.assert_allclose(found, region_occupancy(stats, part))


def test_strips_have_no_centre() -> None:
    stats = statistics(np.zeros((2, 6, 8), np.uint8), RINGS, None)
    with pytest.raises(InputError, match=r"no centre and no edge; use rings"):
        occupancy_heat(stats, strips(5))


def test_draws_the_numbers_and_says_what_centre_and_edge_are(tmp_path: Path) -> None:
    labels = np.zeros((4, 60, 80), np.uint8)
    labels[:1] = 1
    stats = statistics(labels, RINGS, None)
    both = [iou_heat(maps(np.ones((2, 60, 80)), np.full((2, 60, 80), 2)), RINGS)]
    both.append(occupancy_heat(stats, RINGS))
    found = " ".join(texts(draw_heats(both), tmp_path))
    assert "mIoU: centre 50.0 %" in found
    assert "SOR: centre 25.0 %" in found
    assert "pixels pooled" in found
    assert "edge 25.0 %" in found
    assert "inner and outer region of ring2" in found
    assert "(a) IoU: RTFNet, test" in found
    assert "(b) sample occupancy: toy, train" in found
    assert "1.0" in found  # the scale ends at 1 whatever the values
    assert "(a)" not in " ".join(texts(draw_heats(both[1:]), tmp_path))


@pytest.mark.parametrize("regions", [strips(9, "ring"), strips(5), strips(5, "horizontal")])
def test_every_region_is_numbered_inside(tmp_path: Path, regions: Regions) -> None:
    region_map = regions.map((480, 640))
    places = number_beside(region_map)
    assert [int(region_map[place]) for place in places if place] == list(range(regions.regions))
    data = RegionPicture(np.zeros((480, 640)), region_map, regions.name)
    found = texts(draw_regions(data), tmp_path)
    assert {str(number + 1) for number in range(regions.regions)} <= set(found)


def test_numbers_of_rings_stand_apart() -> None:
    places = number_beside(strips(9, "ring").map((480, 640)))
    columns = sorted(place[1] for place in places if place)
    assert min(np.diff(columns)) > 15  # 7 point digits take 15 of 640 pixels in a column


def test_only_outer_rings_are_around() -> None:
    rings, beside = strips(3, "ring").map((48, 64)), strips(3).map((48, 64))
    assert [is_around(rings, region) for region in range(3)] == [False, True, True]
    assert not any(is_around(beside, region) for region in range(3))
