"""The pinhole camera whose views are synthesised, the homographies of its turns, and their crops.

The view of a camera that turns on the spot is a homography of the old one, whatever the scene:
Li et al., "Temporal Consistency for RGB-Thermal Data-based Semantic Scene Understanding" (RA-L
2024), section III.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from rgbt.checks import InputError, check_shape
from rgbt.ranges import Pixels, Positive

Coordinate = Annotated[float, Interval(ge=-0.5, le=8192)]

# Order of the elementary rotations in the product: "zyx" = Rz Ry Rx, Eq. 1 of the paper;
# "zxy" = Rz Rx Ry, its release (the two differ by up to 17 pixels at the corners of 480x640).
Order = Literal["zyx", "zxy"]

# Which part of a view is cut out: the largest rectangle, or that of the release.
Rule = Literal["largest", "corners"]

# Pixels by which a computed corner may leave the polygon: rounding, far below 1/32 pixel.
SLACK = 1e-6


@dataclass(frozen=True)
class Camera:
    """Holds intrinsics of a pinhole camera for images of `height` x `width` pixels.

    Focal lengths along a row and a column, column and row of the principal point, in pixels, whose
    centres lie at whole numbers. InputError for a principal point outside the image: then these are
    the intrinsics of images of another size.
    """

    fx: Positive
    fy: Positive
    cx: Coordinate
    cy: Coordinate
    height: Pixels
    width: Pixels

    def __post_init__(self) -> None:
        inside = -0.5 <= self.cx <= self.width - 0.5 and -0.5 <= self.cy <= self.height - 0.5
        if not inside:
            raise InputError(
                f"camera: the principal point (cx={self.cx:g}, cy={self.cy:g}) lies outside an "
                f"image of {self.height}x{self.width}; set height and width of the calibration."
            )

    def matrix(self, image_hw: tuple[int, int]) -> Tensor:
        """Return the calibration matrix K, (3, 3) float64, for images of `image_hw`.

        Images of another size but the same aspect, to a pixel, are the same picture resized: focal
        lengths scale by s, and the principal point as pixel centres do, c' = (c + 0.5) s - 0.5. A
        crop counts as a whole image of the same field of view. InputError for another aspect.
        """
        height, width = image_hw
        sy, sx = height / self.height, width / self.width
        if abs(sy * self.width - width) >= 1:
            raise InputError(
                f"camera: expected images of {self.height}x{self.width} or of that aspect ratio, "
                f"got {height}x{width}; set the intrinsics of your camera."
            )
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        rows = [[self.fx * sx, 0.0, cx], [0.0, self.fy * sy, cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)


def homography(angles: Tensor, matrix: Tensor, order: Order) -> Tensor:
    """Return K R K^-1, from pixels of the first frame to the view's; w > 0 in front of the camera.

    `angles` (B, 3) float are degrees, right-handed: yaw about y (down), pitch about x (right), roll
    about z (ahead); `matrix` (3, 3) is K of `Camera.matrix`. (B, 3, 3) float64 on their device.
    """
    check_shape("angles", angles, "B 3", **{"3": 3})
    radians = torch.deg2rad(angles.double())
    (cy, cx, cz), (sy, sx, sz) = radians.cos().unbind(1), radians.sin().unbind(1)
    zero, one = torch.zeros_like(cy), torch.ones_like(cy)

    def matrices(*entries: Tensor) -> Tensor:
        return torch.stack(entries, dim=1).view(-1, 3, 3)

    about_y = matrices(cy, zero, sy, zero, one, zero, -sy, zero, cy)
    about_x = matrices(one, zero, zero, zero, cx, -sx, zero, sx, cx)
    about_z = matrices(cz, -sz, zero, sz, cz, zero, zero, zero, one)
    tilted = about_y @ about_x if order == "zyx" else about_x @ about_y
    matrix = matrix.to(angles.device, torch.float64)
    inverse: Tensor = torch.linalg.inv_ex(matrix).inverse
    return matrix @ (about_z @ tilted) @ inverse


def inner_rectangle(homography: Tensor, image_hw: tuple[int, int], rule: Rule) -> Tensor:
    """Find an upright rectangle of the view, inside the picture of the first frame and the frame.

    `homography` (B, 3, 3) float64: pixels of the first frame to pixels of the view, w > 0 in front
    of the camera. "corners", as released, may hold a few pixels that the first frame does not show
    (up to 0.3 % in the published views). (B, 4) float64, (left, top, right, bottom) in pixel EDGES:
    a whole image is (-0.5, -0.5, W - 0.5, H - 0.5); NaN where there is none.
    """
    check_shape("homography", homography, "B M N", M=3, N=3)
    find = _largest if rule == "largest" else _by_corners
    return find(homography.double(), image_hw)


def _by_corners(homography: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """Take second extremes of the mapped corner pixels, truncated, clamped, less the last one."""
    height, width = image_hw
    last = homography.new_tensor([width - 1.0, height - 1.0])
    grid = [[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]]
    corners = homography.new_tensor(grid) @ homography.mT
    second = (corners[..., :2] / corners[..., 2:]).sort(dim=1).values[:, 1:3].trunc()
    low, high = torch.minimum(second.clamp(min=0), last).unbind(1)
    valid = (corners[..., 2] > 0).all(1) & (high > low).all(1)
    return torch.where(valid[:, None], torch.cat([low, high], dim=1) - 0.5, torch.nan)


def _largest(homography: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """Find the largest rectangle by the points where constraints meet: no search, no grid.

    What of the view shows the first frame is a convex polygon, bounded by the four sides of the
    frame and the four lines that the sides of the first frame became: a side is a line l with
    l . (x, y, 1) >= 0 inside, and becomes l H^-1, which also holds only in front of the camera. A
    half-plane holds for a rectangle if it holds for one corner of it: eight constraints
    rows @ (left, right, top, bottom) <= bounds. The logarithm of the area is concave: the maximum
    has four active constraints, or three and no slope along the line they leave: 70 + 56 points.
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
    bounds = lines[..., 2]

    device, batch = rows.device, torch.arange(len(rows), device=rows.device)
    four = torch.tensor(list(combinations(range(8), 4)), device=device)
    three = torch.tensor(list(combinations(range(8), 3)), device=device)
    # Orthogonal to each of three rows: signed minors.
    others = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]], device=device)
    minors: Tensor = torch.linalg.det(rows[:, three][..., others].movedim(-2, -3))
    dx1, dx2, dy1, dy2 = (minors * minors.new_tensor([1.0, -1.0, 1.0, -1.0])).unbind(-1)
    slope = torch.stack([dy1 - dy2, dy2 - dy1, dx1 - dx2, dx2 - dx1], dim=-1)
    systems = torch.cat([rows[:, four], torch.cat([rows[:, three], slope[:, :, None]], 2)], 1)
    values = torch.cat([bounds[:, four], torch.nn.functional.pad(bounds[:, three], (0, 1))], 1)

    points = torch.linalg.solve_ex(systems, values[..., None]).result[..., 0]
    x1, x2, y1, y2 = points.unbind(-1)
    holds = (points @ rows.mT <= bounds[:, None] + SLACK).all(-1) & (x2 > x1) & (y2 > y1)
    best = torch.where(holds, (x2 - x1) * (y2 - y1), -1.0).argmax(dim=1)
    found = torch.stack([x1, y1, x2, y2], dim=-1)[batch, best]
    return torch.where(holds[batch, best][:, None], found, torch.nan)
