"""Place the labelled objects: near groups, small far objects, guardrails and bumps."""

from __future__ import annotations

import math
from bisect import bisect

from rgbt.data.synth import cars, furniture, groups
from rgbt.data.synth.factors import SceneFactors
from rgbt.data.synth.placement import GROUND, NO_SHADOW, Placed, Row, draw_rows
from rgbt.data.synth.road import Road
from rgbt.randomness import numpy_generator

_MAX_GROUP = 5
_GOLDEN = 0.6180339887

_KINDS = tuple(groups.GROUPS)
_NEAR_SHARES = {"demo": (0.22, 0.45, 0.73, 0.87, 1.0), "mfnet": (0.30, 0.54, 0.78, 0.90, 1.0)}
_FAR_SHARES = {"demo": (0.34, 0.72, 0.82, 0.88, 1.0), "mfnet": (0.15, 0.62, 0.80, 0.90, 1.0)}
"""Object mix -> cumulative shares of the kinds."""

_FAR_Z = (26.0, 90.0)
_CARS = frozenset(cars.car(kind) for kind in range(cars.NUM_CARS))


def place_objects(seed: int, index: int, road: Road, factors: SceneFactors) -> list[Placed]:
    """All labelled objects of a scene except kerbs.

    `factors` say how many near groups and far objects; the first of each are always the same.
    """
    u = numpy_generator(seed, "synth/structures", index).random(8).tolist()
    near = draw_rows(seed, index, "near", factors.num_objects * _MAX_GROUP)
    placed = _structures(road, u, factors)
    for number in range(factors.num_objects):
        # Low-discrepancy in number: distances are spread however many groups there are.
        share = (u[7] + number * _GOLDEN) % 1.0
        rows = near[number * _MAX_GROUP : (number + 1) * _MAX_GROUP]
        # The first row chooses kind and side.
        nearest, farthest, place = groups.GROUPS[
            _KINDS[bisect(_NEAR_SHARES[factors.object_mix], rows[0][0])]
        ]
        z = nearest * (farthest / nearest) ** share
        placed += place(road, rows, z, -1 if rows[0][1] < 0.5 else 1)
    far = draw_rows(seed, index, "far", factors.num_far_objects)
    return _without_collisions(placed + [_far_object(road, row, factors) for row in far])


def _without_collisions(placed: list[Placed]) -> list[Placed]:
    """Remove objects that overlap a car; of two objects the earlier one stays."""
    kept: list[Placed] = []
    taken: list[tuple[float, float, float, float, bool]] = []
    for thing in placed:
        if thing.layer == GROUND:
            kept.append(thing)
            continue
        x, z, is_car = thing.x, thing.z, thing.shape in _CARS
        across, along = thing.shape.half_width, thing.shape.half_length
        if all(
            abs(x - other[0]) >= across + other[2] or abs(z - other[1]) >= along + other[3]
            for other in taken
            if is_car or other[4]
        ):
            kept.append(thing)
            taken.append((x, z, across, along, is_car))
    return kept


def _far_object(road: Road, row: Row, factors: SceneFactors) -> Placed:
    """One small object around the vanishing point."""
    thing = _far_thing(road, row, _KINDS[bisect(_FAR_SHARES[factors.object_mix], row[0])])
    across, up, along = (factors.far_object_scale * each for each in thing.scale)
    return thing._replace(scale=(across, up, along))


def _far_thing(road: Road, row: Row, kind: str) -> Placed:
    z = _FAR_Z[0] * (_FAR_Z[1] / _FAR_Z[0]) ** row[1]
    lateral = (2 * row[2] - 1) * (road.half_width + 1.5)
    if kind == "car":
        moving = row[3] < 0.6
        lane = math.copysign(road.half_width * (0.45 if moving else 0.8), lateral)
        return groups.car(road, row, (z, lane), parked=not moving)
    if kind == "person":
        return groups.person(road, row, (z, lateral))
    if kind == "bike":
        return groups.bike(road, row, (z, lateral), yaw=3.0 * row[6], ridden=row[3] < 0.6)
    if kind == "cone":
        return groups.cone(road, (z, lateral), 1.0)
    return groups.car_stop(road, row, (z, lateral), int(row[5] * furniture.NUM_STOPS))


def _structures(road: Road, u: list[float], factors: SceneFactors) -> list[Placed]:
    """Guardrails along one side and a bump across the road, each in a share of the scenes."""
    placed = []
    if u[0] < factors.rail_share:
        lateral = (-1 if u[1] < 0.5 else 1) * (road.half_width + 0.45)
        for number in range(4 + int(u[3] * 7)):
            z = 3.5 + 7 * u[2] + furniture.RAIL_STEP_M * number
            placed.append(Placed(furniture.guardrail(), road.x(z, lateral), z, yaw=road.heading(z)))
    if u[4] < factors.bump_share:
        depth = factors.bump_farthest_m - factors.bump_nearest_m
        both_lanes, z = u[6] < 0.6, factors.bump_nearest_m + depth * u[5] ** 1.3
        width = 2 * road.half_width - 0.3 if both_lanes else road.half_width - 0.2
        bump = Placed(
            furniture.bump(),
            road.x(z, 0.0 if both_lanes else -road.half_width / 2),
            z,
            yaw=road.heading(z),
            scale=(width, 1.0, 1.0),
            layer=GROUND,
            shadow_from=NO_SHADOW,
        )
        placed.append(bump)
    return placed
