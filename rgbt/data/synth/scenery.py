"""Place the unlabelled objects: buildings, walls, trees, lamps, poles, signs, horizon."""

from __future__ import annotations

import math

from rgbt.data.synth import backdrop
from rgbt.data.synth.placement import (
    BACKDROP,
    COLOUR,
    HEAT,
    NO_SHADOW,
    STANDING,
    Paint,
    Placed,
    Row,
    draw_rows,
)
from rgbt.data.synth.road import Road

_ROWS = 120
_LAST_Z = 85.0
_FAR_TREE_M = 22.0

_FACADES: tuple[Paint, ...] = (
    (0.56, 0.53, 0.48),
    (0.62, 0.60, 0.58),
    (0.44, 0.30, 0.24),
    (0.38, 0.38, 0.40),
    (0.66, 0.60, 0.48),
    (0.30, 0.34, 0.38),
    (0.50, 0.44, 0.38),
)


def place_scenery(seed: int, index: int, road: Road) -> list[Placed]:
    """Everything unlabelled that stands in a scene."""
    rows = draw_rows(seed, index, "scenery", _ROWS)
    placed = _horizon(rows[:20])
    for side, own in ((-1, rows[20:60]), (1, rows[60:100])):
        placed += _plots(road, own[:20], side)
        placed += _street_trees(road, own[20:30], side)
        placed += _signs(road, own[30:33], side)
    return placed + _poles(road, rows[100])


def _shaded(paint: Paint, shade: float) -> tuple[Paint, Paint]:
    red, green, blue = paint
    shaded = (red * shade, green * shade, blue * shade)
    return shaded, shaded


def _horizon(rows: list[Row]) -> list[Placed]:
    """Blocks and tree lines far away."""
    placed = []
    for number, u in enumerate(rows[:12]):
        x, z = (number + u[0] - 6) * 32, 190 + 60 * u[1]
        block = number % 2 == 0
        size = (
            (12 + 26 * u[2], 9 + 34 * u[3] ** 2, 1.0)
            if block
            else (4 + 4 * u[2], 7 + 9 * u[3], 1.0)
        )
        shape = backdrop.skyline() if block else backdrop.far_trees()
        paints = _shaded((0.38, 0.40, 0.44), 0.8 + 0.4 * u[COLOUR])
        placed.append(
            Placed(shape, x, z, scale=size, paints=paints, layer=BACKDROP, shadow_from=NO_SHADOW)
        )
    return placed


def _plots(road: Road, rows: list[Row], side: int) -> list[Placed]:
    """Plots along one side: each a building, or a wall or hedge with trees behind."""
    town = rows[0][1]
    edge = side * (road.half_width + road.sidewalk[0 if side < 0 else 1] + 0.4)
    placed: list[Placed] = []
    z = -4.0 + 6 * rows[0][0]
    for row in rows[1:]:
        length = 8 + 12 * row[0]
        built = row[1] < 0.25 + 0.6 * town
        placed += (_building if built else _green)(road, row, (z + length / 2, length, edge))
        z += length + 3 * row[2] + (4 * row[3] if built else 0)
        if z > _LAST_Z:
            break
    return placed


Plot = tuple[float, float, float]
"""Middle (Z), length along the road, lateral position of the edge towards the road (signed)."""


def _building(road: Road, row: Row, plot: Plot) -> list[Placed]:
    """A house, in some cases with a warm outlet on its wall."""
    z, length, edge = plot
    side = math.copysign(1.0, edge)
    depth, height = 9 + 6 * row[4], 4.5 + 13 * row[5] ** 1.5
    front = edge + side * (0.3 + 2.5 * row[6])
    house = Placed(
        backdrop.building(),
        road.x(z, front + side * depth / 2),
        z,
        scale=(depth, height, length),
        paints=_shaded(_FACADES[int(row[COLOUR] * len(_FACADES))], 0.75 + 0.5 * row[COLOUR + 1]),
        lit=row[COLOUR + 2],
        layer=BACKDROP,
    )
    if row[HEAT] > 0.6:
        return [house]
    outlet = Placed(
        backdrop.vent(),
        road.x(z, front) - side * 0.05,
        z - length * (row[7] - 0.5) * 0.8,
        y=0.5 + 2.5 * row[6],
        shadow_from=NO_SHADOW,
        layer=BACKDROP,
    )
    return [house, outlet]


