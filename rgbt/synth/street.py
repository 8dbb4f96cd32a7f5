"""Materials and shapes, the record of a placed object, and the road with its strips on the ground.

Materials (``materials.csv``) have a reflectance, degrees above the air by day and at night
(plausible, not measured), further degrees when the object is warm, amplitudes of the texture in RGB
and in degrees, light that they give off at night (1 = white of the day), whether nothing heats them
but the sun, and the classes of scenery made of them.

Shapes (``shapes.csv``) are flat, convex faces in drawing order, one a line: x right, y up, z ahead
(away from the camera for yaw 0), metres, standing on y = 0; `thin` ones are seen from both sides,
the others from outside, where their normals point.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rgbt.randomness import numpy_generator
from rgbt.synth.camera import Floats, floats
from rgbt.synth.factors import SceneFactors

# MFNet's label ids.
UNLABELED, CAR, PERSON, BIKE, CURVE, CAR_STOP, GUARDRAIL, COLOR_CONE, BUMP = range(9)

# Reflectance of red, green and blue.
Paint = tuple[float, float, float]

# Faces are padded to this many corners by repeating the last one.
MAX_CORNERS = 8


def _table(name: str) -> list[dict[str, str]]:
    with Path(__file__).with_name(name).open(newline="") as lines:
        return list(csv.DictReader(lines))


_MATERIALS = _table("materials.csv")
# Material -> number. The sky comes first: index 0 is what is seen where nothing is drawn.
INDEX = {row["name"]: number for number, row in enumerate(_MATERIALS)}


def column(*fields: str) -> NDArray[np.float32]:
    """Return columns of the table of materials: (M,) of one, (M, n) of several, as in `INDEX`."""
    values = [[float(row[field]) for field in fields] for row in _MATERIALS]
    found = np.array(values, np.float32)
    return found[:, 0] if len(fields) == 1 else found


COLOURS = column("red", "green", "blue")


def paints(palette: str) -> list[Paint]:
    """Read the paints of cars, clothes or facades in ``paints.csv``."""
    rows = [row for row in _table("paints.csv") if row["palette"] == palette]
    return [(float(row["red"]), float(row["green"]), float(row["blue"])) for row in rows]


# (labels, materials) -> class id; 255 for materials that only labelled objects are made of.
Table = NDArray[np.uint8]


def class_table(classes: Sequence[str], by_label: Sequence[str], scenery: str) -> Table:
    """Return the class of every pair of label and material; ids follow the order of `classes`.

    `by_label` has the classes of MFNet's labels from 1 on, whatever the material; `scenery` is the
    column of the table of materials for what MFNet leaves unlabelled (0).
    """
    table = np.full((1 + len(by_label), len(INDEX)), 255, np.uint8)
    for number, row in enumerate(_MATERIALS):
        if row[scenery]:
            table[0, number] = classes.index(row[scenery])
    for label, name in enumerate(by_label, 1):
        table[label] = classes.index(name)
    return table


@dataclass(frozen=True, eq=False)
class Shape:
    """Holds the faces of one kind of object, as arrays in drawing order.

    Attributes:
        corners: (F, 8, 3) float32, of which `num_corners` (F,) differ.
        meta: (F, 4) int: material index, label, paint (0: the material's own colour, 1 or 2: the
            object's first or second), thin.
        half_width: half the extent along x, `half_length` along z, for shadows and collisions.
        height: extent along y.
    """

    name: str
    corners: NDArray[np.float32]
    num_corners: NDArray[np.intp]
    meta: NDArray[np.intp]
    half_width: float
    half_length: float
    height: float

    @classmethod
    def of(cls, name: str, faces: Sequence[tuple[NDArray[np.float32], Sequence[int]]]) -> Shape:
        """Make the shape of faces: corners (n, 3) and a row of `meta` each."""
        outlines, meta = zip(*faces, strict=True)
        counts = np.array([len(outline) for outline in outlines], np.intp)
        at = np.arange(MAX_CORNERS)
        corners = np.stack([outline[at.clip(max=len(outline) - 1)] for outline in outlines])
        half_width, height, half_length = np.abs(corners).max((0, 1)).tolist()
        return cls(name, corners, counts, np.array(meta, np.intp), half_width, half_length, height)


@cache
def shapes() -> dict[str, Shape]:
    """Read every shape of the table, by name."""
    found = {}
    for name, rows in groupby(_table("shapes.csv"), key=lambda row: row["shape"]):
        faces = [
            (
                np.array(row["corners"].split(), np.float32).reshape(-1, 3),
                (INDEX[row["material"]], int(row["label"]), int(row["paint"]), int(row["thin"])),
            )
            for row in rows
        ]
        found[name] = Shape.of(name, faces)
    return found


# Drawing layers, first to last; within a layer far objects are drawn before near ones.
GROUND, BACKDROP, STANDING = range(3)

NO_SHADOW = -1.0


class Placed(NamedTuple):
    """Places an object `x` metres right of the camera's start, `z` ahead, `y` above the ground.

    Attributes:
        yaw: turn to the right in radians; 0 shows the shape's back.
        scale: factors on the shape's x, y, z.
        paints: first and second paint, reflectance (R, G, B).
        warmth: 0 cold (parked, well wrapped) to 1 (engine on, lightly dressed).
        lit: 0 or 1: whether its lamps are on by night; of buildings the style of their windows.
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


# Uniform numbers in [0, 1) of one object: kind, place, pose (0-7), colour (8-11), heat (12-13).
Row = list[float]

COLOUR, HEAT = 8, 12


def draw_rows(seed: int, index: int, pool: str, num: int) -> list[Row]:
    """Draw numbers for the first `num` objects of the pool `pool` in scene `index`, row by row."""
    rows: list[Row] = numpy_generator(seed, f"synth/{pool}", index).random((num, 14)).tolist()
    return rows


# Width and height of a kerb. Wider than a real one, so that it is seen at 120 x 160 pixels.
KERB_M = (0.24, 0.17)

_STEPS = floats([-4, 2, 5, 8, 12, 17, 24, 34, 50, 75, 120, 250])
Numbers = float | NDArray[np.float64] | Floats


class Road(NamedTuple):
    """Describes course and cross-section, in metres; pairs are (left, right).

    Attributes:
        half_width: from the centre line to the kerb.
        centre: X of the centre line beside the camera; positive, traffic keeps left.
        curvature: 1 / metres, positive to the right.
        kerb: whether there is one; `kerb_m` are its width and height.
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
        """Return X of a point `lateral` metres right of the centre line at distance `z`."""
        return self.centre + lateral + 0.5 * self.curvature * z * z

    def heading(self, z: float) -> float:
        """Return the direction of the road at distance `z`, radians to the right of Z."""
        return math.atan(self.curvature * z)

    def sidewalk_of(self, side: int) -> float:
        """Return the width of the sidewalk of a side, -1 left or 1 right."""
        return self.sidewalk[0 if side < 0 else 1]

    def place(self, name: str, z: float, lateral: float, **settings: Any) -> Placed:
        """Place the shape `name` `lateral` metres right of the centre line at distance `z`."""
        return Placed(shapes()[name], self.x(z, lateral), z, **settings)


def draw_road(seed: int, index: int, factors: SceneFactors) -> Road:
    """Draw the road of one scene."""
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


# Quads on the ground in drawing order: corners (F, 8, 3), material (F,), label (F,).
Quads = tuple[Floats, NDArray[np.intp], NDArray[np.intp]]

# Corners (X, Z) of the ground around the road.
TERRAIN = [(-2500.0, -2.0), (-2500.0, 2500.0), (2500.0, 2500.0), *[(2500.0, -2.0)] * 5]


def ground_quads(road: Road) -> Quads:
    """Make terrain, sidewalks, asphalt, markings, kerbs and a manhole, from bottom to top."""
    w, (left, right) = road.half_width, road.sidewalk
    z, x, width, length = road.patches.T
    strips = [
        ("paving", UNLABELED, _strip(-w - left, -w)),
        ("paving", UNLABELED, _strip(w, w + right)),
        ("asphalt", UNLABELED, _strip(-w, w)),
        ("patch", UNLABELED, _rows(z, z + length, x, x + width)),
        *(("line", UNLABELED, rows) for rows in _markings(road)),
    ]
    wide, high = road.kerb_m
    for side, present in zip((-1, 1), road.kerb, strict=True):
        if not present:
            continue
        top, face = _strip(side * w, side * (w + wide), (high, high)), (0, high)
        strips.append(("kerb_top", CURVE, top))
        strips.append(("kerb_face", CURVE, _strip(side * w, side * w, face)))
    names, labels, rows = zip(*strips, strict=True)
    counts = [1, *map(len, rows), 1]
    z, x = road.manhole[0], road.x(*road.manhole)
    angles = [2 * math.pi * corner / MAX_CORNERS for corner in range(MAX_CORNERS)]
    circle = [(x + 0.36 * math.cos(angle), z + 0.36 * math.sin(angle)) for angle in angles]
    terrain = floats([[(x, 0, z) for x, z in TERRAIN]])
    manhole = floats([[(x, 0, z) for x, z in circle]])
    return (
        np.concatenate([terrain, _corners(road, np.concatenate(rows)), manhole]),
        np.repeat([INDEX[name] for name in ("grass", *names, "manhole")], counts),
        np.repeat([UNLABELED, *labels, UNLABELED], counts),
    )


def _rows(
    start: Numbers, end: Numbers, left: Numbers, right: Numbers, y: tuple[float, float] = (0, 0)
) -> Floats:
    """Make rows of quads: Z of both ends, lateral position of both sides, height of both sides."""
    columns = (start, end, left, right, *y)
    rows = np.empty((max(map(np.size, columns)), 6), np.float32)
    for number, column in enumerate(columns):
        rows[:, number] = column
    return rows


def _strip(left: float, right: float, y: tuple[float, float] = (0, 0)) -> Floats:
    """Make a strip along the whole road."""
    return _rows(_STEPS[:-1], _STEPS[1:], left, right, y)


def _corners(road: Road, rows: Floats) -> Floats:
    """Return corners (n, 8, 3) of quads given as rows, bent along the road."""
    corners = np.empty((len(rows), MAX_CORNERS, 3), np.float32)
    ends, sides, heights = rows[:, [0, 1, 1, 0]], rows[:, [2, 2, 3, 3]], rows[:, [4, 4, 5, 5]]
    corners[:, :4, 0] = sides + road.centre + 0.5 * road.curvature * ends * ends
    corners[:, :4, 1] = heights
    corners[:, :4, 2] = ends
    corners[:, 4:] = corners[:, 3:4]
    return corners


def _markings(road: Road) -> list[Floats]:
    """Make dashes along the middle; in some streets edge lines, a crossing with a stop line."""
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
