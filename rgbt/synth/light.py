"""Draw time of day, sun, sky, lamps and glare of one scene, for the RGB and the thermal image.

Lamps light by night: the own headlights, street lamps, oncoming cars, vending machines. Headlights
that point at the camera, and a low sun by day, lay a veil over RGB: the lens scatters them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from rgbt.randomness import numpy_generator
from rgbt.synth.camera import NEAR_M, Floats, Key, SynthCamera, floats
from rgbt.synth.street import Placed

_GOLDEN = 0.6180339887
_DARK = floats([0, 0, 0])


class Light(NamedTuple):
    """Holds the light sources of a scene.

    Attributes:
        sun: (3,) unit vector towards the sun, whose strength is `direct`.
        exposure: factor on all light.
        tint: colour cast of the camera.
        headlight: strength of the own headlights by night.
        lamp: colour of the street lamps; zero where they are off.
        lit_windows: share of windows with light by night.
        visibility_m: distance at which 37 % of the light comes through.
        ambient: strength of the sky, whose colours are `zenith` above and `horizon`, as the haze.
        cloud: how much clouds show, 0..1; `clear`: a day without a cover of them.
        others: factor on the light that cars and vending machines cast.
    """

    is_night: bool
    sun: Floats
    exposure: float
    tint: Floats
    headlight: float
    lamp: Floats
    lit_windows: float
    visibility_m: float
    direct: float = 0.0
    ambient: float = 0.0
    zenith: Floats = _DARK
    horizon: Floats = _DARK
    cloud: float = 0.0
    clear: bool = False
    others: float = 1.0


def is_night(seed: int, index: int, night_share: float) -> bool:
    """Say whether scene `index` is a night scene; consecutive scenes keep the share closely."""
    start = numpy_generator(seed, "synth/night").random()
    return (start + index * _GOLDEN) % 1.0 < night_share


def draw_light(seed: int, index: int, night_share: float, night_light: float = 1.0) -> Light:
    """Draw the light of one scene; `night_light` is a factor on all that lights the night."""
    u = numpy_generator(seed, "synth/light", index).random(16).tolist()
    angle, height = 2 * math.pi * u[2], math.radians(22 + 43 * u[3])
    flat = math.cos(height)
    lamp = floats([1.0, 0.72, 0.38] if u[8] < 0.5 else [0.85, 1.0, 0.85])
    common = Light(
        is_night=is_night(seed, index, night_share),
        sun=floats([math.sin(angle) * flat, math.sin(height), math.cos(angle) * flat]),
        exposure=1.6 ** (u[12] - 0.5),
        tint=floats([0.96 + 0.08 * u[0], 1.0, 0.96 + 0.08 * u[1]]),
        headlight=0.5 + 0.8 * u[4],
        # Street lamps are off in a quarter of the streets, and of any strength in the others.
        lamp=lamp * (0.25 + 0.87 * u[7] if u[7] < 0.75 else 0.0),
        lit_windows=0.06 + 0.4 * u[5] ** 2,
        visibility_m=140 + 300 * u[6],
    )
    return _night(common, u, night_light) if common.is_night else _day(common, u)


def _day(light: Light, u: list[float]) -> Light:
    """Make the day clear, or in a third of the scenes cloudy."""
    light = light._replace(exposure=1.25 * light.exposure)
    if u[9] < 0.35:
        grey = floats([0.74, 0.77, 0.82]) * (0.85 + 0.3 * u[10])
        light = light._replace(zenith=grey * 0.9, horizon=grey)
        return light._replace(direct=0.15, ambient=0.72, cloud=0.25)
    light = light._replace(zenith=floats([0.28, 0.50, 0.95]), horizon=floats([0.80, 0.88, 0.98]))
    return light._replace(clear=True, direct=0.95, ambient=0.42, cloud=0.9 * u[11])


def _night(light: Light, u: list[float], factor: float) -> Light:
    """Make a dark sky with some glow at the horizon; the camera sees a little green, as MFNet's."""
    single = np.float32(factor)
    return light._replace(
        ambient=(0.010 + 0.022 * u[10]) * factor,
        zenith=floats([0.004, 0.005, 0.010]) * single,
        horizon=floats([0.026, 0.022, 0.018]) * (0.6 + u[11]) * single,
        cloud=0.3,
        exposure=1.5 * light.exposure,
        tint=light.tint * floats([0.93, 1.03, 0.92]),
        headlight=light.headlight * factor,
        lamp=light.lamp * single,
        others=factor,
    )


_MAX_LAMPS = 6
# A lamp that lights its surroundings: position, colour times strength, reach in metres.
Lamp = tuple[tuple[float, float, float], Floats, float]


