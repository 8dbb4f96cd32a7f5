"""Place what stands in a street: labelled objects, and the scenery, which has no label."""

from __future__ import annotations

import math
from bisect import bisect
from collections.abc import Callable
from functools import partial

from rgbt.randomness import numpy_generator
from rgbt.synth.factors import SceneFactors
from rgbt.synth.street import (
    BACKDROP,
    COLOUR,
    GROUND,
    HEAT,
    NO_SHADOW,
    STANDING,
    Paint,
    Placed,
    Road,
    Row,
    draw_rows,
    paints,
    shapes,
)

_GOLDEN = 0.6180339887
_MAX_GROUP = 5
_RAIL_STEP_M = 2.0
_CAR_PAINTS, _CLOTHES, _FACADES = map(paints, ("car", "clothes", "facade"))
_STOPS = ("stop_block", "stop_bollard", "stop_cube")

_NEAR_SHARES = {"demo": (0.22, 0.45, 0.73, 0.87, 1.0), "mfnet": (0.30, 0.54, 0.78, 0.90, 1.0)}
# Object mix -> cumulative shares of the kinds, in the order of `_GROUPS`.
_FAR_SHARES = {"demo": (0.34, 0.72, 0.82, 0.88, 1.0), "mfnet": (0.15, 0.62, 0.80, 0.90, 1.0)}

_FAR_Z = (26.0, 90.0)
# (Z, lateral position) in metres.
At = tuple[float, float]


def place_objects(seed: int, index: int, road: Road, factors: SceneFactors) -> list[Placed]:
    """Place all labelled objects of a scene but kerbs; with more of them, the first stay."""
    u = numpy_generator(seed, "synth/structures", index).random(8).tolist()
    near = draw_rows(seed, index, "near", factors.num_objects * _MAX_GROUP)
    placed = _structures(road, u, factors)
    for number in range(factors.num_objects):
        # Low-discrepancy in number: distances are spread however many groups there are.
        share = (u[7] + number * _GOLDEN) % 1.0
        rows = near[number * _MAX_GROUP : (number + 1) * _MAX_GROUP]
        # The first row chooses kind and side.
        nearest, farthest, place = _GROUPS[bisect(_NEAR_SHARES[factors.object_mix], rows[0][0])]
        z = nearest * (farthest / nearest) ** share
        placed += place(road, rows, z, -1 if rows[0][1] < 0.5 else 1)
    far = draw_rows(seed, index, "far", factors.num_far_objects)
    return _without_collisions(placed + [_far_object(road, row, factors) for row in far])


def _without_collisions(placed: list[Placed]) -> list[Placed]:
    """Remove objects that overlap a car; of two objects the earlier one stays."""
    kept = []
    taken: list[tuple[Placed, bool]] = []
    for thing in placed:
        is_car = thing.shape.name.startswith("car_")
        if thing.layer == GROUND:
            kept.append(thing)
        elif not any(_overlap(thing, other) for other, car in taken if is_car or car):
            kept.append(thing)
            taken.append((thing, is_car))
    return kept


def _overlap(one: Placed, other: Placed) -> bool:
    across = one.shape.half_width + other.shape.half_width
    along = one.shape.half_length + other.shape.half_length
    return abs(one.x - other.x) < across and abs(one.z - other.z) < along


def _far_object(road: Road, row: Row, factors: SceneFactors) -> Placed:
    """Place one small object around the vanishing point."""
    kind = bisect(_FAR_SHARES[factors.object_mix], row[0])
    z = _FAR_Z[0] * (_FAR_Z[1] / _FAR_Z[0]) ** row[1]
    lateral = (2 * row[2] - 1) * (road.half_width + 1.5)
    if kind == 0:
        moving = row[3] < 0.6
        lane = math.copysign(road.half_width * (0.45 if moving else 0.8), lateral)
        thing = _car(road, row, (z, lane), parked=not moving)
    elif kind == 1:
        thing = _person(road, row, (z, lateral))
    elif kind == 2:
        thing = _bike(road, row, (z, lateral), yaw=3.0 * row[6], ridden=row[3] < 0.6)
    elif kind == 3:
        thing = _stop(road, row, (z, lateral), int(row[5] * len(_STOPS)))
    else:
        thing = road.place("cone", z, lateral)
    across, up, along = thing.scale
    factor = factors.far_object_scale
    return thing._replace(scale=(factor * across, factor * up, factor * along))


