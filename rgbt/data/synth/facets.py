"""Collect all flat parts of a scene as arrays, in world coordinates and drawing order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rgbt.data.synth import materials
from rgbt.data.synth.camera import Floats
from rgbt.data.synth.placement import Placed
from rgbt.data.synth.road import Quads
from rgbt.data.synth.shapes import MAX_CORNERS

_COLOURS = materials.column("colour")


@dataclass(frozen=True)
class Facets:
    """N facets, far to near.

    Attributes:
        corners: (N, 8, 3) float32 world points; the last one is repeated.
        num_corners: (N,) int.
        material: (N,) index into `MATERIALS`.
        label: (N,) class id.
        thin: (N,) bool, seen from both sides.
        colour: (N, 3) reflectance.
        warmth: (N,) see `Placed`.
        lit: (N,) see `Placed`; for buildings the style of the windows.
        on_ground: (N,) bool, receives shadows and lies flat.
        owner: (N,) index of the object that it is a part of; -1 for the ground.
    """

    corners: Floats
    num_corners: NDArray[np.intp]
    material: NDArray[np.intp]
    label: NDArray[np.intp]
    thin: NDArray[np.bool_]
    colour: Floats
    warmth: Floats
    lit: Floats
    on_ground: NDArray[np.bool_]
    owner: NDArray[np.intp]


def sorted_for_drawing(placed: Sequence[Placed]) -> list[Placed]:
    """By layer, and within a layer the farthest first (painter's algorithm)."""
    return sorted(placed, key=lambda thing: (thing.layer, -thing.z))


def facets_of(ground: Quads, placed: Sequence[Placed]) -> Facets:
    """The ground's quads, then the parts of `placed`, one or more, in the order given."""
    shapes = [thing.shape for thing in placed]
    owner = np.repeat(np.arange(len(placed)), [len(shape.meta) for shape in shapes])
    # One table of numbers per object: many small arrays would cost more than all the arithmetic.
    numbers = np.array(
        [
            (p.x, p.y, p.z, p.yaw, p.warmth, p.lit, *p.scale, *p.paints[0], *p.paints[1])
            for p in placed
        ],
        np.float32,
    )[owner]
    meta = np.concatenate([shape.meta for shape in shapes])
    corners = _in_world(np.concatenate([shape.corners for shape in shapes]), numbers)
    painted = np.where(meta[:, 2:3] == 2, numbers[:, 12:15], numbers[:, 9:12])
    colour = np.where(meta[:, 2:3] > 0, painted, _COLOURS[meta[:, 0]])

    num_ground = len(ground.material)
    no_heat = np.zeros(num_ground, np.float32)
    return Facets(
        corners=np.concatenate([ground.corners, corners]),
        num_corners=np.concatenate(
            [np.full(num_ground, MAX_CORNERS), *(s.num_corners for s in shapes)]
        ),
        material=np.concatenate([ground.material, meta[:, 0]]),
        label=np.concatenate([ground.label, meta[:, 1]]),
        thin=np.concatenate([np.ones(num_ground, bool), meta[:, 3] > 0]),
        colour=np.concatenate([_COLOURS[ground.material], colour]),
        warmth=np.concatenate([no_heat, numbers[:, 4]]),
        lit=np.concatenate([no_heat, numbers[:, 5]]),
        on_ground=np.arange(num_ground + len(meta)) < num_ground,
        owner=np.concatenate([np.full(num_ground, -1), owner]),
    )


def _in_world(local: Floats, numbers: Floats) -> Floats:
    """Corners scaled, turned about the upright axis and moved to where each object stands."""
    x, y, z, yaw = numbers[:, :4].T[:, :, None]
    scaled = local * numbers[:, None, 6:9]
    sin, cos = np.sin(yaw), np.cos(yaw)
    turned = np.empty_like(scaled)
    turned[..., 0] = scaled[..., 0] * cos + scaled[..., 2] * sin + x
    turned[..., 1] = scaled[..., 1] + y
    turned[..., 2] = scaled[..., 2] * cos - scaled[..., 0] * sin + z
    return turned
