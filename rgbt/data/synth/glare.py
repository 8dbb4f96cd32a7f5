"""Draw the veil that a strong light in view lays over the RGB image.

Light scatters in the lens: around headlights that point at the camera by night, and around a low
sun by day. The thermal image has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rgbt.data.synth.camera import NEAR_M, Floats, SynthCamera, floats
from rgbt.data.synth.light import Light, is_oncoming
from rgbt.data.synth.placement import Placed
from rgbt.randomness import numpy_generator

_SUN_SHARE = 0.33
_SUN = floats([1.0, 0.95, 0.85])
_HEADLAMP = floats([1.0, 0.97, 0.90])
_REACH = 0.16
"""Distance at which a veil has half its strength, as a share of the image width."""


def veil_of(
    placed: Sequence[Placed],
    camera: SynthCamera,
    light: Light,
    strength: float,
    key: tuple[int, int],
) -> Floats | None:
    """(3, H, W) light that is added to the image; None where there is no source of glare.

    Args:
        placed: objects of the scene.
        camera: of the frame.
        light: of the scene.
        strength: factor; a headlight pair 10 m ahead has this brightness, 1 = white of the day.
        key: (seed, index) of the scene, which draw whether and where there is a low sun.
    """
    if strength == 0:
        return None
    sources = list(_headlamps(placed, camera) if light.is_night else _low_sun(camera, light, key))
    if not sources:
        return None
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    reach = np.float32(_REACH * camera.width)
    veil = np.zeros((camera.height, camera.width), np.float32)
    for column, row, brightness in sources:
        squared = (columns - np.float32(column)) ** 2 + (rows - np.float32(row)) ** 2
        veil += np.float32(strength * brightness) / (1 + squared / reach**2)
    colour = _HEADLAMP if light.is_night else _SUN
    return np.asarray(colour[:, None, None] * veil, np.float32)


def _headlamps(
    placed: Sequence[Placed], camera: SynthCamera
) -> Iterator[tuple[float, float, float]]:
    """Column, row and brightness of each pair of headlights in view."""
    oncoming = (thing for thing in placed if thing.lit and is_oncoming(thing))
    points = (camera.to_camera(floats([thing.x, 0.7, thing.z])) for thing in oncoming)
    for point in points:
        column, row = camera.project(point).tolist()
        inside = 0 <= column < camera.width and 0 <= row < camera.height
        if inside and point[2] > NEAR_M:
            yield column, row, 10 / max(float(point[2]), 10.0)


def _low_sun(
    camera: SynthCamera, light: Light, key: tuple[int, int]
) -> Iterator[tuple[float, float, float]]:
    """The sun just above the end of the road, in a share of the clear days."""
    seed, index = key
    u = numpy_generator(seed, "synth/glare", index).random(3).tolist()
    if light.clear and u[0] < _SUN_SHARE:
        yield camera.width * (0.3 + 0.4 * u[1]), camera.height * (0.2 + 0.25 * u[2]), 1.0