def _green(road: Road, row: Row, plot: Plot) -> list[Placed]:
    """A wall or a hedge along the plot with two trees behind."""
    z, length, edge = plot
    side = math.copysign(1.0, edge)
    lateral = edge + side * 0.4
    low = row[4] < 0.4
    border = Placed(
        backdrop.wall() if low else backdrop.hedge(),
        road.x(z, lateral),
        z,
        yaw=road.heading(z),
        scale=(0.3, 1.1 + 0.9 * row[5], length) if low else (0.8, 0.7 + 0.9 * row[5], length),
        paints=_shaded((0.55, 0.53, 0.49), 0.6 + 0.5 * row[COLOUR]),
        layer=BACKDROP,
    )
    behind = lateral + side * (2.2 + 2 * row[6])
    sizes = (1.0 + 0.7 * row[COLOUR + 1], 1.0 + 0.7 * row[COLOUR + 2])
    trees = [
        _tree(road, (z + length * (0.45 * number - 0.2), behind), size, row[7 - number])
        for number, size in enumerate(sizes)
    ]
    return [border, *trees]


def _tree(
    road: Road, at: tuple[float, float], size: float, u: float, layer: int = BACKDROP
) -> Placed:
    z, lateral = at
    return Placed(
        backdrop.tree(int(u * backdrop.NUM_TREES), near=z < _FAR_TREE_M),
        road.x(z, lateral),
        z,
        scale=(size * 1.1, size, size),
        layer=layer,
        shadow_from=0.35,
    )


def _street_trees(road: Road, rows: list[Row], side: int) -> list[Placed]:
    """Trees on the sidewalk in about half of the streets."""
    u = rows[0]
    if u[0] > 0.5:
        return []
    lateral = side * (road.half_width + road.sidewalk[0 if side < 0 else 1] * 0.75)
    first, step = 7 + 9 * u[1], 8 + 7 * u[2]
    return [
        _tree(road, (first + step * number, lateral), 0.8 + 0.35 * row[0], row[1], STANDING)
        for number, row in enumerate(rows[1:8])
    ]


def _signs(road: Road, rows: list[Row], side: int) -> list[Placed]:
    """Up to two traffic signs, and in some streets a vending machine, on the sidewalk."""
    placed = []
    for u in rows[:2]:
        if u[0] < 0.4:
            z = 7 + 24 * u[1]
            shape = backdrop.sign(int(u[2] * backdrop.NUM_SIGNS))
            placed.append(
                Placed(shape, road.x(z, side * (road.half_width + 0.4)), z, shadow_from=NO_SHADOW)
            )
    u = rows[2]
    if u[0] < 0.3:
        z = 7 + 16 * u[1]
        lateral = side * (road.half_width + road.sidewalk[0 if side < 0 else 1] + 0.1)
        placed.append(Placed(backdrop.vending_machine(), road.x(z, lateral), z, lit=1.0))
    return placed


def _poles(road: Road, u: Row) -> list[Placed]:
    """Street lamps on one side; utility poles with cables on the other, in most streets."""
    side = 1 if u[0] < 0.5 else -1
    lateral = side * (road.half_width + 0.45)
    placed = []
    for number in range(5):
        z = 5 + 12 * u[2] + (17 + 8 * u[1]) * number
        yaw = 0.0 if side < 0 else math.pi
        lamp = backdrop.street_lamp()
        placed.append(Placed(lamp, road.x(z, lateral), z, yaw=yaw, lit=1.0, shadow_from=NO_SHADOW))
    if u[3] < 0.6:
        placed += _cables(road, -side * (road.half_width + 0.6), 8 + 10 * u[4], 20 + 8 * u[5])
    return placed


def _cables(road: Road, lateral: float, first: float, step: float) -> list[Placed]:
    placed = []
    for number in range(-1, 3):
        z = first + step * number
        x = road.x(z, lateral)
        if number >= 0:
            placed.append(Placed(backdrop.utility_pole(), x, z, shadow_from=NO_SHADOW))
        turn = math.atan2(road.x(z + step, lateral) - x, step)
        size = (1.0, 1.0, step / math.cos(turn))
        for offset, y in ((-0.8, 8.3), (0.8, 8.3), (0.3, 7.3)):
            cable = Placed(
                backdrop.wire(), x + offset, z, yaw=turn, scale=size, shadow_from=NO_SHADOW, y=y
            )
            placed.append(cable)
    return placed
