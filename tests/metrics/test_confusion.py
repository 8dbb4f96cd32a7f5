"""Counts of one image against hand counting and scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sklearn.metrics import confusion_matrix

from rgbt.metrics.confusion import RegionCounter
from rgbt.metrics.metric import Regions


def rings(regions: int) -> Regions:
    return Regions(partition="ring", regions=regions, aspect="image", absent="released")


def halves() -> Regions:
    return Regions(partition="vertical", regions=2, aspect=None, absent="released")


def test_counts_by_hand() -> None:
    label = np.array([[0, 1], [1, 255]], np.uint8)
    prediction = np.array([[0, 0], [1, 1]], np.uint8)
    counts = RegionCounter(2, halves())(label, prediction)
    # Left: 0 seen as 0, 1 seen as 1. Right: 1 seen as 0; the ignored pixel is nowhere.
    assert counts.tolist() == [[[1, 0], [0, 1]], [[0, 0], [1, 0]]]
    assert counts.dtype == np.int64


@pytest.mark.filterwarnings("ignore:A single label was found")
@pytest.mark.parametrize("num_classes", [1, 2, 5, 9, 15, 16, 19, 150, 255])
@pytest.mark.parametrize("regions", [1, 9, 200])
def test_equal_to_scikit_learn_in_every_region(num_classes, regions) -> None:
    # From bytes over 16 to 32 bits: all widths of the joint number.
    rng = np.random.default_rng(num_classes)
    partition = Regions(partition="vertical", regions=regions, aspect=None, absent="released")
    shape = (23, 211)
    label = rng.integers(0, num_classes, shape).astype(np.uint8)
    label[rng.random(shape) < 0.1] = 255
    prediction = rng.integers(0, num_classes, shape).astype(np.uint8)
    counts = RegionCounter(num_classes, partition)(label, prediction)
    assert counts.shape == (regions, num_classes, num_classes)
    for region in range(0, regions, 40):
        chosen = (partition.map(shape) == region) & (label < num_classes)
        expected = confusion_matrix(
            label[chosen], prediction[chosen], labels=list(range(num_classes))
        )
        assert np.array_equal(counts[region], expected)


def test_regions_sum_to_the_whole_image_and_valid_pixels() -> None:
    rng = np.random.default_rng(0)
    for shape in ((48, 64), (51, 67)):
        label = rng.integers(0, 11, shape)  # 9 and 10 are no classes
        prediction = rng.integers(0, 9, shape)
        by_ring = RegionCounter(9, rings(5))(label, prediction)
        whole = RegionCounter(9, rings(1))(label, prediction)
        assert np.array_equal(by_ring.sum(0), whole[0])
        assert by_ring.sum() == (label < 9).sum()


def test_tensors_arrays_and_types_count_alike() -> None:
    rng = np.random.default_rng(1)
    counter = RegionCounter(9, rings(3))
    label = np.where(rng.random((30, 40)) < 0.1, 255, rng.integers(0, 9, (30, 40)))
    prediction = rng.integers(0, 9, (30, 40))
    expected = counter(label, prediction)
    narrow = label.astype(np.uint8), prediction.astype(np.uint8)
    assert np.array_equal(counter(*narrow), expected)
    assert np.array_equal(counter(torch.tensor(label), torch.tensor(narrow[1])), expected)


def test_refuses_what_cannot_be_counted() -> None:
    counter = RegionCounter(3, halves())
    with pytest.raises(ValueError, match=r"\(4, 4\) and \(4, 5\)"):
        counter(np.zeros((4, 4), np.uint8), np.zeros((4, 5), np.uint8))
    with pytest.raises(ValueError, match="two maps"):
        counter(np.zeros((1, 4, 4), np.uint8), np.zeros((1, 4, 4), np.uint8))
    with pytest.raises(ValueError, match=r"classes 0\.\.2, got 3"):
        counter(np.zeros((4, 4), np.uint8), np.full((4, 4), 3, np.uint8))
    with pytest.raises(ValueError, match="num_classes"):
        RegionCounter(256, halves())
