"""Homographies of a camera that turns on the spot.

The view of a rotated pinhole camera is a homography of the old one, whatever the scene: virtual
views of Li et al., "Temporal Consistency for RGB-Thermal Data-based Semantic Scene
Understanding" (RA-L 2024), section III.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from rgbt.checks import check_shape

Order = Literal["zyx", "zxy"]
"""Order of the elementary rotations in the product: "zyx" = Rz Ry Rx, Eq. 1 of the paper;
"zxy" = Rz Rx Ry, its release (the two differ by up to 17 pixels at the corners of 480x640)."""


def rotation(angles: Tensor, order: Order) -> Tensor:
    """Rotation matrices (B, 3, 3) float64 of a camera frame with x right, y down and z forward.

    `angles` (B, 3) float are degrees, right-handed: yaw about y, pitch about x, roll about z.
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
    return about_z @ tilted


def homography(angles: Tensor, matrix: Tensor, order: Order) -> Tensor:
    """K R K^-1: pixels of the first frame to pixels of the view, w > 0 in front of the camera.

    `angles` (B, 3) as of `rotation`, `matrix` (3, 3) K from `rgbt.geometry.camera.Camera.matrix`;
    (B, 3, 3) float64 on the device of `angles`; pixel centres lie at whole numbers.
    """
    matrix = matrix.to(angles.device, torch.float64)
    inverse: Tensor = torch.linalg.inv_ex(matrix).inverse
    return matrix @ rotation(angles, order) @ inverse
