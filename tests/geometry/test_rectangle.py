"""The inner rectangle: published crops, an independent search, and views without one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from rgbt.checks import InputError
from rgbt.geometry.homography import homography
from rgbt.geometry.rectangle import Rule, check_rectangle, inner_rectangle
from tests.geometry.views import HW, RELEASED, random_views

WHOLE = torch.tensor([[-0.5, -0.5, HW[1] - 0.5, HW[0] - 0.5]], dtype=torch.float64)


def view(*angles: float) -> Tensor:
    return homography(torch.tensor([angles]), RELEASED.matrix(HW), "zxy")


def area(rectangle: Tensor) -> Tensor:
    left, top, right, bottom = rectangle.unbind(-1)
    return (right - left) * (bottom - top)


def outline(h: Tensor, hw: tuple[int, int]) -> Tensor:
    """(4, 2): corners of the first frame, pixel edges, in the view; in order around it."""
    right, bottom = hw[1] - 0.5, hw[0] - 0.5
    frame = [[-0.5, -0.5, 1], [right, -0.5, 1], [right, bottom, 1], [-0.5, bottom, 1]]
    points = h.new_tensor(frame) @ h.T
    assert bool((points[:, 2] > 0).all())
    return points[:, :2] / points[:, 2:]


def inside_by(rectangle: Tensor, corners: Tensor) -> float:
    """Smallest signed distance of the rectangle's corners to the sides of a convex polygon."""
    left, top, right, bottom = rectangle
    own = torch.stack([torch.stack([x, y]) for x in (left, right) for y in (top, bottom)])
    along = corners.roll(-1, 0) - corners
    normal = torch.stack([-along[:, 1], along[:, 0]], 1) / along.norm(dim=1, keepdim=True)
    distance = ((own[:, None] - corners) * normal).sum(-1)
    turned = torch.sign(torch.linalg.det(along[:2]))
    return float((distance * turned).min())


def span(x: NDArray[np.float64], polygon: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Lowest and highest y of a convex polygon at columns x; high < low beside it."""
    low, high = np.full_like(x, np.inf), np.full_like(x, -np.inf)
    for a, b in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        if a[0] == b[0]:
            continue
        on = (x >= min(a[0], b[0])) & (x <= max(a[0], b[0]))
        y = a[1] + (x - a[0]) / (b[0] - a[0]) * (b[1] - a[1])
        low, high = np.where(on, np.minimum(low, y), low), np.where(on, np.maximum(high, y), high)
    return low, high


def searched(h: Tensor, hw: tuple[int, int]) -> float:
    """Largest area by looking: for many left sides the best right one, then closing in.

    The logarithm of the area is concave in both, so a search by thirds finds the right side, and
    the best left side lies between the neighbours of the best one tried.
    """
    polygon = outline(h, hw).numpy()
    low, high = max(polygon[:, 0].min(), -0.5), min(polygon[:, 0].max(), hw[1] - 0.5)

    def sizes(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
        (top1, bottom1), (top2, bottom2) = span(left, polygon), span(right, polygon)
        bottom = np.minimum(np.minimum(bottom1, bottom2), hw[0] - 0.5)
        height = bottom - np.maximum(np.maximum(top1, top2), -0.5)
        return np.where(height > 0, (right - left) * height, height)

    lefts = np.linspace(low, high, 101)[:-1]
    best = 0.0
    for _ in range(5):
        near, far = lefts.copy(), np.full_like(lefts, high)
        for _ in range(70):
            third = (far - near) / 3
            better = sizes(lefts, near + third) < sizes(lefts, far - third)
            near, far = np.where(better, near + third, near), np.where(better, far, far - third)
        found = sizes(lefts, (near + far) / 2)
        best, at = max(best, float(found.max())), int(found.argmax())
        lefts = np.linspace(lefts[max(at - 1, 0)], lefts[min(at + 1, 99)], 100)
    return best


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


def test_the_largest_rectangle_of_the_whole_frame_is_the_frame() -> None:
    one = torch.eye(3, dtype=torch.float64)[None]
    assert torch.equal(inner_rectangle(one, HW, "largest"), WHOLE)
    torch.testing.assert_close(inner_rectangle(view(0, 0, 0), HW, "largest"), WHOLE)


def test_a_shift_leaves_the_overlap_and_a_zoom_the_frame() -> None:
    shift = torch.tensor([[1, 0, 5], [0, 1, -3], [0, 0, 1]], dtype=torch.float64)
    zoom = torch.tensor([[2, 0, -10], [0, 2, -10], [0, 0, 1]], dtype=torch.float64)
    shrink = torch.tensor([[0.5, 0, 4], [0, 0.5, 4], [0, 0, 1]], dtype=torch.float64)
    found = inner_rectangle(torch.stack([shift, zoom, shrink]), (20, 30), "largest")
    expected = [[4.5, -0.5, 29.5, 16.5], [-0.5, -0.5, 29.5, 19.5], [3.75, 3.75, 18.75, 13.75]]
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


def test_a_diamond_has_the_rectangle_of_half_its_size() -> None:
    """A square turned by 45 degrees about its centre: an inscribed square of half its area."""
    c, middle = 0.5**0.5, 49.5
    turn = [[c, -c, middle], [c, c, middle - 2 * c * middle], [0, 0, 1]]
    found = inner_rectangle(torch.tensor([turn], dtype=torch.float64), (100, 100), "largest")
    # The frame cuts the diamond's tips at 50 from the centre, its half diagonal is 70.7.
    side = 50 * 2**0.5
    expected = [[49.5 - side / 2] * 2 + [49.5 + side / 2] * 2]
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("seed", [0, 1])
def test_no_rectangle_of_a_grid_search_is_larger(seed: int) -> None:
    views = random_views(10, seed)
    found = inner_rectangle(views, HW, "largest")
    for h, rectangle in zip(views, found, strict=True):
        assert inside_by(rectangle, outline(h, HW)) > -2e-6
        assert float(area(rectangle)) == pytest.approx(searched(h, HW), rel=1e-6)


@pytest.mark.parametrize("rule", ["largest", "corners"])
@pytest.mark.parametrize("angles", [(80, 0, 0), (60, 60, 0), (180, 0, 0), (0, -90, 3)])
def test_views_of_something_else_have_none(rule: Rule, angles: tuple) -> None:
    both = torch.cat([view(1, 2, 3), view(*angles)])
    found = inner_rectangle(both, HW, rule)
    assert found.isnan().all(1).tolist() == [False, True]
    with pytest.raises(InputError, match=rf"yaw {angles[0]}, pitch {angles[1]}, roll") as caught:
        check_rectangle(found, torch.tensor([(1, 2, 3), angles]))
    assert "\n" not in str(caught.value)
