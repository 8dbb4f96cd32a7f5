"""Place near groups and single objects of each class in a street."""

from __future__ import annotations

import math
from collections.abc import Callable

from rgbt.data.synth import cars, furniture, people
from rgbt.data.synth.placement import COLOUR, HEAT, Paint, Placed, Row
from rgbt.data.synth.road import Road

_CAR_PAINTS = (
    (0.78, 0.78, 0.78),
    (0.62, 0.63, 0.65),
    (0.05, 0.05, 0.06),
    (0.25, 0.26, 0.28),
    (0.04, 0.09, 0.28),
    (0.48, 0.04, 0.04),
    (0.80, 0.79, 0.74),
    (0.10, 0.22, 0.16),
)
_CLOTHES = (
    (0.06, 0.06, 0.07),
    (0.10, 0.12, 0.20),
    (0.45, 0.08, 0.08),
    (0.55, 0.54, 0.50),
    (0.14, 0.24, 0.40),
    (0.30, 0.28, 0.22),
    (0.70, 0.68, 0.66),
    (0.10, 0.22, 0.14),
)

At = tuple[float, float]
"""(Z, lateral position) in metres."""


def _paint(palette: tuple[Paint, ...], u: float, shade: float) -> Paint:
    red, green, blue = palette[int(u * len(palette))]
    return min(red * shade, 1.0), min(green * shade, 1.0), min(blue * shade, 1.0)


def car(road: Road, row: Row, at: At, parked: bool) -> Placed:
    """A car: parked ones are cold and dark, moving ones warm and lit."""
    z, lateral = at
    away = lateral < 0 if row[4] < 0.85 else lateral >= 0
    paint = _paint(_CAR_PAINTS, row[COLOUR], 0.75 + 0.4 * row[COLOUR + 1])
    return Placed(
        cars.car(int(row[5] * cars.NUM_CARS)),
        road.x(z, lateral),
        z,
        yaw=road.heading(z) + (0.0 if away else math.pi) + 0.12 * (row[6] - 0.5),
        paints=(paint, paint),
        warmth=0.15 * row[HEAT] if parked else 0.65 + 0.35 * row[HEAT],
        lit=float(not parked),
    )


def person(road: Road, row: Row, at: At) -> Placed:
    """A person; one in eight is dressed so warmly that little of them shows in thermal."""
    z, lateral = at
    size = 0.90 + 0.16 * row[6]
    wrapped = row[HEAT + 1] < 0.12
    return Placed(
        people.person(int(row[5] * people.NUM_WALKERS)),
        road.x(z, lateral),
        z,
        yaw=0.3 * (row[7] - 0.5),
        scale=(size * 1.08, size, size),
        paints=_outfit(row),
        warmth=-0.5 + 0.3 * row[HEAT] if wrapped else 0.3 + 0.7 * row[HEAT],
    )


def _outfit(row: Row) -> tuple[Paint, Paint]:
    top = _paint(_CLOTHES, row[COLOUR], 0.7 + 0.6 * row[COLOUR + 1])
    return top, _paint(_CLOTHES, row[COLOUR + 2], 0.6)


def bike(road: Road, row: Row, at: At, yaw: float, ridden: bool) -> Placed:
    """A bike, with its rider where it is ridden."""
    z, lateral = at
    frame = _paint(_CAR_PAINTS, row[COLOUR], 0.9)
    return Placed(
        people.bike(ridden),
        road.x(z, lateral),
        z,
        yaw=yaw,
        paints=_outfit(row) if ridden else (frame, frame),
        warmth=0.4 + 0.6 * row[HEAT] if ridden else 0.0,
    )


def car_stop(road: Road, row: Row, at: At, kind: int) -> Placed:
    """A car stop, roughly along the road."""
    z, lateral = at
    yaw = road.heading(z) + 0.2 * (row[4] - 0.5)
    return Placed(furniture.car_stop(kind), road.x(z, lateral), z, yaw=yaw)


def cone(road: Road, at: At, size: float) -> Placed:
    """A cone."""
    z, lateral = at
    return Placed(furniture.cone(), road.x(z, lateral), z, scale=(size, size, size))


def _cars(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """One car: parked at the kerb or on the sidewalk, oncoming, or ahead in the own lane."""
    u = rows[0]
    parked = u[2] < 0.5
    lateral = side * (road.half_width - 1.0 if parked else road.half_width * 0.45)
    if parked and u[3] < 0.25:
        lateral = side * (road.half_width + 1.3)
    if side < 0 and not parked:
        z = max(z, 9.0)
    return [car(road, u, (z, lateral), parked)]


def _persons(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """One to three persons on a sidewalk or crossing the road."""
    u = rows[0]
    width = road.sidewalk[0 if side < 0 else 1]
    lateral = side * (road.half_width + 0.5 + u[2] * (width - 0.7))
    if u[3] < 0.3:
        lateral, z = (u[2] - 0.3) * 1.6 * road.half_width, max(z, 7.0)
    step = 0.62 if u[7] < 0.5 else -0.62
    num = 1 + int(u[4] * 2.6)
    return [
        person(road, row, (z + 0.9 * (row[5] - 0.5), lateral + step * number))
        for number, row in enumerate(rows[:num])
    ]


def _bikes(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """A rack of parked bikes, or one ridden along the edge of the road."""
    u = rows[0]
    if u[2] < 0.3:
        z = max(z, 6.0)
        yaw = road.heading(z) + (0 if side < 0 else math.pi) + 0.9 * (u[3] - 0.5)
        return [bike(road, u, (z, side * (road.half_width - 0.6)), yaw, ridden=True)]
    lateral = side * (road.half_width + 0.95)
    yaw = (1.25 + 0.5 * (u[3] - 0.5)) * (1 if u[5] < 0.5 else -1)
    num = 2 + int(u[4] * 3)
    return [
        bike(
            road,
            row,
            (z + 0.65 * number, lateral + side * 0.1 * number),
            yaw + 0.15 * row[6],
            ridden=False,
        )
        for number, row in enumerate(rows[:num])
    ]


def _stops(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """A row of two to four car stops: blocks beside the lane, or bollards along the sidewalk."""
    u = rows[0]
    kind = int(u[2] * furniture.NUM_STOPS)
    lateral = side * (
        road.half_width + 0.55 if kind == furniture.BOLLARD else road.half_width - 0.55
    )
    step = (2.4, 1.7, 1.9)[kind]
    num = 2 + int(u[3] * 3)
    return [car_stop(road, row, (z + step * k, lateral), kind) for k, row in enumerate(rows[:num])]


def _cones(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """A row of three to five cones that slants into the road."""
    u = rows[0]
    start, slant = side * (road.half_width - 0.35), -side * (0.1 + 0.25 * u[3])
    step, size, num = 1.0 + 0.8 * u[2], 0.9 + 0.35 * u[4], 3 + int(u[6] * 3)
    return [
        cone(road, (z + step * k, start + slant * k + 0.15 * (row[5] - 0.5)), size)
        for k, row in enumerate(rows[:num])
    ]


GROUPS: dict[str, tuple[float, float, Callable[[Road, list[Row], float, int], list[Placed]]]] = {
    "car": (6.5, 26, _cars),
    "person": (4.5, 18, _persons),
    "bike": (3.8, 13, _bikes),
    "stop": (3.6, 11, _stops),
    "cone": (3.6, 12, _cones),
}
"""Kind -> nearest and farthest Z, and what places it given road, rows, Z and side (-1 left)."""
