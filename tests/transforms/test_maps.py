"""What moves the maps of a sample, by hand and against torch and OpenCV."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional as F

from rgbt.transforms.maps import (
    Maps,
    bilinear,
    drawn_window,
    mixed,
    nearest,
    nearest_source,
    short_edge_hw,
)
from rgbt.types import Sample
from tests.transforms.recipes import noise

MFNET_SIZES = range(240, 961, 48)


@pytest.mark.parametrize(
    ("source_hw", "short_edge", "max_size", "expected"),
    [
        ((480, 640), 240, 1920, (240, 320)),
        ((480, 640), 960, 1920, (960, 1280)),
        ((640, 480), 240, 1920, (320, 240)),
        ((512, 640), 307, 1920, (307, 384)),  # 640 * 307 / 512 = 383.75
        ((720, 1280), 1152, 1920, (1080, 1920)),  # would be 2048 wide
        ((720, 1280), 1152, None, (1152, 2048)),
    ],
)
def test_short_edge_hw(source_hw, short_edge, max_size, expected) -> None:
    assert short_edge_hw(source_hw, short_edge, max_size) == expected


@pytest.mark.parametrize("source", [97, 480, 512, 720])
def test_nearest_source_is_that_of_torch(source: int) -> None:
    line = torch.arange(source, dtype=torch.float32)[None, None, :, None]
    for resized in [*MFNET_SIZES, 97, 307, 320, 448, 1080, 1280]:
        expected = F.interpolate(line, size=(resized, 1), mode="nearest").flatten()
        np.testing.assert_array_equal(nearest_source(source, resized), expected.numpy())
    assert nearest_source(5, 3).tolist() == [0, 1, 3]  # floor(0), floor(1.67), floor(3.33)
    assert nearest(np.array([[4, 7]]), (2, 4)).tolist() == [[4, 4, 7, 7]] * 2


@pytest.mark.parametrize("short_edge", [24, 31, 57, 96])
def test_bilinear_is_that_of_torch(short_edge: int) -> None:
    sample, hw = noise(3), short_edge_hw((48, 64), short_edge, None)
    planes = torch.from_numpy(sample.rgb).permute(2, 0, 1)[None].double()
    expected = F.interpolate(planes, size=hw, mode="bilinear", align_corners=False)
    found = Maps.of(sample).resize(hw, dtype=np.float32).rgb
    np.testing.assert_allclose(found, expected[0].permute(1, 2, 0), rtol=0, atol=1e-3)
    assert np.abs(Maps.of(sample).resize(hw).rgb - found).max() < 1.5


@pytest.mark.parametrize("hw", [(48, 64), (37, 53), (72, 128), (480, 640)])
def test_a_window_is_the_whole_cut(hw: tuple[int, int]) -> None:
    """Bit for bit in uint8, whose pixels lie in a block that is resized alone."""
    rng, maps = np.random.default_rng(1), Maps.of(noise(1, hw))
    enlarged = 5 * [5 * hw[0]] if hw[0] < 100 else []  # a window may begin within a pixel
    drawn = rng.integers(hw[0] // 3, hw[0], 4)
    for short_edge in [*(hw[0] * np.arange(5, 21) // 10), *drawn, *enlarged]:
        size = short_edge_hw(hw, int(short_edge), 1920)
        window = drawn_window(size, (int(rng.integers(1, hw[0])), int(rng.integers(1, hw[1]))), rng)
        whole = cv2.resize(maps.rgb, size[::-1], interpolation=cv2.INTER_LINEAR_EXACT)
        found = maps.resize(size, window)
        np.testing.assert_array_equal(found.rgb, whole[window])
        np.testing.assert_array_equal(found.label, maps.resize(size).crop(window).label)
        np.testing.assert_array_equal(found.rows, nearest_source(hw[0], size[0])[window[0]])


def test_padding_and_flip_by_hand() -> None:
    small = Sample(
        np.full((1, 2, 3), 9, np.uint8),
        np.array([[1, 2]], np.uint8),
        np.array([[3, 4]], np.uint8),
        "x",
        np.array([[0.25, 0.75]], np.float32),
    )
    found = Maps.of(small).flip(True).pad((2, 5), ((124, 116, 104), 114, 255, 0)).example(True)
    # One row more: below. Three columns more: one left, two right.
    assert found.label.tolist() == [[255, 4, 3, 255, 255], [255] * 5]
    assert found.thermal.tolist() == [[114, 2, 1, 114, 114], [114] * 5]
    assert found.rgb[0, :, 0].tolist() == [124, 9, 9, 124, 124]
    assert found.rgb[1, 4].tolist() == [124, 116, 104]
    assert found.confidence is not None and found.confidence.tolist()[0] == [0, 0.75, 0.25, 0, 0]  # noqa: PT018
    assert found.position is not None
    assert found.position[1].tolist() == [[1, 1, 0, 0, 0]] * 2


@pytest.mark.parametrize(("column", "expected"), [(25, (5, 20)), (40, (0, 20))])
def test_rotation_moves_images_and_centres_counter_clockwise(column: int, expected: Any) -> None:
    """A quarter turn; a centre that leaves the image becomes its nearest pixel."""
    image = np.zeros((21, 41), np.uint8)
    image[10, column] = 9
    maps = Maps.of(Sample(np.repeat(image[..., None], 3, 2), image, image, "x")).around(10, column)
    turned = maps.rotate(90.0, (20.0, 10.0), ((0, 0, 0), 0, 255, 0.0))
    assert turned.centre_yx == expected
    assert turned.label[0, 0] == 255
    if expected[0]:
        assert np.unravel_index(turned.thermal.argmax(), (21, 41)) == expected


def test_an_area_is_the_mean_where_nothing_grows() -> None:
    sample = noise(2, (8, 12))
    found = Maps.of(sample).resize((4, 6), area=True)
    for image, of in ((found.rgb, sample.rgb), (found.thermal, sample.thermal)):
        total = sum(of[y::2, x::2].astype(int) for y, x in itertools.product((0, 1), repeat=2))
        np.testing.assert_array_equal(image, (total + 2) // 4)
    wider = Maps.of(sample).resize((4, 30), area=True)
    np.testing.assert_array_equal(wider.thermal, bilinear(sample.thermal, (4, 30)))


def test_mixed_labels_are_brightness_but_for_ignored_ones() -> None:
    """Columns 1 and 2 hold road and background; a mix with an ignored pixel is ignored."""
    label = np.array([[0, 0, 12, 12, 12, 12]], np.uint8)
    assert mixed(np.roll(label, -1, 1)[:, :4], (1, 2)).tolist() == [[6, 12]]
    label = np.full((2, 6), 3, np.uint8)
    label[0, 0] = 255
    assert mixed(label, (1, 3)).tolist() == [[255, 3, 3]]


def test_examples_share_no_memory_with_the_file() -> None:
    maps = replace(Maps.of(noise()), name="other")
    cut = maps.crop((slice(3, 13), slice(4, 16))).flip(True).example(False)
    assert cut.rgb.flags.c_contiguous
    assert cut.label.flags.c_contiguous
    assert (cut.name, cut.original_hw) == ("other", (48, 64))
