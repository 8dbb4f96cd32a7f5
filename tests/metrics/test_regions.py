"""Partitions: no gap, equal areas, the released rings, region 1 innermost."""

from __future__ import annotations

import json
import zlib

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.config.component import build
from rgbt.config.compose import conf_dir
from rgbt.metrics.metric import Regions, ring_map, ring_rectangle, strip_map
from tests.models.golden import FOLDER


def configured(name: str, **changes: object) -> Regions:
    config = OmegaConf.create({"metric": OmegaConf.load(conf_dir() / "metric" / f"{name}.yaml")})
    config.metric.update(changes)
    return build(config.metric)


def test_strips_by_hand() -> None:
    # 7 columns in 3 strips: floor(3 n / 7) = 0 0 0 1 1 2 2.
    assert strip_map((2, 7), 3, vertical=True).tolist() == [[0, 0, 0, 1, 1, 2, 2]] * 2
    assert strip_map((4, 2), 2, vertical=False).tolist() == [[0, 0], [0, 0], [1, 1], [1, 1]]


def test_rings_by_hand() -> None:
    # 8 x 8 in 4 rings: inner sides 8 sqrt(1/4) = 4, 8 sqrt(2/4) = 5.66, 8 sqrt(3/4) = 6.93.
    # Bounds floor((8 -+ s) / 2): 2..6, 1..6, 0..7.
    expected = np.full((8, 8), 3)
    expected[0:7, 0:7] = 2
    expected[1:6, 1:6] = 1
    expected[2:6, 2:6] = 0
    assert np.array_equal(ring_map((8, 8), 4, "image"), expected)
    # 11 x 19 in 5 rings: sides 11 / sqrt 5 = 4.92 and 19 / sqrt 5 = 8.50; 121 / 5 is below 25.
    assert ring_rectangle((11, 19), 5, 1, "image") == (slice(3, 7), slice(5, 13))


PUBLISHED = {
    # Inner rows and columns of each ring from the outside, and areas, 480x640.
    5: (
        [((25, 454), (33, 606)), ((54, 425), (72, 567)), ((88, 391), (117, 522))]
        + [((132, 347), (176, 463))],
        [61383, 62172, 60930, 61010, 61705],
    ),
    9: (
        [((13, 466), (18, 621)), ((28, 451), (37, 602)), ((44, 435), (58, 581))]
        + [((61, 418), (81, 558)), ((80, 400), (106, 533)), ((101, 378), (135, 504))]
        + [((126, 353), (169, 470)), ((160, 320), (213, 426))],
        [34041, 34164, 34502, 34204, 33649, 34427, 33886, 34247, 34080],
    ),
}


@pytest.mark.parametrize("aspect", ["image", "released_3_4"])
@pytest.mark.parametrize("regions", PUBLISHED)
def test_rings_of_mfnet_images_are_the_released_ones(regions, aspect) -> None:
    bounds, areas = PUBLISHED[regions]
    for inner, (rows, columns) in zip(range(regions - 1, 0, -1), bounds, strict=True):
        found = ring_rectangle((480, 640), regions, inner, aspect)
        assert [(s.start, s.stop) for s in found] == [rows, columns]
    assert np.bincount(ring_map((480, 640), regions, aspect).ravel()).tolist() == areas[::-1]


@pytest.mark.skipif(not FOLDER.exists(), reason="reference material is not beside the checkout")
@pytest.mark.parametrize("case", ["480x640.5", "480x640.9", "512x640.5"])
def test_released_rings_pixel_by_pixel(case: str) -> None:
    recipe = json.loads((FOLDER / "losses.json").read_text())["recipes"]["rings"][f"rings.{case}"]
    size, regions = case.split(".")
    height, width = map(int, size.split("x"))
    rings = ring_map((height, width), int(regions), "released_3_4") + 1
    assert zlib.crc32(rings.astype(np.uint8).tobytes()) == recipe["crc32_uint8_map"]


@pytest.mark.parametrize("image_hw", [(480, 640), (97, 131)])
@pytest.mark.parametrize("name", ["ring5", "ring9", "vertical5", "horizontal5"])
def test_regions_partition_the_image_into_equal_areas(name, image_hw) -> None:
    regions = configured(name)
    assert regions.name == name
    region_map = regions.map(image_hw)
    assert (region_map.shape, region_map.dtype) == (image_hw, np.uint8)
    areas = np.bincount(region_map.ravel(), minlength=regions.regions)
    assert len(areas) == regions.regions
    # An edge is off by less than a pixel; the longest edge runs around the image.
    assert np.abs(areas - areas.mean()).max() <= 2 * sum(image_hw)


def test_maps_are_computed_once_and_cannot_be_changed() -> None:
    regions = configured("ring5", aspect="released_3_4")
    assert regions.name == "ring5_released_3_4"
    assert regions.map((48, 64)) is configured("ring5", aspect="released_3_4").map((48, 64))
    with pytest.raises(ValueError, match="read-only"):
        regions.map((48, 64))[0, 0] = 1