def _structures(road: Road, u: list[float], factors: SceneFactors) -> list[Placed]:
    """Place guardrails along one side and a bump across the road, in a share of the scenes each."""
    placed = []
    if u[0] < factors.rail_share:
        lateral = (-1 if u[1] < 0.5 else 1) * (road.half_width + 0.45)
        for number in range(4 + int(u[3] * 7)):
            z = 3.5 + 7 * u[2] + _RAIL_STEP_M * number
            placed.append(road.place("guardrail", z, lateral, yaw=road.heading(z)))
    if u[4] < factors.bump_share:
        depth = factors.bump_farthest_m - factors.bump_nearest_m
        z, lateral = factors.bump_nearest_m + depth * u[5] ** 1.3, -road.half_width / 2
        size, yaw = (road.half_width - 0.2, 1.0, 1.0), road.heading(z)
        if u[6] < 0.6:  # both lanes
            size, lateral = (2 * road.half_width - 0.3, 1.0, 1.0), 0.0
        bump = road.place("bump", z, lateral, yaw=yaw, scale=size, layer=GROUND)
        placed.append(bump._replace(shadow_from=NO_SHADOW))
    return placed


def _paint(palette: list[Paint], u: float, shade: float) -> Paint:
    red, green, blue = palette[int(u * len(palette))]
    return min(red * shade, 1.0), min(green * shade, 1.0), min(blue * shade, 1.0)


def _car(road: Road, row: Row, at: At, parked: bool) -> Placed:
    """Place a car: parked ones are cold and dark, moving ones warm and lit."""
    away = at[1] < 0 if row[4] < 0.85 else at[1] >= 0
    paint = _paint(_CAR_PAINTS, row[COLOUR], 0.75 + 0.4 * row[COLOUR + 1])
    return road.place(
        f"car_{int(row[5] * 4)}",
        *at,
        yaw=road.heading(at[0]) + (0.0 if away else math.pi) + 0.12 * (row[6] - 0.5),
        paints=(paint, paint),
        warmth=0.15 * row[HEAT] if parked else 0.65 + 0.35 * row[HEAT],
        lit=float(not parked),
    )


def _person(road: Road, row: Row, at: At) -> Placed:
    """Place a person; one in eight is dressed so warmly that little of them shows in thermal."""
    size, wrapped = 0.90 + 0.16 * row[6], row[HEAT + 1] < 0.12
    return road.place(
        f"person_{int(row[5] * 6)}",
        *at,
        yaw=0.3 * (row[7] - 0.5),
        scale=(size * 1.08, size, size),
        paints=_outfit(row),
        warmth=-0.5 + 0.3 * row[HEAT] if wrapped else 0.3 + 0.7 * row[HEAT],
    )


def _outfit(row: Row) -> tuple[Paint, Paint]:
    top = _paint(_CLOTHES, row[COLOUR], 0.7 + 0.6 * row[COLOUR + 1])
    return top, _paint(_CLOTHES, row[COLOUR + 2], 0.6)


def _bike(road: Road, row: Row, at: At, yaw: float, ridden: bool) -> Placed:
    """Place a bike, with its rider where it is ridden."""
    frame = _paint(_CAR_PAINTS, row[COLOUR], 0.9)
    return road.place(
        "bike_ridden" if ridden else "bike_parked",
        *at,
        yaw=yaw,
        paints=_outfit(row) if ridden else (frame, frame),
        warmth=0.4 + 0.6 * row[HEAT] if ridden else 0.0,
    )


def _stop(road: Road, row: Row, at: At, kind: int) -> Placed:
    """Place a car stop, roughly along the road."""
    return road.place(_STOPS[kind], *at, yaw=road.heading(at[0]) + 0.2 * (row[4] - 0.5))


