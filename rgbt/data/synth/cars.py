"""Shapes of four kinds of cars, made from a side profile."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from rgbt.data.synth.shapes import (
    CAR,
    Face,
    Shape,
    disc,
    flat,
    rectangle,
    shape_of,
    sideways,
    thin,
    upright,
)


class _Body(NamedTuple):
    """Side profile of a car; z runs from the tail (negative) to the front."""

    length: float
    width: float
    belt: float
    roof: float
    hood_z: float
    trunk_z: float
    roof_z: tuple[float, float]


_BODIES = (
    _Body(4.5, 1.75, 0.92, 1.45, 0.95, -1.50, (-1.0, 0.25)),  # saloon
    _Body(3.9, 1.70, 0.95, 1.53, 1.00, -1.80, (-1.55, 0.30)),  # hatchback
    _Body(4.3, 1.70, 1.00, 1.90, 1.75, -2.05, (-1.95, 1.15)),  # van
    _Body(3.4, 1.48, 1.00, 1.75, 1.15, -1.62, (-1.50, 0.60)),  # small city car
)
NUM_CARS = len(_BODIES)


@cache
def car(kind: int) -> Shape:
    """A car heading along +z: underside, body, cabin, windows, lights, plate, wheels."""
    body = _BODIES[kind]
    half = body.width / 2
    parts = [*_underside(body, half), *_shell(body, half), *_cabin(body, half - 0.13)]
    parts += [*_ends(body, half), *_wheels(body, half)]
    return shape_of(parts)


def _underside(body: _Body, half: float) -> list[Face]:
    tail, front = -body.length / 2 + 0.1, body.length / 2 - 0.1
    sill = rectangle(tail, 0.10, front, 0.36)
    ends = rectangle(-half + 0.06, 0.12, half - 0.06, 0.36)
    return [
        Face(sideways(sill, -half + 0.03), "underside", CAR),
        Face(sideways(sill, half - 0.03), "underside", CAR),
        Face(upright(ends, tail), "underside", CAR),
        Face(upright(ends, front), "underside", CAR),
    ]


def _shell(body: _Body, half: float) -> list[Face]:
    tail, front, belt = -body.length / 2, body.length / 2, body.belt
    side = [(tail + 0.06, 0.30), (front - 0.06, 0.30), (front, 0.52), (front - 0.08, 0.74)]
    side += [(body.hood_z, belt), (body.trunk_z, belt), (tail + 0.05, belt - 0.05), (tail, 0.52)]
    hood = [(-half, 0.74, front - 0.08), (half, 0.74, front - 0.08)]
    hood += [(half, belt, body.hood_z), (-half, belt, body.hood_z)]
    trunk = [(-half, belt - 0.05, tail + 0.05), (half, belt - 0.05, tail + 0.05)]
    trunk += [(half, belt, body.trunk_z), (-half, belt, body.trunk_z)]
    nose = [
        (-half, 0.30, front),
        (half, 0.30, front),
        (half, 0.74, front - 0.08),
        (-half, 0.74, front - 0.08),
    ]
    rear = [(-half, 0.30, tail), (half, 0.30, tail), (half, belt - 0.05, tail + 0.05)]
    rear += [(-half, belt - 0.05, tail + 0.05)]
    return [
        Face(sideways(side, -half), "paint", CAR, 1),
        Face(sideways(side, half), "paint", CAR, 1),
        thin(hood, "hood", CAR, 1),
        thin(trunk, "paint", CAR, 1),
        Face(nose, "hood", CAR, 1),
        Face(rear, "paint", CAR, 1),
    ]


def _cabin(body: _Body, half: float) -> list[Face]:
    belt, roof, (z0, z1) = body.belt, body.roof, body.roof_z
    front, back = body.hood_z, body.trunk_z
    side = [(back, belt), (front, belt), (z1, roof), (z0, roof)]
    middle = (z0 + z1) / 2
    glass_back = [
        (back + 0.22, belt + 0.04),
        (middle - 0.05, belt + 0.04),
        (middle - 0.05, roof - 0.08),
        (z0 + 0.1, roof - 0.08),
    ]
    glass_front = [
        (middle + 0.05, belt + 0.04),
        (front - 0.2, belt + 0.04),
        (z1 - 0.05, roof - 0.08),
        (middle + 0.05, roof - 0.08),
    ]
    parts = []
    for x in (-half, half):
        parts.append(Face(sideways(side, x), "paint", CAR, 1))
        outside = x * 1.01
        parts += [
            Face(sideways(glass, outside), "glass", CAR) for glass in (glass_back, glass_front)
        ]
    for low_z, high_z in ((back, z0), (front, z1)):
        frame = [
            (-half, belt, low_z),
            (half, belt, low_z),
            (half, roof, high_z),
            (-half, roof, high_z),
        ]
        parts.append(Face(frame, "paint", CAR, 1))
        parts.append(Face(_inset(frame, 0.10), "glass", CAR))
    parts.append(Face(flat(rectangle(-half, z0, half, z1), roof), "paint", CAR, 1))
    return parts


def _inset(
    corners: list[tuple[float, float, float]], share: float
) -> list[tuple[float, float, float]]:
    """Corners moved towards their mean by `share`, in the same plane."""
    mean = [sum(axis) / len(corners) for axis in zip(*corners, strict=True)]
    moved = [[c + share * (m - c) for c, m in zip(corner, mean, strict=True)] for corner in corners]
    return [(x, y, z) for x, y, z in moved]


def _ends(body: _Body, half: float) -> list[Face]:
    tail, front = -body.length / 2 - 0.01, body.length / 2 + 0.01
    bumper = rectangle(-half, 0.30, half, 0.42)
    plate = rectangle(-0.24, 0.46, 0.24, 0.58)
    parts = [
        Face(upright(bumper, tail), "trim", CAR),
        Face(upright(bumper, front), "trim", CAR),
        Face(upright(rectangle(-0.45, 0.44, 0.45, 0.62), front), "trim", CAR),
        Face(upright(plate, tail - 0.01), "plate", CAR),
        Face(upright(plate, front + 0.01), "plate", CAR),
    ]
    for side in (-1, 1):
        lamp = rectangle(side * (half - 0.32), 0.60, side * (half - 0.02), 0.76)
        parts.append(Face(upright(lamp, tail - 0.01), "tail_lamp", CAR))
        lamp = rectangle(side * (half - 0.36), 0.54, side * (half - 0.03), 0.70)
        parts.append(Face(upright(lamp, front + 0.01), "headlamp", CAR))
    return parts


def _wheels(body: _Body, half: float) -> list[Face]:
    parts = []
    for x in (-half - 0.01, half + 0.01):
        for z in (-body.length * 0.3, body.length * 0.32):
            parts.append(Face(sideways(disc(z, 0.31, 0.32), x), "tyre", CAR))
            parts.append(Face(sideways(disc(z, 0.31, 0.19), x * 1.01), "rim", CAR))
    return parts
