"""The street of a scene: the road, its strips on the ground, and the record of a placed object."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rgbt.randomness import numpy_generator
from rgbt.synth.camera import Floats
from rgbt.synth.factors import SceneFactors
from rgbt.synth.shapes import CURVE, INDEX, MAX_CORNERS, UNLABELED, Shape, shapes

Paint = tuple[float, float, float]

GROUND, BACKDROP, STANDING = range(3)
"""Drawing layers, first to last; within a layer far objects are drawn before near ones."""

NO_SHADOW = -1.0


class Placed(NamedTuple):
    """One object in the world, `x` metres right of the camera's start, `z` ahead, `y` above ground.

    Attributes:
        yaw: turn to the right in radians; 0 shows the shape's back.
        scale: factors on the shape's x, y, z.
        paints: first and second paint, reflectance (R, G, B).
        warmth: 0 cold (parked, well wrapped) to 1 (engine on, lightly dressed).
        lit: 0 or 1: whether its lamps are on by night.
        shadow_from: share of the height from which it casts a shadow, or `NO_SHADOW`.
    """

    shape: Shape
    x: float
    z: float
    yaw: float = 0.0
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    paints: tuple[Paint, Paint] = ((0.5, 0.5, 0.5), (0.3, 0.3, 0.3))
    warmth: float = 0.0
    lit: float = 0.0
    layer: int = STANDING
    shadow_from: float = 0.0
    y: float = 0.0


Row = list[float]
"""Uniform numbers in [0, 1) of one object: kind, place, pose (0-7), colour (8-11), heat (12-13)."""

COLOUR, HEAT = 8, 12


def draw_rows(seed: int, index: int, pool: str, num: int) -> list[Row]:
    """Numbers for the first `num` objects of the pool `pool` in scene `index`.

    Rows are drawn one after the other, so that the first rows do not depend on their number.
    """
    rows: list[Row] = numpy_generator(seed, f"synth/{pool}", index).random((num, 14)).tolist()
    return rows


KERB_M = (0.24, 0.17)
"""Width and height of a kerb. Wider than a real one, so that it is seen at 120 x 160 pixels."""

_STEPS = np.array([-4, 2, 5, 8, 12, 17, 24, 34, 50, 75, 120, 250], np.float32)


Numbers = float | NDArray[np.float64] | Floats


class Road(NamedTuple):
    """Course and cross-section, in metres; pairs are (left, right).

    Attributes:
        half_width: from the centre line to the kerb.
        centre: X of the centre line beside the camera; positive, traffic keeps left.
        curvature: 1 / metres, positive to the right.
        kerb_m: width and height of kerbs.
        crossing_z: distance of a zebra crossing, or None.
        line_phase: where in a dash the centre line begins, 0..1.
        patches: (n, 4) rows of Z, lateral position, width and length of repaired asphalt.
        manhole: (Z, lateral position).
    """

    half_width: float
    centre: float
    curvature: float
    sidewalk: tuple[float, float]
    kerb: tuple[bool, bool]
    kerb_m: tuple[float, float]
    crossing_z: float | None
    line_phase: float
    edge_line: bool
    patches: NDArray[np.float64]
    manhole: tuple[float, float]

    def x(self, z: float, lateral: float) -> float:
        """X of a point `lateral` metres right of the centre line at distance `z`."""
        return self.centre + lateral + 0.5 * self.curvature * z * z

    def heading(self, z: float) -> float:
        """Direction of the road at distance `z`, radians to the right of Z."""
        return math.atan(self.curvature * z)

    def sidewalk_of(self, side: int) -> float:
        """Width of the sidewalk of a side, -1 left or 1 right."""
        return self.sidewalk[0 if side < 0 else 1]

    def place(self, name: str, z: float, lateral: float, **settings: Any) -> Placed:
        """The shape of this name `lateral` metres right of the centre line at distance `z`."""
        return Placed(shapes()[name], self.x(z, lateral), z, **settings)


def draw_road(seed: int, index: int, factors: SceneFactors) -> Road:
    """The road of one scene."""
    generator = numpy_generator(seed, "synth/road", index)
    u = generator.random(16).tolist()
    half_width = 2.7 + 1.2 * u[0]
    return Road(
        half_width=half_width,
        centre=half_width * (0.30 + 0.25 * u[1]),
        curvature=0.0055 * (u[2] - 0.5) * (u[3] > 0.4),
        sidewalk=(1.6 + 2.2 * u[4], 1.6 + 2.2 * u[5]),
        kerb=(u[6] < 0.8 * factors.kerb_share, u[7] < 0.75 * factors.kerb_share),
        kerb_m=(KERB_M[0] * factors.kerb_scale, KERB_M[1] * factors.kerb_scale),
        crossing_z=7 + 9 * u[8] if u[9] < 0.3 else None,
        line_phase=u[10],
        edge_line=u[11] < 0.5,
        patches=generator.random((3, 4)) * (24, 4, 1.6, 4) + (4, -2, 0.6, 1.5),
        manhole=(5 + 10 * u[12], half_width * (u[13] - 0.5)),
    )


class Quads(NamedTuple):
    """Quads on the ground in drawing order: corners (F, 8, 3), material (F,), label (F,)."""

    corners: Floats
    material: NDArray[np.intp]
    label: NDArray[np.intp]


def ground_quads(road: Road) -> Quads:
    """Terrain, sidewalks, asphalt, markings and kerbs, from bottom to top."""
    w, (left, right) = road.half_width, road.sidewalk
    z, x, width, length = road.patches.T
    strips = [
        ("paving", UNLABELED, _strip(-w - left, -w)),
        ("paving", UNLABELED, _strip(w, w + right)),
        ("asphalt", UNLABELED, _strip(-w, w)),
        ("patch", UNLABELED, _rows(z, z + length, x, x + width)),
        *(("line", UNLABELED, rows) for rows in _markings(road)),
        *_kerbs(road),
    ]
    counts = [len(rows) for _, _, rows in strips]
    flat = [_flat(TERRAIN), _flat(_circle(road, *road.manhole, 0.36))]
    first = [INDEX["grass"], INDEX["manhole"]]
    return Quads(
        np.concatenate(
            [flat[0], _corners(road, np.concatenate([rows for _, _, rows in strips])), flat[1]]
        ),
        np.concatenate(
            [first[:1], np.repeat([INDEX[name] for name, _, _ in strips], counts), first[1:]]
        ),
        np.concatenate([[0], np.repeat([label for _, label, _ in strips], counts), [0]]),
    )


TERRAIN = [(-2500.0, -2.0), (-2500.0, 2500.0), (2500.0, 2500.0), (2500.0, -2.0)]
"""Corners (X, Z) of the ground around the road."""


def _flat(outline: list[tuple[float, float]]) -> Floats:
    padded = outline + [outline[-1]] * (MAX_CORNERS - len(outline))
    return np.array([[(x, 0, z) for x, z in padded]], np.float32)


def _circle(road: Road, z: float, lateral: float, radius: float) -> list[tuple[float, float]]:
    angles = [2 * math.pi * corner / MAX_CORNERS for corner in range(MAX_CORNERS)]
    x = road.x(z, lateral)
    return [(x + radius * math.cos(angle), z + radius * math.sin(angle)) for angle in angles]


def _rows(
    start: Numbers, end: Numbers, left: Numbers, right: Numbers, y: tuple[float, float] = (0, 0)
) -> Floats:
    """Quads as rows: Z of both ends, lateral position of both sides, height of both sides."""
    columns = (start, end, left, right, *y)
    rows = np.empty((max(np.size(column) for column in columns), 6), np.float32)
    for number, column in enumerate(columns):
        rows[:, number] = column
    return rows


def _strip(left: float, right: float, y: tuple[float, float] = (0, 0)) -> Floats:
    """A strip along the whole road."""
    return _rows(_STEPS[:-1], _STEPS[1:], left, right, y)


def _corners(road: Road, rows: Floats) -> Floats:
    """Corners (n, 8, 3) of quads given as rows, bent along the road."""
    corners = np.empty((len(rows), MAX_CORNERS, 3), np.float32)
    ends, sides, heights = rows[:, [0, 1, 1, 0]], rows[:, [2, 2, 3, 3]], rows[:, [4, 4, 5, 5]]
    corners[:, :4, 0] = sides + road.centre + 0.5 * road.curvature * ends * ends
    corners[:, :4, 1] = heights
    corners[:, :4, 2] = ends
    corners[:, 4:] = corners[:, 3:4]
    return corners


def _markings(road: Road) -> list[Floats]:
    """Dashes along the middle; in some streets edge lines, a zebra crossing with a stop line."""
    starts = np.arange(14) * 5.0 - 5.0 * road.line_phase
    lines = [_rows(starts, starts + 2.6, -0.07, 0.07)]
    if road.edge_line:
        inner = road.half_width - 0.35
        lines += [_strip(-inner - 0.12, -inner), _strip(inner, inner + 0.12)]
    if road.crossing_z is not None:
        x = np.arange(-road.half_width + 0.5, road.half_width - 0.7, 0.9)
        lines.append(_rows(road.crossing_z, road.crossing_z + 2.6, x, x + 0.45))
        stop = road.crossing_z - 1.6
        lines.append(_rows(stop, stop + 0.35, -road.half_width + 0.3, -0.1))
    return lines


def _kerbs(road: Road) -> list[tuple[str, int, Floats]]:
    width, height = road.kerb_m
    strips = []
    for side, present in zip((-1, 1), road.kerb, strict=True):
        if present:
            inner, outer = side * road.half_width, side * (road.half_width + width)
            strips.append(("kerb_top", CURVE, _strip(inner, outer, (height, height))))
            strips.append(("kerb_face", CURVE, _strip(inner, inner, (0, height))))
    return strips
