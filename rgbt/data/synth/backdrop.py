"""Shapes of unlabelled objects: buildings, trees, hedges, lamps, poles, signs."""

from __future__ import annotations

from functools import cache

import numpy as np

from rgbt.data.synth.shapes import (
    MAX_CORNERS,
    Face,
    Shape,
    box,
    disc,
    rectangle,
    shape_of,
    sideways,
    thin,
    tube,
    upright,
)
from rgbt.randomness import numpy_generator


@cache
def building() -> Shape:
    """A box of one cubic metre, scaled to size; windows are painted later, in world coordinates."""
    parts = box(
        (-0.5, 0.0, -0.5), (0.5, 1.0, 0.5), ("facade_side", "facade", "facade_side"), paint=1
    )
    return shape_of(parts)


@cache
def vent() -> Shape:
    """A warm outlet on a wall: a distractor that only the thermal camera notices."""
    return shape_of([thin(sideways(rectangle(-0.5, 0.0, 0.5, 0.7)), "vent")])


@cache
def wall() -> Shape:
    """A box of one cubic metre, scaled to a garden wall."""
    return shape_of(box((-0.5, 0.0, -0.5), (0.5, 1.0, 0.5), "wall", paint=1))


NUM_TREES = 5


@cache
def tree(kind: int, near: bool = True) -> Shape:
    """A tree of 6 m: trunk, branches and a crown of ragged blobs, darker below.

    Trees that are not `near` have no branches, and three blobs rather than six.
    """
    generator = numpy_generator(0, "synth/tree", kind)
    parts = [thin(upright(tube((0, 0), (0.1, 2.8), 0.30)), "bark")]
    if near:
        parts += [thin(upright(tube((0.08, 2.0), (x, 3.6), 0.12)), "bark") for x in (-0.8, 0.9)]
    for level, material in enumerate(
        ("leaf_dark", "leaf_dark", "leaf", "leaf", "leaf_light", "leaf_light")
    ):
        x = float(generator.uniform(-1.1, 1.1)) * (1.2 - 0.12 * level)
        y = 3.1 + 0.45 * level + float(generator.uniform(-0.2, 0.2))
        radius = float(generator.uniform(1.0, 1.5)) * (1.1 - 0.09 * level)
        blob = _blob(generator, x, y, radius)
        if near or level % 2 == 0:
            parts.append(thin(upright(blob, -0.04 * level), material))
    return shape_of(parts)


def _blob(
    generator: np.random.Generator, x: float, y: float, radius: float
) -> list[tuple[float, float]]:
    """A disc whose corners are pulled in and out a little; it stays convex enough to fill."""
    ragged = generator.uniform(0.86, 1.1, MAX_CORNERS)
    return [
        (x + (px - x) * float(r), y + (py - y) * float(r))
        for (px, py), r in zip(disc(x, y, radius), ragged, strict=True)
    ]


@cache
def hedge() -> Shape:
    """A hedge of one cubic metre with a ragged end, scaled to the length of its plot."""
    generator = numpy_generator(0, "synth/hedge")
    parts = box((-0.5, 0.0, -0.5), (0.5, 0.9, 0.5), ("leaf_dark", "leaf", "leaf_light"))
    parts += [thin(upright(_blob(generator, x, 0.72, 0.34), -0.51), "leaf") for x in (-0.2, 0.2)]
    return shape_of(parts)


@cache
def street_lamp() -> Shape:
    """A pole of 6.5 m with an arm towards +x and a lamp."""
    return shape_of(
        [
            thin(upright(rectangle(-0.07, 0.0, 0.07, 6.4)), "pole"),
            thin(upright(rectangle(0.0, 6.3, 1.5, 6.4)), "pole"),
            thin(upright(rectangle(1.0, 6.2, 1.7, 6.36), -0.01), "lamp"),
            thin(sideways(rectangle(-0.3, 6.2, 0.3, 6.34), 1.4), "lamp"),
        ]
    )


@cache
def utility_pole() -> Shape:
    """A concrete pole of 9 m with cross-arms and a warm transformer."""
    return shape_of(
        [
            thin(upright(rectangle(-0.15, 0.0, 0.15, 9.0)), "pole"),
            thin(upright(rectangle(-0.9, 8.2, 0.9, 8.34), -0.01), "pole"),
            thin(upright(rectangle(-0.7, 7.4, 0.7, 7.52), -0.01), "pole"),
            thin(upright(rectangle(0.16, 6.3, 0.66, 7.1), -0.02), "transformer"),
        ]
    )


@cache
def wire() -> Shape:
    """A cable of one metre along z, scaled to the distance of two poles."""
    return shape_of([thin(sideways(rectangle(0.0, 0.0, 1.0, 0.05)), "wire")])


NUM_SIGNS = 3


@cache
def sign(kind: int) -> Shape:
    """A traffic sign: round and red-rimmed, square and blue, or a white board."""
    parts = [thin(upright(rectangle(-0.04, 0.0, 0.04, 2.7)), "pole")]
    if kind == 0:
        rings = ((0.34, "sign_red"), (0.25, "sign_white"), (0.12, "sign_blue"))
        parts += [
            thin(upright(disc(0, 2.6, radius), -0.01 * n), name)
            for n, (radius, name) in enumerate(rings, 1)
        ]
    else:
        plate = rectangle(-0.32, 2.2, 0.32, 2.9) if kind == 1 else rectangle(-0.25, 1.6, 0.25, 2.9)
        parts.append(thin(upright(plate, -0.01), "sign_blue" if kind == 1 else "sign_white"))
    return shape_of(parts)


@cache
def vending_machine() -> Shape:
    """A vending machine: warm all day and glowing by night."""
    parts = box((-0.4, 0.0, -0.5), (0.4, 1.85, 0.5), ("vending_body", "vending", "vending_body"))
    for x in (-0.41, 0.41):
        parts.append(Face(sideways(rectangle(-0.45, 0.1, 0.45, 0.75), x), "vending_body"))
    return shape_of(parts)


@cache
def skyline() -> Shape:
    """One square metre facing the camera, scaled to a block on the horizon."""
    return shape_of([thin(upright(rectangle(-0.5, 0.0, 0.5, 1.0)), "far_wall", paint=1)])


@cache
def far_trees() -> Shape:
    """A line of trees on the horizon, 10 m by 1 m, scaled to size."""
    generator = numpy_generator(0, "synth/far_trees")
    blobs = [_blob(generator, x, 0.40, 0.95) for x in np.linspace(-4.6, 4.6, 7).tolist()]
    parts = [thin(upright(rectangle(-5.4, 0.0, 5.4, 0.65)), "leaf_dark")]
    return shape_of([*parts, *(thin(upright(blob, -0.01), "leaf_dark") for blob in blobs)])
