"""Intrinsics, homographies of turns, and their inner rectangles, by hand and as published."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from rgbt.checks import InputError
from rgbt.geometry.camera import Camera, Order, Rule, homography, inner_rectangle
from tests.geometry.views import HW, RELEASED, random_views

SMALL = {"fx": 100.0, "fy": 110.0, "cx": 31.5, "cy": 20.0, "height": 48, "width": 64}
WHOLE = torch.tensor([[-0.5, -0.5, HW[1] - 0.5, HW[0] - 0.5]], dtype=torch.float64)


def view(*angles: float) -> Tensor:
    return homography(torch.tensor([angles]), RELEASED.matrix(HW), "zxy")


def turn(order: Order, *angles: float) -> Tensor:
    return homography(torch.tensor([angles]), torch.eye(3), order)[0]


# ---- intrinsics -----------------------------------------------------------------------------


def test_the_matrix_follows_the_size_of_the_images() -> None:
    """c' = (c + 0.5) / 2 - 0.5: the middle of an even image stays its middle."""
    camera = Camera(**SMALL)
    assert camera.matrix((48, 64)).tolist() == [[100, 0, 31.5], [0, 110, 20], [0, 0, 1]]
    assert camera.matrix((24, 32)).tolist() == [[50, 0, 15.5], [0, 55, 9.75], [0, 0, 1]]


@pytest.mark.parametrize("image_hw", [(480, 600), (64, 48), (49, 64)])
def test_another_aspect_is_another_camera(image_hw: tuple[int, int]) -> None:
    with pytest.raises(InputError, match=f"camera: .* {image_hw[0]}x{image_hw[1]}"):
        Camera(**SMALL).matrix(image_hw)


@pytest.mark.parametrize("changed", [{"cx": 320.0}, {"cy": -1.0}, {"cx": float("nan")}])
def test_a_principal_point_outside_the_image_is_refused(changed: dict[str, float]) -> None:
    with pytest.raises(InputError, match="camera: the principal point"):
        Camera(**{**SMALL, **changed})


def test_the_principal_point_may_lie_on_the_edge_of_the_image() -> None:
    """Of 48 x 64 pixels, whose centres lie at whole numbers."""
    for cx, cy in ((63.5, 47.5), (-0.5, -0.5)):
        assert Camera(**{**SMALL, "cx": cx, "cy": cy}).matrix((48, 64))[0, 2] == cx
    for changed in ({"cx": 63.6}, {"cy": 47.6}):
        with pytest.raises(InputError, match="camera: the principal point"):
            Camera(**{**SMALL, **changed})


