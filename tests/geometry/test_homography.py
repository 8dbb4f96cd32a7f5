"""Rotations and homographies: elementary turns by hand, published numbers, both orders."""

from __future__ import annotations

import pytest
import torch

from rgbt.geometry.homography import Order, homography, rotation
from tests.geometry.views import HW, RELEASED

ORDERS: tuple[Order, ...] = ("zyx", "zxy")


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("angles", "vector", "expected"),
    [
        ((90, 0, 0), (0, 0, 1), (1, 0, 0)),  # yaw: what lies ahead moves to the right
        ((0, 90, 0), (0, 0, 1), (0, -1, 0)),  # pitch: and up (y points down)
        ((0, 0, 90), (1, 0, 0), (0, 1, 0)),  # roll: what lies right moves down, clockwise
    ],
)
def test_quarter_turns(order: Order, angles: tuple, vector: tuple, expected: tuple) -> None:
    turned = rotation(torch.tensor([angles]), order) @ torch.tensor(vector, dtype=torch.float64)
    torch.testing.assert_close(turned, torch.tensor([expected], dtype=torch.float64))


def test_the_orders_are_the_stated_products_and_differ() -> None:
    yaw, pitch, roll = 30.0, 40.0, 50.0

    def turn(*angles: float) -> torch.Tensor:
        return rotation(torch.tensor([angles]), "zyx")[0]

    z, y, x = turn(0, 0, roll), turn(yaw, 0, 0), turn(0, pitch, 0)
    both = torch.tensor([[yaw, pitch, roll]])
    torch.testing.assert_close(rotation(both, "zyx")[0], z @ y @ x)
    torch.testing.assert_close(rotation(both, "zxy")[0], z @ x @ y)
    assert (z @ y @ x - z @ x @ y).abs().max() > 0.1


def test_a_published_homography() -> None:
    """yaw 4, pitch 7, roll 1 degrees in the order of the release, to five digits."""
    found = homography(torch.tensor([[4.0, 7.0, 1.0]]), RELEASED.matrix(HW), "zxy")[0]
    expected = [
        [0.96573, 0.03814, 49.149],
        [0.00229, 1.03397, -95.907],
        [-0.0001, 0.00017, 0.98008],
    ]
    close = torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(found, close, atol=6e-6, rtol=2e-5)
