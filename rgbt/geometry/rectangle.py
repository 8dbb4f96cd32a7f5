"""Compute the axis-parallel crop of a turned view: the largest one, or that of the release.

Rectangles are (left, top, right, bottom) in pixel EDGES: pixel j covers [j - 0.5, j + 0.5], so a
whole image is (-0.5, -0.5, W - 0.5, H - 0.5).

**largest**: what of the view shows the first frame is a convex polygon, bounded by the four sides
of the frame and the four lines that the sides of the first frame became. A half-plane
a x + b y <= c holds for a rectangle if it holds for one corner of it, so there are eight linear
constraints on (left, right, top, bottom). The logarithm of the area is concave: the maximum has
four active constraints, or three and no slope along the line they leave. All 70 + 56 such points
are computed, and the largest rectangle that breaks no constraint is taken: no search, no grid.

**corners**: the release maps the four corner pixels, takes the second smallest and second largest
of each coordinate, cuts off the fraction and clamps to the frame; the last pixel is left out.
"""

from __future__ import annotations

from itertools import combinations
from typing import Literal

import torch
from torch import Tensor

from rgbt.checks import InputError, check_shape

Rule = Literal["largest", "corners"]
"""How the rectangle is found; see the module."""

SLACK = 1e-6
"""Pixels by which a computed corner may leave the polygon: rounding, far below 1/32 pixel."""


def inner_rectangle(homography: Tensor, image_hw: tuple[int, int], rule: Rule) -> Tensor:
    """A rectangle of the view inside the picture of the first frame and inside the frame.

    `homography` (B, 3, 3) float64: pixels of the first frame to pixels of the view, w > 0 in front
    of the camera. "corners", as released, may hold a few pixels that the first frame does not show
    (up to 0.3 % in the published views). (B, 4) float64; NaN where there is none.
    """
    check_shape("homography", homography, "B M N", M=3, N=3)
    find = _largest if rule == "largest" else _by_corners
    return find(homography.double(), image_hw)


def check_rectangle(rectangle: Tensor, angles: Tensor) -> None:
    """Raise InputError where a view has no rectangle, with its angles; waits for the device."""
    empty = rectangle.isnan().any(dim=1)
    if bool(empty.any()):
        yaw, pitch, roll = angles[empty][0].tolist()
        raise InputError(f"yaw {yaw:g}, pitch {pitch:g}, roll {roll:g} leave no rectangle.")


def _half_planes(homography: Tensor, image_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Rows (B, 8, 4) and bounds (B, 8): rows @ (x1, x2, y1, y2) <= bounds.

    The sides of a frame are lines l with l . (x, y, 1) >= 0 inside; the homography turns l into
    l H^-1, which also holds only in front of the camera (left plus right side is W w >= 0).
    """
    height, width = image_hw
    sides = homography.new_tensor(
        [[1, 0, 0.5], [-1, 0, width - 0.5], [0, 1, 0.5], [0, -1, height - 0.5]]
    )
    inverse: Tensor = torch.linalg.inv_ex(homography).inverse
    warped = sides @ inverse
    lines = torch.cat([sides.expand_as(warped), warped], dim=1)
    lines = lines / lines[..., :2].norm(dim=-1, keepdim=True).clamp(min=1e-12)
    a, b = -lines[..., 0], -lines[..., 1]
    rows = torch.stack([a.clamp(max=0), a.clamp(min=0), b.clamp(max=0), b.clamp(min=0)], dim=-1)
    return rows, lines[..., 2]


def _largest(homography: Tensor, image_hw: tuple[int, int]) -> Tensor:
    rows, bounds = _half_planes(homography, image_hw)
    device, batch = rows.device, torch.arange(len(rows), device=rows.device)
    four = torch.tensor(list(combinations(range(8), 4)), device=device)
    three = torch.tensor(list(combinations(range(8), 3)), device=device)
    # Orthogonal to each of three rows: signed minors.
    others = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]], device=device)
    minors: Tensor = torch.linalg.det(rows[:, three][..., others].movedim(-2, -3))
    signs = minors.new_tensor([1.0, -1.0, 1.0, -1.0])
    dx1, dx2, dy1, dy2 = (minors * signs).unbind(-1)
    slope = torch.stack([dy1 - dy2, dy2 - dy1, dx1 - dx2, dx2 - dx1], dim=-1)
    systems = torch.cat([rows[:, four], torch.cat([rows[:, three], slope[:, :, None]], 2)], 1)
    values = torch.cat([bounds[:, four], torch.nn.functional.pad(bounds[:, three], (0, 1))], 1)
    points = torch.linalg.solve_ex(systems, values[..., None]).result[..., 0]
    x1, x2, y1, y2 = points.unbind(-1)
    holds = (points @ rows.mT <= bounds[:, None] + SLACK).all(-1) & (x2 > x1) & (y2 > y1)
    area = torch.where(holds, (x2 - x1) * (y2 - y1), -1.0)
    best = area.argmax(dim=1)
    found = torch.stack([x1, y1, x2, y2], dim=-1)[batch, best]
    return torch.where(holds[batch, best][:, None], found, torch.nan)


def _by_corners(homography: Tensor, image_hw: tuple[int, int]) -> Tensor:
    height, width = image_hw
    last = homography.new_tensor([width - 1.0, height - 1.0])
    grid = [[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]]
    corners = homography.new_tensor(grid) @ homography.mT
    second = (corners[..., :2] / corners[..., 2:]).sort(dim=1).values[:, 1:3].trunc()
    low, high = torch.minimum(second.clamp(min=0), last).unbind(1)
    valid = (corners[..., 2] > 0).all(1) & (high > low).all(1)
    return torch.where(valid[:, None], torch.cat([low, high], dim=1) - 0.5, torch.nan)
