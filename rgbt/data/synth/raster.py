"""Draw facets into a map of facet numbers, from which label, depth, colour and heat are derived.

One map is drawn at twice the image size. Labels and depth are read at pixel centres, so they are
exact; colours are averaged around them (`average`), so edges are smooth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.data.synth.camera import NEAR_M, Floats, SynthCamera
from rgbt.data.synth.facets import Facets

SCALE = 2
"""Facets are drawn at this multiple of the image size."""

_SHIFT = 4
_SMALLEST = 0.8
"""Facets with a smaller projected extent, in pixels, are left out."""


@dataclass(frozen=True)
class Drawing:
    """What the camera sees, as numbers of facets; 0 is the sky, n + 1 is facet n.

    Attributes:
        fine: (2H, 2W) int; the entry (2i, 2j) lies at the centre of pixel (i, j).
        ids: (H, W) int, the entries at pixel centres.
        planes: (N + 1, 3) float32; inverse depth of a pixel is ``planes[id] @ ray``.
        bounds: (N + 1, 2) float32, smallest and largest inverse depth of each facet's corners.
        normals: (N + 1, 3) float32 unit normals in world coordinates, towards the camera.
    """

    fine: NDArray[np.intp]
    ids: NDArray[np.intp]
    planes: Floats
    bounds: Floats
    normals: Floats

    def inverse_depth(self, rays_3HW: Floats) -> Floats:
        """(H, W) float32, 1 / metres along the optical axis, 0 for the sky."""
        total = np.zeros(self.ids.shape, np.float32)
        for plane, ray in zip(np.ascontiguousarray(self.planes.T), rays_3HW, strict=True):
            total += np.take(plane, self.ids) * ray
        # Outlines are up to half a pixel wide: there the plane of a grazing facet would run away.
        low, high = np.ascontiguousarray(self.bounds.T)
        return np.clip(total, np.take(low, self.ids), np.take(high, self.ids))


def draw(facets: Facets, camera: SynthCamera) -> Drawing:
    """Facets in their order, later ones over earlier ones."""
    corners = camera.to_camera(facets.corners)
    # In double precision: the terrain is a plane through corners kilometres away.
    first, second, third = camera.to_camera(facets.corners[:, :3].astype(np.float64)).transpose(
        1, 0, 2
    )
    normals = _cross(second - first, third - first)
    offset = (normals * first).sum(1)
    # y runs down in camera coordinates, which mirrors the world: outward normals point inwards.
    seen = (offset > 1e-9) | (facets.thin & (offset < -1e-9))
    fine = _paint(corners, facets.num_corners, seen, camera)
    ids = fine.astype(np.intp)
    planes = normals / np.where(offset == 0, 1, offset)[:, None]
    length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    towards = -np.sign(offset)[:, None] * normals / length[:, None]
    depth = corners[..., 2].T
    bounds = 1.0 / np.maximum(np.stack([depth.max(0), depth.min(0)], 1), NEAR_M)
    sky = np.zeros((1, 3), np.float32)
    return Drawing(
        fine=ids,
        ids=np.ascontiguousarray(ids[::SCALE, ::SCALE]),
        planes=np.concatenate([sky, planes.astype(np.float32)]),
        bounds=np.concatenate([sky[:, :2], bounds.astype(np.float32)]),
        normals=np.concatenate([sky, (towards @ camera.rotation).astype(np.float32)]),
    )


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Row by row; np.cross takes ten times as long on arrays of this size."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def average(values_N4: NDArray[np.uint8], drawing: Drawing) -> NDArray[np.uint8]:
    """Four values per facet, averaged around each pixel (binomial weights, 0.5 pixels wide).

    From (N + 1, 4) uint8, row 0 for the sky, to (H, W, 4) uint8.
    """
    packed = np.ascontiguousarray(values_N4).view(np.uint32)[:, 0]
    fine = np.take(packed, drawing.fine, mode="clip").view(np.uint8)
    return np.asarray(cv2.pyrDown(fine.reshape(*drawing.fine.shape, 4)), np.uint8)


def _paint(
    corners: Floats, num_corners: NDArray[np.intp], seen: NDArray[np.bool_], camera: SynthCamera
) -> NDArray[np.uint16]:
    numbers = np.flatnonzero(seen)
    # Corners first: the reductions over them are several times faster along the first axis.
    by_corner = np.ascontiguousarray(corners[numbers].transpose(1, 0, 2))
    columns_rows = camera.project(by_corner)
    low, high = columns_rows.min(0), columns_rows.max(0)
    nearest, farthest = by_corner[..., 2].min(0), by_corner[..., 2].max(0)
    crosses = nearest < NEAR_M
    size = (camera.width, camera.height)
    inside = (high >= 0).all(1) & (low < size).all(1) & ((high - low).max(1) > _SMALLEST)
    drawn = np.flatnonzero((inside | crosses) & (farthest > NEAR_M))

    points = np.ascontiguousarray(_fixed_point(columns_rows[:, drawn]).transpose(1, 0, 2))
    counts = num_corners[numbers[drawn]].tolist()
    fine = np.zeros((camera.height * SCALE, camera.width * SCALE), np.uint16)
    polygons = [points[row, :count] for row, count in enumerate(counts)]
    for row in np.flatnonzero(crosses[drawn]).tolist():
        polygons[row] = _clipped(by_corner[: counts[row], drawn[row]].tolist(), camera)
    for number, polygon in zip(numbers[drawn].tolist(), polygons, strict=True):
        cv2.fillConvexPoly(fine, polygon, number + 1, cv2.LINE_8, _SHIFT)
    return fine


def _fixed_point(columns_rows: Floats) -> NDArray[np.int32]:
    limit = 2**26
    return np.clip(np.rint(columns_rows * (SCALE << _SHIFT)), -limit, limit).astype(np.int32)


def _clipped(polygon: list[list[float]], camera: SynthCamera) -> NDArray[np.int32]:
    """The part of a polygon beyond the near plane, in fixed point."""
    return _fixed_point(beyond_near(polygon, camera))


def beyond_near(polygon: list[list[float]], camera: SynthCamera) -> Floats:
    """The part of a polygon beyond the near plane (Sutherland-Hodgman).

    Args:
        polygon: corners (x, y, z) in camera coordinates, at least one beyond the plane.
        camera: that projects them.

    Returns:
        (M, 2) float32, (column, row).
    """
    kept = []
    for start, end in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        if start[2] >= NEAR_M:
            kept.append(start)
        if (start[2] >= NEAR_M) != (end[2] >= NEAR_M):
            share = (NEAR_M - start[2]) / (end[2] - start[2])
            kept.append([a + share * (b - a) for a, b in zip(start, end, strict=True)])
    return camera.project(np.array(kept, np.float32))
