"""Counts by distance and by size of the object, pixel by pixel."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rgbt.metrics.confusion import RegionCounter
from rgbt.metrics.details import Details
from rgbt.metrics.metric import Regions
from rgbt.metrics.scene_counts import SceneCounter, areas, object_recall

ONE = Regions(partition="ring", regions=1, aspect="image", absent="released")
HALVES = Regions(partition="vertical", regions=2, aspect=None, absent="released")


def test_counts_by_distance_by_hand() -> None:
    label = np.array([[0, 1, 1, 0]], np.uint8)
    prediction = np.array([[0, 1, 0, 1]], np.uint8)
    depth = np.array([[math.inf, 4.0, 10.0, 9.99]], np.float32)
    found = SceneCounter(2, ONE, Details("distance", (10.0,)))(label, prediction, depth)
    # 0 to 10 m: a right 1, and a 0 predicted as 1; from 10 m on: a missed 1; sky: a right 0.
    assert found.tolist() == [[[0, 1], [0, 1]], [[0, 0], [1, 0]], [[1, 0], [0, 0]]]


def test_counts_by_size_by_hand() -> None:
    # Object 7 has 3 pixels, of which one is ignored; object 2 has one; the other pixels have none.
    objects = np.array([[7, 7, 0], [7, 2, 0]], np.int32)
    label = np.array([[1, 1, 0], [255, 1, 0]], np.uint8)
    prediction = np.array([[1, 0, 1], [1, 1, 0]], np.uint8)
    assert areas(objects).tolist() == [[3, 3, math.inf], [3, 1, math.inf]]
    found = SceneCounter(2, ONE, Details("size", (2.0,)))(label, prediction, objects)
    assert found.tolist() == [[[0, 0], [0, 1]], [[0, 0], [1, 1]], [[1, 1], [0, 0]]]
    recalls = object_recall(found)
    assert recalls[:2, 1].tolist() == [1.0, 0.5]
    assert np.isnan(recalls[0, 0])  # no object of class 0, whatever the convention


def test_an_object_has_the_same_size_in_every_region() -> None:
    objects = np.ones((1, 4), np.int32)  # 2 pixels in each half, 4 in all
    label = prediction = np.zeros((1, 4), np.uint8)
    found = SceneCounter(1, HALVES, Details("size", (3.0,)))(label, prediction, objects)
    assert found[:, 0, 0].tolist() == [0, 2, 0, 0, 2, 0]


@pytest.mark.parametrize("kind", ["distance", "size"])
def test_groups_add_to_the_usual_counts(kind) -> None:
    rng = np.random.default_rng(0)
    label, prediction = (rng.integers(0, 3, (12, 16)) for _ in range(2))
    label[:2] = 255
    scene = rng.integers(0, 30, (12, 16))
    if kind == "distance":
        scene = np.where(scene == 0, math.inf, scene)
    found = SceneCounter(3, HALVES, Details(kind, (6.0, 7.0)))(label, prediction, scene)
    usual = RegionCounter(3, HALVES)(label, prediction)
    assert np.array_equal(found.reshape(2, 4, 3, 3).sum(1), usual)


def test_maps_of_other_shapes_are_refused() -> None:
    pixel = np.zeros((1, 1), np.uint8)
    with pytest.raises(ValueError, match=r"one shape, got \(1, 1\), \(1, 1\) and \(2, 1\)"):
        SceneCounter(1, ONE, Details("size", (2.0,)))(pixel, pixel, np.zeros((2, 1), np.int32))
