"""Collect the flat parts of a scene, and draw them into a map of their numbers.

Label, depth, colour and heat are derived from that map.

One map is drawn at twice the image size. Labels and depth are read at pixel centres, so they are
exact; colours are averaged around them (`average`), so edges are smooth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.synth.camera import NEAR_M, Floats, SynthCamera
from rgbt.synth.shapes import COLOURS, MAX_CORNERS
from rgbt.synth.street import Placed, Quads

SCALE = 2
"""Facets are drawn at this multiple of the image size."""

_SHIFT = 4
_SMALLEST = 0.8
"""Facets with a smaller projected extent, in pixels, are left out."""


@dataclass(frozen=True)
class Facets:
    """N facets, far to near: (N,) each, corners (N, 8, 3) world points, colour (N, 3) reflectance.

    `warmth` and `lit` are as in `Placed`, for buildings `lit` is the style of the windows; what is
    `on_ground` lies flat and receives shadows; `owner` is the number of the object, -1 the ground.
    """

    corners: Floats
    num_corners: NDArray[np.intp]
    material: NDArray[np.intp]
    label: NDArray[np.intp]
    thin: NDArray[np.bool_]
    colour: Floats
    warmth: Floats
    lit: Floats
    on_ground: NDArray[np.bool_]
    owner: NDArray[np.intp]


def sorted_for_drawing(placed: Sequence[Placed]) -> list[Placed]:
    """By layer, and within a layer the farthest first (painter's algorithm)."""
    return sorted(placed, key=lambda thing: (thing.layer, -thing.z))


def facets_of(ground: Quads, placed: Sequence[Placed]) -> Facets:
    """The ground's quads, then the parts of `placed`, one or more, in the order given."""
    shapes = [thing.shape for thing in placed]
    owner = np.repeat(np.arange(len(placed)), [len(shape.meta) for shape in shapes])
    # One table of numbers per object: many small arrays would cost more than all the arithmetic.
    numbers = np.array(
        [
            (p.x, p.y, p.z, p.yaw, p.warmth, p.lit, *p.scale, *p.paints[0], *p.paints[1])
            for p in placed
        ],
        np.float32,
    )[owner]
    meta = np.concatenate([shape.meta for shape in shapes])
    corners = _in_world(np.concatenate([shape.corners for shape in shapes]), numbers)
    painted = np.where(meta[:, 2:3] == 2, numbers[:, 12:15], numbers[:, 9:12])
    colour = np.where(meta[:, 2:3] > 0, painted, COLOURS[meta[:, 0]])

    num_ground = len(ground.material)
    no_heat = np.zeros(num_ground, np.float32)
    return Facets(
        corners=np.concatenate([ground.corners, corners]),
        num_corners=np.concatenate(
            [np.full(num_ground, MAX_CORNERS), *(s.num_corners for s in shapes)]
        ),
        material=np.concatenate([ground.material, meta[:, 0]]),
        label=np.concatenate([ground.label, meta[:, 1]]),
        thin=np.concatenate([np.ones(num_ground, bool), meta[:, 3] > 0]),
        colour=np.concatenate([COLOURS[ground.material], colour]),
        warmth=np.concatenate([no_heat, numbers[:, 4]]),
        lit=np.concatenate([no_heat, numbers[:, 5]]),
        on_ground=np.arange(num_ground + len(meta)) < num_ground,
        owner=np.concatenate([np.full(num_ground, -1), owner]),
    )


def _in_world(local: Floats, numbers: Floats) -> Floats:
    """Corners scaled, turned about the upright axis and moved to where each object stands."""
    x, y, z, yaw = numbers[:, :4].T[:, :, None]
    scaled = local * numbers[:, None, 6:9]
    sin, cos = np.sin(yaw), np.cos(yaw)
    turned = np.empty_like(scaled)
    turned[..., 0] = scaled[..., 0] * cos + scaled[..., 2] * sin + x
    turned[..., 1] = scaled[..., 1] + y
    turned[..., 2] = scaled[..., 2] * cos - scaled[..., 0] * sin + z
    return turned


@dataclass(frozen=True)
class Drawing:
    """What the camera sees, as numbers of facets; 0 is the sky, n + 1 is facet n.

    Attributes:
        fine: (2H, 2W); the entry (2i, 2j) lies at the centre of pixel (i, j).
        ids: (H, W), the entries at pixel centres.
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
        polygons[row] = _fixed_point(
            beyond_near(by_corner[: counts[row], drawn[row]].tolist(), camera)
        )
    for number, polygon in zip(numbers[drawn].tolist(), polygons, strict=True):
        cv2.fillConvexPoly(fine, polygon, number + 1, cv2.LINE_8, _SHIFT)
    return fine


def _fixed_point(columns_rows: Floats) -> NDArray[np.int32]:
    limit = 2**26
    return np.clip(np.rint(columns_rows * (SCALE << _SHIFT)), -limit, limit).astype(np.int32)


def beyond_near(polygon: list[list[float]], camera: SynthCamera) -> Floats:
    """The part of a polygon beyond the near plane (Sutherland-Hodgman), (M, 2) as (column, row).

    `polygon` has corners (x, y, z) in camera coordinates, at least one beyond the plane.
    """
    kept = []
    for start, end in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        if start[2] >= NEAR_M:
            kept.append(start)
        if (start[2] >= NEAR_M) != (end[2] >= NEAR_M):
            share = (NEAR_M - start[2]) / (end[2] - start[2])
            kept.append([a + share * (b - a) for a, b in zip(start, end, strict=True)])
    return camera.project(np.array(kept, np.float32))
