from __future__ import annotations

from dataclasses import replace
from math import sqrt
from typing import Any

import pytest
import torch

from rgbt.checks import InputError
from rgbt.losses.spatial import PLAIN, SpatialMap, boundaries, weight_map
from tests.losses.problems import batch_of, whole_image

EDGE = replace(PLAIN, alpha=2.0, focus="edge")


def test_edge_weights_of_a_3x3_image() -> None:
    batch = batch_of(torch.zeros(1, 3, 3, dtype=torch.long), whole_image(1, 3, 3))
    # Centre (1, 1), d_max = sqrt 2: corners 1 + 2, sides 1 + 2 / sqrt 2.
    side = 1 + 2 / sqrt(2)
    expected = torch.tensor([[3, side, 3], [side, 1, side], [3, side, 3]])
    weights = weight_map(batch, (3, 3), EDGE)
    assert weights.shape == (1, 1, 3, 3)
    assert torch.allclose(weights[0, 0], expected)


def test_centre_weights_are_reversed() -> None:
    batch = batch_of(torch.zeros(1, 3, 3, dtype=torch.long), whole_image(1, 3, 3))
    side = 3 - 2 / sqrt(2)
    expected = torch.tensor([[1, side, 1], [side, 3, side], [1, side, 1]])
    weights = weight_map(batch, (3, 3), replace(EDGE, focus="center"))
    assert torch.allclose(weights[0, 0], expected)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        # A crop of rows 0-1, columns 3-4 of a 5 x 5 image, centre (2, 2), d_max sqrt 8.
        ({}, [[sqrt(5 / 8), 1.0], [sqrt(2 / 8), sqrt(5 / 8)]]),
        ({"d_max": "crop"}, [[sqrt(5 / 8), 1.0], [sqrt(2 / 8), sqrt(5 / 8)]]),
        # Pixel (1, 1) of the crop lies at (1, 4); the farthest original pixel, (4, 0), at 5.
        ({"centre": "crop"}, [[sqrt(2) / 5, 1 / 5], [1 / 5, 0.0]]),
        ({"centre": "crop", "d_max": "crop"}, [[1.0, sqrt(0.5)], [sqrt(0.5), 0.0]]),
    ],
)
def test_centre_and_largest_distance(changes: dict[str, str], expected: list[list[float]]) -> None:
    position = whole_image(1, 5, 5)[:, :, :2, 3:]
    batch = batch_of(torch.zeros(1, 2, 2, dtype=torch.long), position, (5, 5))
    weights = weight_map(batch, (2, 2), replace(EDGE, alpha=1.0, **changes))
    assert torch.allclose(weights[0, 0], 1 + torch.tensor(expected))


@pytest.mark.parametrize(
    ("focus", "padding", "expected"),
    [("edge", "map", 3.0), ("center", "map", 1.0), ("edge", "one", 1.0), ("edge", "zero", 0.0)],
)
def test_padding(focus: Any, padding: Any, expected: float) -> None:
    batch = batch_of(torch.zeros(1, 3, 3, dtype=torch.long), whole_image(1, 3, 3))
    weights = weight_map(batch, (4, 5), replace(EDGE, focus=focus, padding=padding))[0, 0]
    assert (weights[3] == expected).all()
    assert (weights[:, 3:] == expected).all()


@pytest.mark.parametrize(
    ("passes", "weighted"),
    [(1, [0]), (2, [0, 1]), (3, [0]), (4, [0, 3])],  # F | F F' | F R T | F R T F'
)
def test_fused_passes(passes: int, weighted: list[int]) -> None:
    batch = batch_of(torch.zeros(2, 3, 3, dtype=torch.long), whole_image(2, 3, 3))
    settings = replace(EDGE, passes="fused", dice_smoothing="none", normaliser="weights")
    spatial = SpatialMap(batch, (3, 3), settings=settings, num_passes=passes)
    corner = torch.tensor([-2 / 3, -2 / 3]).expand(2 * passes, 2, 1, 2)
    weights = spatial.at(corner, torch.tensor([0, 1]), first_set=0)
    expected = [3.0 if s % passes in weighted else 1.0 for s in range(2 * passes)]
    assert torch.allclose(weights.values[:, 1, 0], torch.tensor(expected))
    assert torch.allclose(weights.total[:, 0], torch.tensor(expected))
    assert weights.smoothing[:, 0].tolist() == [0.0 if e == 3 else 1.0 for e in expected]


def test_weights_at_points() -> None:
    batch = batch_of(torch.zeros(1, 3, 3, dtype=torch.long), whole_image(1, 3, 3))
    spatial = SpatialMap(batch, (3, 3), settings=EDGE, num_passes=1)
    # The middle, half way from it to the right, and the outer corner, where the border continues.
    points = torch.tensor([[[[0.0, 0.0], [1 / 3, 0.0], [1.0, 1.0]]]])
    weights = spatial.at(points, torch.tensor([0]), first_set=0)
    expected = torch.tensor([1.0, 1 + 1 / sqrt(2), 3.0])
    assert torch.allclose(weights.values[0, 0], expected)
    assert weights.total.tolist() == [[3.0]]
    assert weights.smoothing.tolist() == [[1.0]]


def test_boundaries_are_labelled_pixels_beside_another_class() -> None:
    # One pixel of class 1 at (1, 1), class 2 in the last column, no label at (3, 0) and (4, 1).
    label = torch.tensor(
        [
            [0, 0, 0, 0, 0, 2],
            [0, 1, 0, 0, 0, 2],
            [0, 0, 0, 0, 0, 2],
            [255, 0, 0, 0, 0, 2],
            [0, 255, 0, 0, 255, 2],
        ]
    )
    # By hand: the eight neighbours of (1, 1) and itself, the last column where a labelled 0 is
    # beside or diagonal, and column 4 where it is labelled.
    expected = torch.tensor(
        [
            [1, 1, 1, 0, 1, 1],
            [1, 1, 1, 0, 1, 1],
            [1, 1, 1, 0, 1, 1],
            [0, 0, 0, 0, 1, 1],
            [0, 0, 0, 0, 0, 1],
        ]
    ).bool()
    assert torch.equal(boundaries(label[None])[0], expected)


def test_edge_weighted_loss_weights_boundaries_without_a_position() -> None:
    label = torch.tensor([[[0, 0, 1, 1]]])
    batch = replace(batch_of(label, whole_image(1, 1, 4)), position=None)
    settings = replace(EDGE, focus="boundary")
    # Padding "map" is a pixel without a boundary.
    expected = torch.tensor([[1.0, 3, 3, 1, 1], [1, 1, 1, 1, 1]])
    assert torch.equal(weight_map(batch, (2, 5), settings)[0, 0], expected)
    with pytest.raises(InputError, match="does not track"):
        weight_map(batch, (2, 5), EDGE)
