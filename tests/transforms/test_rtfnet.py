from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.transforms.joint import Part, View, nearest_source
from rgbt.transforms.rtfnet import RtfnetTransform, draw_ends
from rgbt.types import Sample


def rtfnet(**changes: Any) -> RtfnetTransform:
    recipe: dict[str, Any] = {
        "flip_probability": 0.5,
        "cut_share": 0.1,
        "crop_hw": (48, 64),
        "test_short_edge": None,
        "track_position": True,
    }
    return RtfnetTransform(**{**recipe, **changes})


def ramps(hw: tuple[int, int] = (48, 64)) -> Sample:
    """Red is the row, green the column, thermal twice the row; labels are noise."""
    row, column = np.mgrid[: hw[0], : hw[1]].astype(np.uint8)
    label = np.random.default_rng(0).integers(0, 9, hw, dtype=np.uint8)
    rgb = np.stack([row, column, row], axis=-1)
    return Sample(rgb=rgb, thermal=2 * row, label=label, name="00001D")


def test_ends_at_the_size_of_mfnet() -> None:
    """x1 in [0, 64), x2 in [576, 640]; y1 in [0, 48), y2 in [432, 480]; all as likely."""
    rng = np.random.default_rng(1)
    for length, largest in ((640, 64), (480, 48)):
        drawn = np.array([draw_ends(length, 0.1, rng) for _ in range(60 * largest)])
        first, first_count = np.unique(drawn[:, 0], return_counts=True)
        end, end_count = np.unique(drawn[:, 1], return_counts=True)
        assert first.tolist() == list(range(largest))
        assert end.tolist() == list(range(length - largest, length + 1))
        assert min(first_count.min(), end_count.min()) > 20
        assert max(first_count.max(), end_count.max()) < 110


def test_ends_of_short_axes_and_of_nothing_to_cut() -> None:
    rng = np.random.default_rng(2)
    assert {draw_ends(9, 0.1, rng) for _ in range(50)} == {(0, 9)}
    assert {draw_ends(640, 0.0, rng) for _ in range(50)} == {(0, 640)}
    assert {draw_ends(10, 0.1, rng) for _ in range(50)} == {(0, 9), (0, 10)}
    halves = {draw_ends(4, 0.5, rng) for _ in range(200)}
    assert halves == {(first, end) for first in (0, 1) for end in (2, 3, 4)}


def test_part_is_resized_as_if_it_were_an_image_of_its_own() -> None:
    image = np.random.default_rng(3).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    for part in (Part(3, 5, 41, 55), Part(0, 0, 48, 64), Part(4, 0, 44, 60)):
        cut = image[part.top : part.top + part.height, part.left : part.left + part.width]
        expected = cv2.resize(cut, (64, 48), interpolation=cv2.INTER_LINEAR_EXACT)
        view = View((48, 64), (48, 64), (0, 0), (48, 64), part=part)
        np.testing.assert_array_equal(view.bilinear(image, np.uint8), expected)
        mirrored = View((48, 64), (48, 64), (0, 0), (48, 64), True, part)
        np.testing.assert_array_equal(mirrored.bilinear(image, np.uint8), expected[:, ::-1])
        rows = part.top + nearest_source(part.height, 48)
        np.testing.assert_array_equal(view.rows(), rows)
        window = View((48, 64), (48, 64), (7, 9), (20, 30), part=part)
        np.testing.assert_array_equal(window.bilinear(image, np.uint8), expected[7:27, 9:39])


def test_part_by_hand() -> None:
    """The middle two of four pixels, doubled: 1/4 steps within them, nothing from outside."""
    image = np.array([[90, 0, 8, 90]], np.uint8)
    view = View((1, 4), (1, 4), (0, 0), (1, 4), part=Part(0, 1, 1, 2))
    assert view.bilinear(image, np.float32).tolist() == [[0, 2, 6, 8]]
    assert view.nearest(image).tolist() == [[0, 0, 8, 8]]
    assert view.columns().tolist() == [1, 1, 2, 2]
    assert view.centre_yx() == (0, 2)  # column 4 // 2 of the original


@pytest.mark.parametrize("hw", [(48, 64), (60, 50)])
def test_images_and_label_come_from_the_position(hw: tuple[int, int]) -> None:
    """Labels exactly; images, which are ramps, to what stretching and rounding allow."""
    original, rng = ramps(hw), np.random.default_rng(4)
    assert original.label is not None
    flips = 0
    for _ in range(100):
        example = rtfnet().train(original, rng)
        assert example.position is not None
        row, column = example.position.astype(int)
        np.testing.assert_array_equal(example.label, original.label[row, column])
        assert np.abs(example.rgb[..., 0] - example.position[0]).max() < 1.6
        assert np.abs(example.rgb[..., 1] - example.position[1]).max() < 1.6
        assert np.abs(example.thermal - 2 * example.position[0]).max() < 2.6
        # At most a tenth is cut off at either end (and where it shrinks, "nearest" skips pixels).
        assert row.min() < hw[0] // 10
        assert row.max() >= hw[0] - hw[0] // 10 - 2
        assert column.min() <= hw[1] // 10
        assert column.max() >= hw[1] - hw[1] // 10 - 2
        i, j = example.centre_yx
        distance = np.hypot(row - hw[0] // 2, column - hw[1] // 2)
        assert distance[i, j] == distance.min()
        flips += column[0, 0] > column[0, -1]
    assert 30 < flips < 70


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_mirrored_image_is_cut(mirrored: bool) -> None:
    """Of ten columns none is cut at the start and up to one at the end, after the mirroring."""
    transform = rtfnet(flip_probability=float(mirrored), crop_hw=(10, 10))
    rng, ends = np.random.default_rng(9), set()
    for _ in range(50):
        example = transform.train(ramps((10, 10)), rng)
        assert example.position is not None
        ends.add((int(example.position[1, 0, 0]), int(example.position[1, 0, -1])))
    assert ends == ({(9, 0), (9, 1)} if mirrored else {(0, 9), (0, 8)})


def test_nothing_cut_and_nothing_mirrored_is_the_file() -> None:
    original = ramps()
    still = rtfnet(cut_share=0.0, flip_probability=0.0)
    for example in (still.train(original, np.random.default_rng(6)), rtfnet().test(original)):
        np.testing.assert_array_equal(example.rgb, original.rgb)
        np.testing.assert_array_equal(example.thermal, original.thermal)
        np.testing.assert_array_equal(example.label, original.label)
        assert example.centre_yx == (24, 32)
