"""Pinhole camera above the ground plane: projection, rays, and the motion between two frames.

World: X right, Y up, Z ahead, metres, ground at Y = 0. Camera: x right, y down, z ahead. Pixels:
the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rgbt.synth.factors import EgoMotion, SceneFactors

Floats = NDArray[np.float32]
Real = TypeVar("Real", np.float32, np.float64)


def floats(values: Sequence[object] | NDArray[np.float64]) -> Floats:
    """Return a float32 array of `values`."""
    return np.array(values, np.float32)


# Seed and index of a scene.
Key = tuple[int, int]

# Nothing nearer than this along the optical axis is drawn.
NEAR_M = 0.3


@dataclass(frozen=True)
class SynthCamera:
    """Projects between world and pixels; metres, radians downward (`pitch`) and right (`yaw`)."""

    height: int
    width: int
    focal: float
    position: tuple[float, float, float]
    pitch: float
    yaw: float = 0.0

    @property
    def centre(self) -> tuple[float, float]:
        """Return (column, row) of the optical axis: the middle of the image."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Return (3, 3) float64: rows are the camera's x, y and z axes in world coordinates."""
        sin_yaw, cos_yaw = np.sin(self.yaw), np.cos(self.yaw)
        sin_pitch, cos_pitch = np.sin(self.pitch), np.cos(self.pitch)
        return np.array(
            [
                [cos_yaw, 0.0, -sin_yaw],
                [-sin_yaw * sin_pitch, -cos_pitch, -cos_yaw * sin_pitch],
                [sin_yaw * cos_pitch, -sin_pitch, cos_yaw * cos_pitch],
            ]
        )

    def to_camera(self, points: NDArray[Real]) -> NDArray[Real]:
        """Convert world points (..., 3) to camera coordinates, in the precision they come in."""
        # One list of points: a stack of small matrices would be multiplied one by one.
        moved = points.reshape(-1, 3) - np.asarray(self.position, points.dtype)
        return (moved @ self.rotation.T.astype(points.dtype)).reshape(points.shape)

    def project(self, points_in_camera: Floats) -> Floats:
        """Project points (..., 3) of the camera to (column, row); depth is held above `NEAR_M`."""
        scale = np.reciprocal(np.maximum(points_in_camera[..., 2:], np.float32(NEAR_M)))
        scale *= np.float32(self.focal)
        return points_in_camera[..., :2] * scale + floats(self.centre)

    def rays(self) -> Floats:
        """Return camera coordinates of the point at depth 1 that each pixel sees, (3, H, W)."""
        column, row = self.centre
        rays = np.ones((3, self.height, self.width), np.float32)
        rays[0] = (np.arange(self.width, dtype=np.float32) - column) / self.focal
        rays[1] = ((np.arange(self.height, dtype=np.float32) - row) / self.focal)[:, None]
        return rays

    def turned(self, vectors_3HW: Floats) -> Floats:
        """Turn vectors (3, H, W) from camera coordinates to world coordinates."""
        flat = vectors_3HW.reshape(3, -1)
        return (self.rotation.T.astype(np.float32) @ flat).reshape(vectors_3HW.shape)

    def to_world(self, rays_3HW: Floats, inverse_depth_HW: Floats) -> Floats:
        """Return world points along `rays_3HW`, (3, H, W); 10 km away where inverse depth is 0."""
        depth = np.reciprocal(np.maximum(inverse_depth_HW, np.float32(1e-4)))
        return self.turned(rays_3HW) * depth + floats(self.position)[:, None, None]

    def moved(self, motion: EgoMotion) -> SynthCamera:
        """Return the camera after `motion`."""
        yaw, step = self.yaw + float(np.deg2rad(motion.yaw_deg)), motion.forward_m
        x, y, z = self.position
        position = (x + step * float(np.sin(yaw)), y, z + step * float(np.cos(yaw)))
        return replace(self, position=position, yaw=yaw)


def camera_of(factors: SceneFactors) -> SynthCamera:
    """Make the camera that the factors describe, above the origin, looking along Z."""
    focal = factors.width / 2 / np.tan(np.deg2rad(factors.field_of_view_deg) / 2)
    position, pitch = (0.0, factors.camera_height_m, 0.0), np.deg2rad(factors.camera_pitch_deg)
    return SynthCamera(factors.height, factors.width, float(focal), position, float(pitch))


def flow_between(depth_HW: Floats, source: SynthCamera, target: SynthCamera) -> Floats:
    """Return the displacement of pixels of `source` to `target`, for a static scene.

        p' = K (R' R^T K^-1 p z + R' (C - C')) / z',   flow = p' - p

    with R, C rotation and position of `source`, R', C' those of `target`, a camera that differs in
    nothing else, and z the depth in metres, infinity for the sky. (H, W, 2) float32 (rows, columns)
    in pixels, NaN behind `target`.
    """
    assert replace(target, position=source.position, pitch=source.pitch, yaw=source.yaw) == source
    shift = target.rotation @ (np.asarray(source.position) - np.asarray(target.position))
    rays = source.rays()
    turned = np.tensordot((target.rotation @ source.rotation.T).astype(np.float32), rays, 1)
    # Divided by the depth, so that the sky (inverse depth 0) needs no case of its own.
    points = turned + (1.0 / depth_HW) * shift.astype(np.float32)[:, None, None]
    ahead = np.where(points[2] > 0, points[2], np.nan)
    rows, columns = (points[axis] / ahead - rays[axis] for axis in (1, 0))
    return np.asarray(np.stack([rows, columns], axis=2) * np.float32(source.focal), np.float32)
