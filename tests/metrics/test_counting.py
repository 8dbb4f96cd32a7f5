"""Counts of one image by hand, against scikit-learn, against erosions, and against loops."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from sklearn.metrics import confusion_matrix

from rgbt.metrics.counting import (
    areas,
    detail_counts,
    outlined,
    pair_counts,
    region_counts,
)
from rgbt.metrics.details import Details
from rgbt.metrics.metric import Regions
from rgbt.metrics.scores import ece, iou, object_recall, tally


def strips(regions: int) -> Regions:
    return Regions(partition="vertical", regions=regions, aspect=None, absent="released")


ONE, HALVES = strips(1), strips(2)
BOUNDARY, BORDER = Details("boundary", (0.02,)), Details("boundary", (0.02, 1.0))


def counted(details: Details, *maps: object, classes: int = 2, regions: Regions = ONE) -> Any:
    label, prediction, *values = map(np.asarray, maps)
    return detail_counts(details, label, prediction, *(values or [None]), classes, regions)


# Label by prediction.


def test_counts_by_hand() -> None:
    label = np.array([[0, 1], [1, 255]], np.uint8)
    prediction = np.array([[0, 0], [1, 1]], np.uint8)
    counts = region_counts(label, prediction, 2, HALVES)
    # Left: 0 seen as 0, 1 seen as 1. Right: 1 seen as 0; the ignored pixel is nowhere.
    assert counts.tolist() == [[[1, 0], [0, 1]], [[0, 0], [1, 0]]]
    assert counts.dtype == np.int64


@pytest.mark.filterwarnings("ignore:A single label was found")
@pytest.mark.parametrize(("num_classes", "regions"), [(1, 1), (2, 200), (9, 9), (255, 9)])
def test_equal_to_scikit_learn_in_every_region(num_classes: int, regions: int) -> None:
    rng, shape, partition = np.random.default_rng(num_classes), (23, 211), strips(regions)
    label = rng.integers(0, num_classes + 2, shape)  # the last two are no classes
    label[rng.random(shape) < 0.1] = 255
    prediction = rng.integers(0, num_classes, shape).astype(np.uint8)
    counts = region_counts(torch.tensor(label), prediction, num_classes, partition)
    assert counts.shape == (regions, num_classes, num_classes)
    assert counts.sum() == (label < num_classes).sum()
    for region in range(0, regions, 40):
        chosen = (partition.map(shape) == region) & (label < num_classes)
        known = list(range(num_classes))
        expected = confusion_matrix(label[chosen], prediction[chosen], labels=known)
        assert np.array_equal(counts[region], expected)


ZEROS = np.zeros((4, 4), np.uint8)


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (lambda: region_counts(ZEROS, ZEROS[1:], 3, HALVES), r"\(4, 4\), \(3, 4\)"),
        (lambda: region_counts(ZEROS[None], ZEROS[None], 3, HALVES), "maps H x W"),
        (lambda: region_counts(ZEROS, ZEROS + 3, 3, HALVES), r"classes 0\.\.2, got 3"),
        (lambda: region_counts(ZEROS, ZEROS, 256, HALVES), "num_classes"),
        (lambda: pair_counts(ZEROS + 255, ZEROS, ZEROS, 2), r"first: .* 0\.\.1, got 255"),
        (lambda: pair_counts(ZEROS, ZEROS + 1, ZEROS, 1), r"second: .* 0\.\.0, got 1"),
        (lambda: pair_counts(ZEROS, ZEROS, ZEROS, 3, np.ones(2, bool)), "one shape"),
        (lambda: counted(Details("size", (9.0,)), ZEROS, ZEROS, ZEROS[1:]), "one shape"),
        (lambda: counted(BOUNDARY, ZEROS, ZEROS, classes=255), "at most 254 classes"),
    ],
)
def test_what_cannot_be_counted_is_refused(count: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        count()


# Pairs of frames.


def test_pairs_by_hand() -> None:
    first = np.array([[0, 1], [1, 1]], np.uint8)
    second = np.array([[0, 0], [1, 1]], np.uint8)
    label = np.array([[0, 1], [1, 255]], np.uint8)
    counts = pair_counts(first, second, label, 2)
    # [label, first, second]: (0, 0, 0), (1, 1, 0), (1, 1, 1) and, without a label, (2, 1, 1).
    assert counts.tolist() == [[[1, 0], [0, 0]], [[0, 0], [1, 1]], [[0, 0], [0, 1]]]
    dropped = np.array([[True, False], [True, False]])
    assert pair_counts(first, second, label, 2, dropped).tolist() == [
        [[1, 0], [0, 0]],
        [[0, 0], [0, 1]],
        [[0, 0], [0, 0]],
    ]


def test_largest_number_of_classes_fits_without_valid_pixels() -> None:
    last = np.full((2, 3), 254, np.uint8)
    found = pair_counts(last, last, np.array([[254, 255, 0]] * 2), 255, last > 0)
    assert found[254, 254, 254] == found[255, 254, 254] == found[0, 254, 254] == 2
    assert found.sum() == 6
    first, second = np.array([[255, 1]], np.uint8), np.array([[0, 1]], np.uint8)
    assert pair_counts(first, second, second, 2, first < 2).sum() == 1


# Boundaries.


def square(size: int, low: int, high: int) -> np.ndarray:
    """`size` x `size` pixels of class 0 with a square [low, high) of class 1."""
    label = np.zeros((size, size), np.uint8)
    label[low:high, low:high] = 1
    return label


def test_boundaries_of_square_predicted_one_pixel_to_right() -> None:
    # 7 x 7, d = 1. The label is the square of rows and columns 2..4, the prediction columns 3..5.
    label, prediction = square(7, 2, 5), np.roll(square(7, 2, 5), 1, axis=1)
    found = counted(BORDER, label, prediction)
    # Class 1: 9 pixels each, all but the middle one are boundary. The squares share columns 3 and
    # 4, 6 pixels, of which (3, 3) is the middle of the label and (3, 4) that of the prediction.
    assert found[0, :, 1].tolist() == [4, 8, 8]
    # Class 0 of the label: the border of the image (24) and the ring around the square (16).
    # Of the prediction: the border, and its ring without the 5 pixels of column 6 on the border.
    # Both: the border, and that ring without the 3 pixels of column 2 that the label calls 1.
    assert found[0, :, 0].tolist() == [24 + 8, 24 + 16, 24 + 11]
    # Without the border of the image: its 24 pixels count where the ring touches them (5).
    assert counted(BOUNDARY, label, prediction)[0].tolist() == [[8, 4], [16, 8], [11 + 5, 8]]
    ious = iou(found.sum(0), "released")
    assert ious.tolist() == pytest.approx([32 / (40 + 35 - 32), 4 / (8 + 8 - 4)])


@pytest.mark.parametrize("border", [True, False])
@pytest.mark.parametrize("pixels", [1, 2, 5])
def test_boundary_is_what_erosions_of_each_padded_mask_leave(pixels: int, border: bool) -> None:
    # The released code pads a mask with one pixel of background and erodes it d times by 3 x 3.
    # Where the border is no outline, the mask is continued beyond it.
    rng = np.random.default_rng(pixels)
    blobs = cv2.resize(rng.integers(0, 3, (6, 8)).astype(np.uint8), (40, 30), interpolation=0)
    expected = np.zeros(blobs.shape, bool)
    for number in range(3):
        mask = (blobs == number).astype(np.uint8)
        padded = np.pad(mask, 9) if border else np.pad(mask, 9, mode="edge")
        eroded = cv2.erode(padded, np.ones((3, 3), np.uint8), iterations=pixels)[9:-9, 9:-9]
        expected |= (blobs == number) & (eroded == 0)
    every = np.ones(blobs.shape, bool)
    assert np.array_equal(outlined(blobs, every, pixels, border=border), expected)


@pytest.mark.parametrize(("width", "pixels"), [(0.034, 2), (0.026, 1), (0.066, 3), (0.001, 1)])
def test_width_of_boundaries_is_rounded_to_pixels(width: float, pixels: int) -> None:
    """Of the diagonal, 50 pixels: 1.7 are two, 1.3 are one, 3.3 are three, and 0.05 are one."""
    halves = np.zeros((30, 40), np.uint8)
    halves[:, 20:] = 1
    found = counted(Details("boundary", (width,)), halves, halves)
    assert found[0].tolist() == [[30 * pixels] * 2] * 3


def test_ignored_pixels_are_not_counted_and_are_no_outline() -> None:
    label, prediction = np.zeros((7, 7), np.uint8), np.zeros((7, 7), np.uint8)
    label[3, 3] = 255
    prediction[3, 3] = 1  # not counted, and no outline of class 0 around it
    assert not counted(BOUNDARY, label, prediction).any()
    found = counted(BORDER, label, prediction)
    assert found[0].tolist() == [[24, 0], [24, 0], [24, 0]]  # the border of the image alone


# Calibration.


def test_confidences_and_error_of_six_pixels_by_hand() -> None:
    label = np.array([[0, 0, 1], [1, 1, 255]], np.uint8)
    prediction = np.array([[0, 1, 1], [1, 0, 0]], np.uint8)
    confidence = np.array([[0.9, 0.8, 0.75], [0.5, 0.4, 0.99]])
    found = counted(Details("calibration", (2.0,)), label, prediction, confidence)
    # Bin 1 (0, 0.5]: 0.5 right, predicted 1; 0.4 wrong, predicted 0.
    # Bin 2 (0.5, 1]: 0.9 right, predicted 0; 0.8 wrong and 0.75 right, predicted 1. One is ignored.
    assert found[0].tolist() == [[1, 1], [0, 1], [4000, 5000]]
    assert found[1].tolist() == [[1, 2], [1, 1], [9000, 15500]]
    # |1 - 0.9| + |2 - 2.45| over 5 pixels.
    assert ece(found) == pytest.approx((0.1 + 0.45) / 5)
    # Predicted 1: |1 - 0.5| + |1 - 1.55| over 3 pixels.
    assert ece(found[..., 1:]) == pytest.approx((0.5 + 0.55) / 3)
    assert np.isnan(ece(np.zeros((15, 3, 2), np.int64)))
    # A confidence of 0.12346 is 1235 units.
    found = counted(Details("calibration", (2.0,)), [[0]], [[0]], [[0.12346]])
    assert found[0].tolist() == [[1, 0], [1, 0], [1235, 0]]


@pytest.mark.parametrize(
    ("confidence", "expected"),
    # 1/15 and 3/15 are upper ends of their bins; 0 is in the first bin.
    [(0.0, 0), (0.0001, 0), (1 / 15, 0), (0.0668, 1), (0.2, 2), (0.2001, 3), (1.0, 14)],
)
def test_bins_are_open_below_and_closed_above(confidence: float, expected: int) -> None:
    pixel = np.zeros((1, 1), np.uint8)
    found = counted(Details("calibration", (15.0,)), pixel, pixel, [[confidence]], classes=1)
    assert np.flatnonzero(found[:, 0, 0]).tolist() == [expected]


# Scenes.


def test_counts_by_distance_by_hand() -> None:
    label, prediction = np.array([[0, 1, 1, 0]], np.uint8), np.array([[0, 1, 0, 1]], np.uint8)
    depth = np.array([[math.inf, 4.0, 10.0, 9.99]], np.float32)
    found = counted(Details("distance", (10.0,)), label, prediction, depth)
    # 0 to 10 m: a right 1, and a 0 predicted as 1; from 10 m on: a missed 1; sky: a right 0.
    assert found.tolist() == [[[0, 1], [0, 1]], [[0, 0], [1, 0]], [[1, 0], [0, 0]]]


def test_counts_by_size_by_hand() -> None:
    # Object 7 has 3 pixels, of which one is ignored; object 2 has one; the other pixels have none.
    objects = np.array([[7, 7, 0], [7, 2, 0]], np.int32)
    label = np.array([[1, 1, 0], [255, 1, 0]], np.uint8)
    prediction = np.array([[1, 0, 1], [1, 1, 0]], np.uint8)
    assert areas(objects).tolist() == [[3, 3, math.inf], [3, 1, math.inf]]
    found = counted(Details("size", (2.0,)), label, prediction, objects)
    assert found.tolist() == [[[0, 0], [0, 1]], [[0, 0], [1, 1]], [[1, 1], [0, 0]]]
    recalls = object_recall(tally(found))
    assert recalls[:2, 1].tolist() == [1.0, 0.5]
    assert np.isnan(recalls[0, 0])  # no object of class 0, whatever the convention
    # An object has the same size in every region: 8 pixels in each half, 16 in all.
    halves = counted(Details("size", (9.0,)), ZEROS, ZEROS, ZEROS + 1, classes=1, regions=HALVES)
    assert halves[:, 0, 0].tolist() == [0, 8, 0, 0, 8, 0]