# ---- homographies ---------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["zyx", "zxy"])
def test_quarter_turns(order: Order) -> None:
    for angles, vector, expected in (
        ((90.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),  # what lies ahead moves to the right
        ((0.0, 90.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),  # and up (y points down)
        ((0.0, 0.0, 90.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),  # what lies right moves down
    ):
        turned = turn(order, *angles) @ torch.tensor(vector, dtype=torch.float64)
        torch.testing.assert_close(turned, torch.tensor(expected, dtype=torch.float64))


def test_the_orders_are_the_stated_products_and_differ() -> None:
    z, y, x = turn("zyx", 0, 0, 50), turn("zyx", 30, 0, 0), turn("zyx", 0, 40, 0)
    torch.testing.assert_close(turn("zyx", 30, 40, 50), z @ y @ x)
    torch.testing.assert_close(turn("zxy", 30, 40, 50), z @ x @ y)
    assert (z @ y @ x - z @ x @ y).abs().max() > 0.1


def test_a_published_homography() -> None:
    """yaw 4, pitch 7, roll 1 degrees in the order of the release, to five digits."""
    rows = [[0.96573, 0.03814, 49.149], [0.00229, 1.03397, -95.907], [-0.0001, 0.00017, 0.98008]]
    expected = torch.tensor([rows], dtype=torch.float64)
    torch.testing.assert_close(view(4.0, 7.0, 1.0), expected, atol=6e-6, rtol=2e-5)


# ---- inner rectangles -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("angles", "crop"),
    [
        ((4, 7, 1), (63, 639, 0, 375)),
        ((-9, 4, -1), (0, 512, 0, 409)),
        ((9, 9, 4), (137, 639, 0, 335)),
        ((-10, -10, -5), (0, 484, 148, 479)),
        ((0, 0, 4), (17, 621, 22, 456)),
        ((9, 0, 0), (125, 639, 13, 465)),
        ((0, 9, 0), (12, 626, 0, 361)),
    ],
)
def test_corners_are_the_published_crops(angles: tuple, crop: tuple) -> None:
    """x_min, x_max, y_min, y_max with upper bounds left out, by the release."""
    x_min, x_max, y_min, y_max = crop
    expected = torch.tensor([[x_min, y_min, x_max, y_max]], dtype=torch.float64) - 0.5
    assert torch.equal(inner_rectangle(view(*angles), HW, "corners"), expected)


def test_largest_rectangles_by_hand() -> None:
    one = torch.eye(3, dtype=torch.float64)[None]
    assert torch.equal(inner_rectangle(one, HW, "largest"), WHOLE)
    torch.testing.assert_close(inner_rectangle(view(0, 0, 0), HW, "largest"), WHOLE)
    # A shift leaves the overlap, a zoom the frame.
    shift = torch.tensor([[1, 0, 5], [0, 1, -3], [0, 0, 1]], dtype=torch.float64)
    zoom = torch.tensor([[2, 0, -10], [0, 2, -10], [0, 0, 1]], dtype=torch.float64)
    shrink = torch.tensor([[0.5, 0, 4], [0, 0.5, 4], [0, 0, 1]], dtype=torch.float64)
    found = inner_rectangle(torch.stack([shift, zoom, shrink]), (20, 30), "largest")
    rows = [[4.5, -0.5, 29.5, 16.5], [-0.5, -0.5, 29.5, 19.5], [3.75, 3.75, 18.75, 13.75]]
    torch.testing.assert_close(found, torch.tensor(rows, dtype=torch.float64))
    # A square turned by 45 degrees about its centre: an inscribed square of half its area. The
    # frame cuts the diamond's tips at 50 from the centre, its half diagonal is 70.7.
    c, middle, half = 0.5**0.5, 49.5, 25 * 2**0.5
    rows = [[c, -c, middle], [c, c, middle - 2 * c * middle], [0, 0, 1]]
    found = inner_rectangle(torch.tensor([rows], dtype=torch.float64), (100, 100), "largest")
    expected = [[49.5 - half] * 2 + [49.5 + half] * 2]
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


def shown(edges: np.ndarray, h: np.ndarray, slack: float = 0.0) -> np.ndarray:
    """(N,): whether all corners of rectangles (N, 4) lie in the view and show the first frame."""
    corners = np.stack(
        [*(edges[:, [0, 0, 2, 2]], edges[:, [1, 3, 1, 3]], np.ones((len(edges), 4)))]
    )
    back = np.einsum("ij,jnk->ink", np.linalg.inv(h), corners)
    last = np.array([HW[1], HW[0]])[:, None, None] - 0.5 + slack
    places = [corners[:2], back[:2] / back[2]]
    inside = [(place >= -0.5 - slack).all((0, 2)) & (place <= last).all((0, 2)) for place in places]
    return inside[0] & inside[1] & (back[2] > 0).all(1) & (edges[:, :2] < edges[:, 2:]).all(1)


def test_no_rectangle_nearby_is_larger() -> None:
    """The problem is concave: what no near rectangle exceeds is the largest."""
    views, rng = random_views(12, 0), np.random.default_rng(0)
    for h, found in zip(views.numpy(), inner_rectangle(views, HW, "largest").numpy(), strict=True):
        near = found + rng.normal(size=(20_000, 4)) * 10.0 ** rng.uniform(-3, 2, (20_000, 1))
        sizes = (near[:, 2:] - near[:, :2]).prod(1)[shown(near, h)]
        assert shown(found[None], h, 1e-5).all()
        assert len(sizes) > 100
        assert sizes.max() <= (found[2:] - found[:2]).prod() + 0.01


@pytest.mark.parametrize("rule", ["largest", "corners"])
def test_views_of_something_else_have_none(rule: Rule) -> None:
    others = [view(*angles) for angles in ((80, 0, 0), (60, 60, 0), (180, 0, 0), (0, -90, 3))]
    found = inner_rectangle(torch.cat([view(1, 2, 3), *others]), HW, rule)
    assert found.isnan().all(1).tolist() == [False, True, True, True, True]
