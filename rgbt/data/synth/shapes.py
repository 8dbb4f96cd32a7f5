"""Represent shapes as lists of flat, convex parts with a material, with helpers to build them.

Local coordinates: x right, y up, z ahead (away from the camera for yaw 0), metres, standing on
y = 0.
The shapes of single objects are in `cars`, `people`, `furniture`, `backdrop`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rgbt.data.synth.materials import INDEX

UNLABELED, CAR, PERSON, BIKE, CURVE, CAR_STOP, GUARDRAIL, COLOR_CONE, BUMP = range(9)
"""MFNet's label ids."""

MAX_CORNERS = 8
"""Parts are padded to this many corners by repeating the last one."""

Point = tuple[float, float, float]


class Face(NamedTuple):
    """A flat convex polygon.

    Attributes:
        corners: three to eight points; the first three do not lie on one line.
        material: name in `MATERIALS`.
        label: class id.
        paint: 0 the material's own colour, 1 or 2 the object's first or second paint.
        thin: seen from both sides; otherwise only from outside the shape.
    """

    corners: Sequence[Point]
    material: str
    label: int = UNLABELED
    paint: int = 0
    thin: bool = False


def thin(corners: Sequence[Point], material: str, label: int = UNLABELED, paint: int = 0) -> Face:
    """A part that is seen from both sides."""
    return Face(corners, material, label, paint, thin=True)


@dataclass(frozen=True, eq=False)
class Shape:
    """Parts as arrays, in drawing order.

    Attributes:
        corners: (F, 8, 3) float32, oriented so that normals of solid parts point outwards.
        num_corners: (F,) int.
        meta: (F, 4) int: material index, label, paint, thin.
        half_width: half the extent along x, for shadows.
        half_length: half the extent along z.
        height: extent along y.
    """

    corners: NDArray[np.float32]
    num_corners: NDArray[np.intp]
    meta: NDArray[np.intp]
    half_width: float
    half_length: float
    height: float


def shape_of(parts: Sequence[Face]) -> Shape:
    """Parts, in drawing order, as a Shape."""
    corners = np.array(
        [
            list(part.corners) + [part.corners[-1]] * (MAX_CORNERS - len(part.corners))
            for part in parts
        ],
        np.float32,
    )
    low, high = corners.min((0, 1)), corners.max((0, 1))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = ((corners[:, 0] - (low + high) / 2) * normals).sum(1) >= 0
    counts = np.array([len(part.corners) for part in parts], np.intp)
    for row in np.flatnonzero(~outward):
        corners[row, : counts[row]] = corners[row, : counts[row]][::-1].copy()
        corners[row, counts[row] :] = corners[row, counts[row] - 1]
    meta = [(INDEX[part.material], part.label, part.paint, part.thin) for part in parts]
    half_width, height, half_length = np.maximum(np.abs(low), np.abs(high)).tolist()
    return Shape(corners, counts, np.array(meta, np.intp), half_width, half_length, height)


def upright(outline: Sequence[tuple[float, float]], z: float = 0.0) -> list[Point]:
    """Outline of (x, y) points in the plane of constant z."""
    return [(x, y, z) for x, y in outline]


def sideways(outline: Sequence[tuple[float, float]], x: float = 0.0) -> list[Point]:
    """Outline of (z, y) points in the plane of constant x."""
    return [(x, y, z) for z, y in outline]


def flat(outline: Sequence[tuple[float, float]], y: float = 0.0) -> list[Point]:
    """Outline of (x, z) points in the plane of constant y."""
    return [(x, y, z) for x, z in outline]


def rectangle(a: float, b: float, c: float, d: float) -> list[tuple[float, float]]:
    """Rectangle from (a, b) to (c, d)."""
    return [(a, b), (c, b), (c, d), (a, d)]


def disc(a: float, b: float, radius: float, num: int = MAX_CORNERS) -> list[tuple[float, float]]:
    """Regular polygon around (a, b)."""
    angles = np.arange(num) * 2 * np.pi / num + np.pi / num
    return [(a + radius * float(np.cos(t)), b + radius * float(np.sin(t))) for t in angles]


def tube(
    start: tuple[float, float], end: tuple[float, float], thickness: float
) -> list[tuple[float, float]]:
    """A line of a given thickness, as a rectangle."""
    step = np.subtract(end, start)
    side = np.array([-step[1], step[0]]) / np.hypot(*step) * thickness / 2
    points = [
        np.add(start, side),
        np.add(end, side),
        np.subtract(end, side),
        np.subtract(start, side),
    ]
    return [(float(p[0]), float(p[1])) for p in points]


def box(
    low: Point,
    high: Point,
    materials: str | tuple[str, str, str],
    label: int = UNLABELED,
    paint: int = 0,
) -> list[Face]:
    """Five faces of a box without its bottom, from its smallest to its largest corner.

    `materials` is one name, or names for the ends (z), the sides (x) and the top.
    """
    ends, sides, top = (materials,) * 3 if isinstance(materials, str) else materials
    (x0, y0, z0), (x1, y1, z1) = low, high
    faces = [
        (upright(rectangle(x0, y0, x1, y1), z0), ends),
        (upright(rectangle(x0, y0, x1, y1), z1), ends),
        (sideways(rectangle(z0, y0, z1, y1), x0), sides),
        (sideways(rectangle(z0, y0, z1, y1), x1), sides),
        (flat(rectangle(x0, z0, x1, z1), y1), top),
    ]
    return [Face(corners, material, label, paint) for corners, material in faces]