def _cars(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """Place a car: parked at the kerb or on the sidewalk, oncoming, or ahead in the own lane."""
    u = rows[0]
    parked = u[2] < 0.5
    lateral = side * (road.half_width - 1.0 if parked else road.half_width * 0.45)
    if parked and u[3] < 0.25:
        lateral = side * (road.half_width + 1.3)
    if side < 0 and not parked:
        z = max(z, 9.0)
    return [_car(road, u, (z, lateral), parked)]


def _persons(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """Place one to three persons on a sidewalk or crossing the road."""
    u = rows[0]
    lateral = side * (road.half_width + 0.5 + u[2] * (road.sidewalk_of(side) - 0.7))
    if u[3] < 0.3:
        lateral, z = (u[2] - 0.3) * 1.6 * road.half_width, max(z, 7.0)
    step = 0.62 if u[7] < 0.5 else -0.62
    return [
        _person(road, row, (z + 0.9 * (row[5] - 0.5), lateral + step * number))
        for number, row in enumerate(rows[: 1 + int(u[4] * 2.6)])
    ]


def _bikes(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """Place a rack of parked bikes, or one ridden along the edge of the road."""
    u = rows[0]
    if u[2] < 0.3:
        z = max(z, 6.0)
        yaw = road.heading(z) + (0 if side < 0 else math.pi) + 0.9 * (u[3] - 0.5)
        return [_bike(road, u, (z, side * (road.half_width - 0.6)), yaw, ridden=True)]
    lateral = side * (road.half_width + 0.95)
    yaw = (1.25 + 0.5 * (u[3] - 0.5)) * (1 if u[5] < 0.5 else -1)
    places = [(z + 0.65 * number, lateral + side * 0.1 * number) for number in range(_MAX_GROUP)]
    return [
        _bike(road, row, place, yaw + 0.15 * row[6], ridden=False)
        for place, row in zip(places, rows[: 2 + int(u[4] * 3)], strict=False)
    ]


def _stops(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """Place two to four car stops: blocks beside the lane, or bollards along the sidewalk."""
    u = rows[0]
    kind = int(u[2] * len(_STOPS))
    step, beside = ((2.4, -0.55), (1.7, 0.55), (1.9, -0.55))[kind]
    lateral = side * (road.half_width + beside)
    chosen = enumerate(rows[: 2 + int(u[3] * 3)])
    return [_stop(road, row, (z + step * number, lateral), kind) for number, row in chosen]


def _cones(road: Road, rows: list[Row], z: float, side: int) -> list[Placed]:
    """Place a row of three to five cones that slants into the road."""
    u = rows[0]
    start, slant = side * (road.half_width - 0.35), -side * (0.1 + 0.25 * u[3])
    step, size = 1.0 + 0.8 * u[2], (0.9 + 0.35 * u[4],) * 3
    places = [
        (z + step * number, start + slant * number + 0.15 * (row[5] - 0.5))
        for number, row in enumerate(rows[: 3 + int(u[6] * 3)])
    ]
    return [road.place("cone", *place, scale=size) for place in places]


# Nearest and farthest Z, and what places it given road, rows, Z and side (-1 left).
_GROUPS: tuple[tuple[float, float, Callable[[Road, list[Row], float, int], list[Placed]]], ...] = (
    (6.5, 26, _cars),
    (4.5, 18, _persons),
    (3.8, 13, _bikes),
    (3.6, 11, _stops),
    (3.6, 12, _cones),
)


_LAST_Z, _FAR_TREE_M = 85.0, 22.0


def place_scenery(seed: int, index: int, road: Road) -> list[Placed]:
    """Place everything unlabelled that stands in a scene."""
    rows = draw_rows(seed, index, "scenery", 120)
    placed = _horizon(rows[:12])
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
    """Place blocks and tree lines far away."""
    placed = []
    for number, u in enumerate(rows):
        x, z = (number + u[0] - 6) * 32, 190 + 60 * u[1]
        name, size = "tree_line", (4 + 4 * u[2], 7 + 9 * u[3], 1.0)
        if number % 2 == 0:
            name, size = "skyline", (12 + 26 * u[2], 9 + 34 * u[3] ** 2, 1.0)
        paints = _shaded((0.38, 0.40, 0.44), 0.8 + 0.4 * u[COLOUR])
        thing = Placed(shapes()[name], x, z, scale=size, paints=paints, layer=BACKDROP)
        placed.append(thing._replace(shadow_from=NO_SHADOW))
    return placed


def _plots(road: Road, rows: list[Row], side: int) -> list[Placed]:
    """Place plots along one side: a building each, or a wall or hedge with trees behind."""
    town = rows[0][1]
    edge = side * (road.half_width + road.sidewalk_of(side) + 0.4)
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


# Middle (Z), length, lateral position of the edge towards the road (signed).
Plot = tuple[float, float, float]


def _building(road: Road, row: Row, plot: Plot) -> list[Placed]:
    """Place a house, in some cases with a warm outlet on its wall."""
    z, length, edge = plot
    side = math.copysign(1.0, edge)
    depth, height = 9 + 6 * row[4], 4.5 + 13 * row[5] ** 1.5
    front = edge + side * (0.3 + 2.5 * row[6])
    paints = _shaded(_FACADES[int(row[COLOUR] * len(_FACADES))], 0.75 + 0.5 * row[COLOUR + 1])
    house = road.place("building", z, front + side * depth / 2, paints=paints, layer=BACKDROP)
    house = house._replace(scale=(depth, height, length), lit=row[COLOUR + 2])
    if row[HEAT] > 0.6:
        return [house]
    x, z, y = road.x(z, front) - side * 0.05, z - length * (row[7] - 0.5) * 0.8, 0.5 + 2.5 * row[6]
    vent = Placed(shapes()["vent"], x, z, y=y, shadow_from=NO_SHADOW, layer=BACKDROP)
    return [house, vent]


def _green(road: Road, row: Row, plot: Plot) -> list[Placed]:
    """Place a wall or a hedge along the plot with two trees behind."""
    z, length, edge = plot
    side = math.copysign(1.0, edge)
    lateral = edge + side * 0.4
    name, size = "hedge", (0.8, 0.7 + 0.9 * row[5], length)
    if row[4] < 0.4:
        name, size = "wall", (0.3, 1.1 + 0.9 * row[5], length)
    paints = _shaded((0.55, 0.53, 0.49), 0.6 + 0.5 * row[COLOUR])
    border = road.place(name, z, lateral, yaw=road.heading(z), scale=size, paints=paints)
    border = border._replace(layer=BACKDROP)
    behind = lateral + side * (2.2 + 2 * row[6])
    placed = [border]
    for number, u in enumerate(row[COLOUR + 1 : COLOUR + 3]):
        at = (z + length * (0.45 * number - 0.2), behind)
        placed.append(_tree(road, at, 1.0 + 0.7 * u, row[7 - number]))
    return placed


def _tree(road: Road, at: At, size: float, u: float, layer: int = BACKDROP) -> Placed:
    """Place a tree; far ones have no branches, and three blobs of leaves rather than six."""
    name = "tree" if at[0] < _FAR_TREE_M else "far_tree"
    scale = (size * 1.1, size, size)
    return road.place(f"{name}_{int(u * 5)}", *at, scale=scale, layer=layer, shadow_from=0.35)


def _street_trees(road: Road, rows: list[Row], side: int) -> list[Placed]:
    """Place trees on the sidewalk in about half of the streets."""
    u = rows[0]
    if u[0] > 0.5:
        return []
    lateral = side * (road.half_width + road.sidewalk_of(side) * 0.75)
    first, step = 7 + 9 * u[1], 8 + 7 * u[2]
    return [
        _tree(road, (first + step * number, lateral), 0.8 + 0.35 * row[0], row[1], STANDING)
        for number, row in enumerate(rows[1:8])
    ]


def _signs(road: Road, rows: list[Row], side: int) -> list[Placed]:
    """Place up to two traffic signs, and in some streets a vending machine, on the sidewalk."""
    at = side * (road.half_width + 0.4)
    placed = [
        road.place(f"sign_{int(u[2] * 3)}", 7 + 24 * u[1], at, shadow_from=NO_SHADOW)
        for u in rows[:2]
        if u[0] < 0.4
    ]
    u = rows[2]
    if u[0] < 0.3:
        lateral = side * (road.half_width + road.sidewalk_of(side) + 0.1)
        placed.append(road.place("vending_machine", 7 + 16 * u[1], lateral, lit=1.0))
    return placed


def _poles(road: Road, u: Row) -> list[Placed]:
    """Place street lamps on one side; in most streets, utility poles with cables on the other."""
    side = 1 if u[0] < 0.5 else -1
    lateral = side * (road.half_width + 0.45)
    yaw = 0.0 if side < 0 else math.pi
    lamp = partial(road.place, "street_lamp", yaw=yaw, lit=1.0, shadow_from=NO_SHADOW)
    placed = [lamp(5 + 12 * u[2] + (17 + 8 * u[1]) * number, lateral) for number in range(5)]
    if u[3] >= 0.6:
        return placed
    lateral, first, step = -side * (road.half_width + 0.6), 8 + 10 * u[4], 20 + 8 * u[5]
    for number in range(-1, 3):
        z = first + step * number
        x = road.x(z, lateral)
        if number >= 0:
            placed.append(road.place("utility_pole", z, lateral, shadow_from=NO_SHADOW))
        turn = math.atan2(road.x(z + step, lateral) - x, step)
        size = (1.0, 1.0, step / math.cos(turn))
        wire = Placed(shapes()["wire"], x, z, turn, size, shadow_from=NO_SHADOW)
        offsets = ((-0.8, 8.3), (0.8, 8.3), (0.3, 7.3))
        placed += [wire._replace(x=x + offset, y=y) for offset, y in offsets]
    return placed