def lamplight(world_3HW: Floats, lamps: list[Lamp]) -> Floats:
    """Add the light of all lamps, strength / (1 + (distance / reach)^2)^2, at points (3, H, W)."""
    if not lamps:
        return np.zeros_like(world_3HW)
    points = world_3HW.reshape(3, -1)
    places, colours, reaches = zip(*lamps, strict=True)
    positions, reach = floats(places), floats(reaches)
    # |p - q|^2 = |p|^2 - 2 p.q + |q|^2: one product of matrices for all lamps.
    squared = (points * points).sum(0) + (positions**2).sum(1)[:, None] - 2 * positions @ points
    nearness = 1.0 + np.maximum(squared, 0) / (reach**2)[:, None]
    total = np.stack(colours, axis=1) @ (1.0 / (nearness * nearness))
    return np.asarray(total, np.float32).reshape(world_3HW.shape)


def headlight(world_3HW: Floats, camera: SynthCamera) -> Floats:
    """Return the light of the own low beams, (H, W): a pool ahead, cut off at the waist."""
    dx, dz = world_3HW[0] - camera.position[0], world_3HW[2] - camera.position[2]
    sin, cos = np.float32(np.sin(camera.yaw)), np.float32(np.cos(camera.yaw))
    ahead, aside = np.maximum(dx * sin + dz * cos, 0.1), dx * cos - dz * sin
    spread = aside / (1.1 + 0.30 * ahead)
    near = np.minimum(ahead / 4.0, 1.0)
    above = np.maximum(world_3HW[1] - 0.75 - 0.012 * ahead, 0.0)
    reach = near / (1.0 + (ahead / 11.0) ** 2)
    return np.asarray(reach * cv2.exp(-spread * spread - 1.6 * above), np.float32)


def is_oncoming(thing: Placed) -> bool:
    """Say whether it is a car whose headlights point at the camera."""
    return thing.shape.name.startswith("car_") and math.cos(thing.yaw) < 0


def lamps_of(placed: Sequence[Placed], light: Light) -> list[Lamp]:
    """Return the nearest lamps that light their surroundings; `placed` is sorted far to near."""
    lamps: list[Lamp] = []
    others = np.float32(light.others)
    for thing in placed:
        x, z = thing.x, thing.z
        if not thing.lit:
            continue
        if thing.shape.name == "street_lamp":
            lamps.append(((x + 1.35 * math.cos(thing.yaw), 5.4, z), light.lamp, 5.5))
        elif thing.shape.name == "vending_machine":
            lamps.append(((x, 1.0, z - 0.7), floats([0.30, 0.33, 0.36]) * others, 1.6))
        elif is_oncoming(thing):
            lamps.append(((x, 0.4, z - 4.0), floats([0.9, 0.85, 0.75]) * others, 1.8))
    return lamps[-_MAX_LAMPS:]


_SUN, _HEADLAMP = floats([1.0, 0.95, 0.85]), floats([1.0, 0.97, 0.90])
_SUN_SHARE = 0.33
# Distance at which a veil has half its strength, as a share of the image width.
_REACH = 0.16


def veil_of(
    placed: Sequence[Placed], camera: SynthCamera, light: Light, strength: float, key: Key
) -> Floats | None:
    """Return light (3, H, W) to add to the image; None where there is no source of glare.

    Headlights 10 m ahead have the brightness `strength`, 1 = white of the day. In a share of the
    clear days the sun is low at the end of the road.
    """
    if strength == 0:
        return None
    height, width = camera.height, camera.width
    sources = []
    if light.is_night:
        for thing in placed:
            if not (thing.lit and is_oncoming(thing)):
                continue
            point = camera.to_camera(floats([thing.x, 0.7, thing.z]))
            column, row = camera.project(point).tolist()
            if 0 <= column < width and 0 <= row < height and point[2] > NEAR_M:
                sources.append((column, row, 10 / max(float(point[2]), 10.0)))
    elif light.clear:
        u = numpy_generator(key[0], "synth/glare", key[1]).random(3).tolist()
        if u[0] < _SUN_SHARE:
            sources.append((width * (0.3 + 0.4 * u[1]), height * (0.2 + 0.25 * u[2]), 1.0))
    if not sources:
        return None
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    reach = np.float32(_REACH * width)
    veil = np.zeros((height, width), np.float32)
    for column, row, brightness in sources:
        squared = (columns - np.float32(column)) ** 2 + (rows - np.float32(row)) ** 2
        veil += np.float32(strength * brightness) / (1 + squared / reach**2)
    colour = _HEADLAMP if light.is_night else _SUN
    return np.asarray(colour[:, None, None] * veil, np.float32)
