"""Boundary IoU on small images whose pixels can be counted by hand, and against erosions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rgbt.metrics.boundary import BoundaryCounter, boundary_iou, boundary_pixels, outlined
from rgbt.metrics.metric import Regions

ONE = Regions(partition="ring", regions=1, aspect="image", absent="released")
HALVES = Regions(partition="vertical", regions=2, aspect=None, absent="released")


def square(size: int, low: int, high: int) -> np.ndarray:
    """`size` x `size` pixels of class 0 with a square [low, high) of class 1."""
    label = np.zeros((size, size), np.uint8)
    label[low:high, low:high] = 1
    return label


@pytest.mark.parametrize(
    ("hw", "width", "expected"),
    # Diagonals 5 (0.1), 200 (4), 800 (16); 2.5 is rounded to the even number.
    [((3, 4), 0.02, 1), ((120, 160), 0.02, 4), ((480, 640), 0.02, 16), ((3, 4), 0.5, 2)],
)
def test_boundary_pixels_are_a_share_of_the_diagonal(hw, width, expected) -> None:
    assert boundary_pixels(hw, width) == expected


def test_counts_of_a_square_that_is_predicted_one_pixel_to_the_right() -> None:
    # 7 x 7, d = 1. The label is the square of rows and columns 2..4, the prediction columns 3..5.
    label, prediction = square(7, 2, 5), np.roll(square(7, 2, 5), 1, axis=1)
    found = BoundaryCounter(2, ONE, 0.02, border=True)(label, prediction)
    # Class 1: 9 pixels each, all but the middle one are boundary. The squares share columns 3 and
    # 4, 6 pixels, of which (3, 3) is the middle of the label and (3, 4) that of the prediction.
    assert found[0, :, 1].tolist() == [4, 8, 8]
    # Class 0 of the label: the border of the image (24) and the ring around the square (16).
    # Of the prediction: the border, and its ring without the 5 pixels of column 6 on the border.
    # Both: the border, and that ring without the 3 pixels of column 2 that the label calls 1.
    assert found[0, :, 0].tolist() == [24 + 8, 24 + 16, 24 + 11]
    # Without the border of the image: its 24 pixels count where the ring touches them (5).
    without = BoundaryCounter(2, ONE, 0.02)(label, prediction)
    assert without[0].tolist() == [[8, 4], [16, 8], [11 + 5, 8]]
    ious = boundary_iou(found.sum(0), "released")
    assert ious.tolist() == pytest.approx([32 / (40 + 35 - 32), 4 / (8 + 8 - 4)])


def test_counts_by_region_add_to_those_of_the_image() -> None:
    rng = np.random.default_rng(0)
    label, prediction = (rng.integers(0, 4, (20, 30)) for _ in range(2))
    halves = BoundaryCounter(4, HALVES, 0.05)(label, prediction)
    assert np.array_equal(halves.sum(0), BoundaryCounter(4, ONE, 0.05)(label, prediction)[0])
    mirrored = BoundaryCounter(4, HALVES, 0.05)(label[:, ::-1], prediction[:, ::-1])
    assert np.array_equal(mirrored, halves[::-1])


@pytest.mark.parametrize("border", [True, False])
@pytest.mark.parametrize("pixels", [1, 2, 5])
def test_boundary_is_what_erosions_of_each_padded_mask_leave(pixels: int, border: bool) -> None:
    # The released code pads a mask with one pixel of background and erodes it d times by 3 x 3.
    # Where the border is no outline, the mask is continued beyond it.
    rng = np.random.default_rng(pixels)
    blobs = cv2.resize(rng.integers(0, 3, (6, 8)).astype(np.uint8), (40, 30), interpolation=0)
    expected = np.zeros(blobs.shape, bool)
    for each in range(3):
        mask = (blobs == each).astype(np.uint8)
        padded = np.pad(mask, 9) if border else np.pad(mask, 9, mode="edge")
        eroded = cv2.erode(padded, np.ones((3, 3), np.uint8), iterations=pixels)[9:-9, 9:-9]
        expected |= (blobs == each) & (eroded == 0)
    assert np.array_equal(
        outlined(blobs, np.ones(blobs.shape, bool), pixels, border=border), expected
    )


def test_ignored_pixels_are_not_counted_and_are_no_outline() -> None:
    label = np.zeros((7, 7), np.uint8)
    label[3, 3] = 255
    prediction = np.zeros((7, 7), np.uint8)
    prediction[3, 3] = 1  # not counted, and no outline of class 0 around it
    assert not BoundaryCounter(2, ONE, 0.02)(label, prediction).any()
    found = BoundaryCounter(2, ONE, 0.02, border=True)(label, prediction)
    assert found[0].tolist() == [[24, 0], [24, 0], [24, 0]]  # the border of the image alone


def test_a_prediction_right_in_every_counted_pixel_scores_one() -> None:
    rng = np.random.default_rng(1)
    label = np.repeat(np.repeat(rng.integers(0, 3, (5, 6)), 6, 0), 6, 1).astype(np.uint8)
    prediction = label.copy()
    label[10:18, 5:25] = 255
    found = BoundaryCounter(3, ONE, 0.02)(label, prediction)
    assert boundary_iou(found.sum(0), "released").tolist() == [1.0, 1.0, 1.0]


def test_absent_class_scores_as_the_convention_says() -> None:
    counts = np.array([[4, 0], [8, 0], [8, 0]])
    assert boundary_iou(counts, "released").tolist() == pytest.approx([4 / 12, 0])
    assert np.isnan(boundary_iou(counts, "exclude")[1])


def test_more_classes_than_a_byte_holds_are_refused() -> None:
    with pytest.raises(ValueError, match="between 1 and 254, got 255"):
        BoundaryCounter(255, ONE, 0.02)
