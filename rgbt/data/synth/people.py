"""Shapes of persons and bikes, with or without a rider."""

from __future__ import annotations

from functools import cache

from rgbt.data.synth.shapes import (
    BIKE,
    PERSON,
    Face,
    Shape,
    disc,
    rectangle,
    shape_of,
    sideways,
    thin,
    tube,
    upright,
)

NUM_WALKERS = 6


@cache
def person(kind: int) -> Shape:
    """A standing or walking person of 1.72 m, facing +z or the camera, some with a bag."""
    stride = (0.02, 0.16, 0.24)[kind % 3]
    from_behind = kind >= NUM_WALKERS // 2
    parts = [*_leg(-0.08, -0.06 - stride), *_leg(0.08, 0.06 + stride)]
    parts += [*_arm(-1, stride), *_arm(1, stride)]
    # Two halves that meet in an edge towards the camera, so that the sun shades one of them.
    for side in (-1, 1):
        torso = [(0.0, 0.84, -0.12), (side * 0.18, 0.84, 0.0), (side * 0.24, 1.36, 0.0)]
        torso += [(side * 0.15, 1.46, 0.0), (0.0, 1.46, -0.12)]
        parts.append(thin(torso, "cloth", PERSON, 1))
    cap = [(-0.125, 1.61), (0.125, 1.61), (0.09, 1.70), (0.0, 1.735), (-0.09, 1.70)]
    parts += [
        thin(upright(rectangle(-0.05, 1.42, 0.05, 1.52)), "skin", PERSON),
        thin(upright(disc(0.0, 1.60, 0.125)), "hair" if from_behind else "skin", PERSON),
        thin(upright(cap, -0.01), "hair", PERSON),
    ]
    if kind in (1, 5):
        parts.append(thin(upright(rectangle(-0.17, 0.98, 0.17, 1.40), -0.16), "bag", PERSON))
    return shape_of(parts)


def _leg(hip_x: float, foot_x: float) -> list[Face]:
    leg = [(hip_x - 0.09, 0.90), (hip_x + 0.09, 0.90), (foot_x + 0.06, 0.07), (foot_x - 0.06, 0.07)]
    shoe = rectangle(foot_x - 0.07, 0.0, foot_x + 0.08, 0.09)
    return [
        thin(upright(leg), "trousers", PERSON, 2),
        thin(upright(shoe), "shoe", PERSON),
    ]


def _arm(side: int, stride: float) -> list[Face]:
    hand = (side * (0.27 + stride * 0.4), 0.86)
    return [
        thin(upright(tube((side * 0.22, 1.40), hand, 0.11)), "cloth", PERSON, 1),
        thin(upright(disc(*hand, 0.055, 6)), "skin", PERSON),
    ]


@cache
def bike(ridden: bool) -> Shape:
    """A bicycle along z: two wheels, frame, basket, saddle, handlebar; ridden ones carry a person.

    Wheels are filled with spokes rather than open, as they are in MFNet's hand-drawn labels.
    """
    parts = [*_bike_wheels(), *_bike_frame()]
    if ridden:
        parts += _rider()
    return shape_of(parts)


def _bike_wheels() -> list[Face]:
    parts = []
    for z in (-0.53, 0.53):
        edge = rectangle(-0.035, 0.0, 0.035, 0.68)
        parts.append(thin(sideways(disc(z, 0.34, 0.34)), "tyre", BIKE))
        parts.append(thin(sideways(disc(z, 0.34, 0.27)), "spokes", BIKE))
        parts.append(thin(upright(edge, z), "tyre", BIKE))
    return parts


def _bike_frame() -> list[Face]:
    crank, seat, head = (-0.08, 0.30), (-0.22, 0.86), (0.36, 0.82)
    tubes = [
        (crank, seat),
        (crank, head),
        (seat, head),
        (head, (0.53, 0.34)),
        (crank, (-0.53, 0.34)),
    ]
    parts = [thin(sideways(tube(a, b, 0.075)), "metal", BIKE, 1) for a, b in tubes]
    parts.append(thin(sideways(tube((-0.53, 0.34), seat, 0.06)), "metal", BIKE, 1))
    parts.append(thin(upright(rectangle(-0.05, 0.3, 0.05, 0.95), -0.2), "metal", BIKE, 1))
    parts.append(thin(upright(rectangle(-0.28, 0.98, 0.28, 1.05), 0.38), "trim", BIKE))
    parts.append(thin(sideways(tube((0.30, 1.02), head, 0.07)), "trim", BIKE))
    parts.append(thin(sideways(rectangle(-0.36, 0.86, -0.1, 0.94)), "saddle", BIKE))
    parts.append(thin(upright(rectangle(-0.1, 0.86, 0.1, 0.94), -0.36), "saddle", BIKE))
    parts.append(thin(sideways(rectangle(0.42, 0.72, 0.76, 0.98)), "spokes", BIKE))
    parts.append(thin(upright(rectangle(-0.17, 0.72, 0.17, 0.98), 0.76), "spokes", BIKE))
    return parts


def _rider() -> list[Face]:
    """Seen from the side (plane along z) and from behind (plane across)."""
    from_side = [
        (tube((-0.2, 0.95), (0.12, 0.70), 0.16), "trousers", 2),
        (tube((0.12, 0.72), (-0.02, 0.22), 0.12), "trousers", 2),
        ([(-0.32, 0.92), (-0.10, 0.90), (0.16, 1.40), (-0.04, 1.46)], "cloth", 1),
        (tube((0.10, 1.34), (0.38, 1.04), 0.09), "cloth", 1),
        (disc(0.14, 1.58, 0.12), "skin", 0),
        ([(0.01, 1.60), (0.25, 1.64), (0.2, 1.71), (0.08, 1.72)], "hair", 0),
    ]
    across = [
        (rectangle(-0.16, 0.25, -0.05, 0.95), "trousers", 2),
        (rectangle(0.05, 0.25, 0.16, 0.95), "trousers", 2),
        (
            [(-0.17, 0.9), (0.17, 0.9), (0.25, 1.38), (0.14, 1.46), (-0.14, 1.46), (-0.25, 1.38)],
            "cloth",
            1,
        ),
        (disc(0.0, 1.59, 0.12), "hair", 0),
    ]
    parts = [thin(sideways(line), name, PERSON, paint) for line, name, paint in from_side]
    return parts + [thin(upright(line), name, PERSON, paint) for line, name, paint in across]
