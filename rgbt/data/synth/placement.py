"""The record of one placed object, and the random numbers it is drawn from."""

from __future__ import annotations

from typing import NamedTuple

from rgbt.data.synth.shapes import Shape
from rgbt.randomness import numpy_generator

Paint = tuple[float, float, float]

GROUND, BACKDROP, STANDING = range(3)
"""Drawing layers, first to last; within a layer far objects are drawn before near ones."""

NO_SHADOW = -1.0


class Placed(NamedTuple):
    """One object in the world.

    Attributes:
        shape: what it is.
        x: metres right of the camera's start.
        z: metres ahead of it.
        yaw: turn to the right in radians; 0 shows the shape's back.
        scale: factors on the shape's x, y, z.
        paints: first and second paint, reflectance (R, G, B).
        warmth: 0 cold (parked, well wrapped) to 1 (engine on, lightly dressed).
        lit: 0 or 1: whether its lamps are on by night.
        layer: drawing layer.
        shadow_from: share of the height from which it casts a shadow, or `NO_SHADOW`.
        y: height above the ground.
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

_ROW_WIDTH = 14


def draw_rows(seed: int, index: int, pool: str, num: int) -> list[Row]:
    """Numbers for the first `num` objects of the pool `pool` in scene `index`.

    Rows are drawn one after the other, so that the first rows do not depend on their number.
    """
    rows: list[Row] = (
        numpy_generator(seed, f"synth/{pool}", index).random((num, _ROW_WIDTH)).tolist()
    )
    return rows
