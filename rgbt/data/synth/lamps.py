"""Light by night: the own headlights, street lamps, oncoming cars, vending machines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from rgbt.data.synth import backdrop, cars
from rgbt.data.synth.camera import Floats, SynthCamera, floats
from rgbt.data.synth.light import Light
from rgbt.data.synth.placement import Placed

_MAX_LAMPS = 6
_CARS = {cars.car(kind) for kind in range(cars.NUM_CARS)}


class Lamp(NamedTuple):
    """A lamp that lights its surroundings: position, colour times strength, reach in metres."""

    position: tuple[float, float, float]
    colour: Floats
    reach_m: float


def lamplight(world_3HW: Floats, lamps: list[Lamp]) -> Floats:
    """(3, H, W) light of all lamps at each world point; strength / (1 + (distance / reach)^2)^2."""
    if not lamps:
        return np.zeros_like(world_3HW)
    points = world_3HW.reshape(3, -1)
    positions = floats([lamp.position for lamp in lamps])
    reach = floats([lamp.reach_m for lamp in lamps])
    colours = np.stack([lamp.colour for lamp in lamps], axis=1)
    # |p - q|^2 = |p|^2 - 2 p.q + |q|^2: one product of matrices for all lamps.
    squared = (points * points).sum(0) + (positions**2).sum(1)[:, None] - 2 * positions @ points
    nearness = 1.0 + np.maximum(squared, 0) / (reach**2)[:, None]
    return np.asarray(colours @ (1.0 / (nearness * nearness)), np.float32).reshape(world_3HW.shape)


def headlight(world_3HW: Floats, camera: SynthCamera) -> Floats:
    """(H, W) light of the own low beams at each world point: a pool ahead, cut off at the waist."""
    dx, dz = world_3HW[0] - camera.position[0], world_3HW[2] - camera.position[2]
    sin, cos = np.float32(np.sin(camera.yaw)), np.float32(np.cos(camera.yaw))
    ahead, aside = np.maximum(dx * sin + dz * cos, 0.1), dx * cos - dz * sin
    spread = aside / (1.1 + 0.30 * ahead)
    near = np.minimum(ahead / 4.0, 1.0)
    above = np.maximum(world_3HW[1] - 0.75 - 0.012 * ahead, 0.0)
    reach = near / (1.0 + (ahead / 11.0) ** 2)
    return np.asarray(reach * cv2.exp(-spread * spread - 1.6 * above), np.float32)


def lamps_of(placed: Sequence[Placed], light: Light) -> list[Lamp]:
    """The nearest lamps that light their surroundings; `placed` is sorted far to near."""
    lamps = [lamp for thing in placed if thing.lit for lamp in _lamps(thing, light)]
    return lamps[-_MAX_LAMPS:]


def _lamps(thing: Placed, light: Light) -> list[Lamp]:
    if thing.shape is backdrop.street_lamp():
        reach = 1.35 * math.cos(thing.yaw)
        return [Lamp((thing.x + reach, 5.4, thing.z), light.lamp, 5.5)]
    if thing.shape is backdrop.vending_machine():
        return [Lamp((thing.x, 1.0, thing.z - 0.7), floats([0.30, 0.33, 0.36]), 1.6)]
    if thing.shape in _CARS and math.cos(thing.yaw) < 0:
        return [Lamp((thing.x, 0.4, thing.z - 4.0), floats([0.9, 0.85, 0.75]), 1.8)]
    return []
