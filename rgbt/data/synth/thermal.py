"""Render the thermal image: temperatures with blur, drift and noise.

It follows the materials, not the classes: an engine differs from a door, a parked car is as cold as
the street, a warm outlet shines like a person.
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbt.data.synth import materials
from rgbt.data.synth.camera import Floats
from rgbt.data.synth.factors import SceneFactors
from rgbt.data.synth.light import Light
from rgbt.data.synth.raster import average
from rgbt.data.synth.rgb import squared_radius, texture_strength
from rgbt.data.synth.surface import Surface
from rgbt.randomness import numpy_generator

_COLDEST, _SPAN = -45.0, 95.0
"""Range in degrees above the air that eight bits per facet cover."""

_LEVEL, _PER_DEGREE = 0.21, 0.026
"""Grey level (1 = full scale) of air temperature, and per degree, as MFNet's camera shows them."""

_DAY, _NIGHT, _HEAT = (materials.column(name) for name in ("day", "night", "heat"))
_TEXTURES = materials.column("heat_texture")


_PASSIVE = np.isin(
    list(materials.INDEX),
    ["line", "kerb_top", "kerb_face", "yellow", "black_band", "cone_orange", "cone_white",
     "cone_base", "rail_light", "rail_dark", "rail_mesh", "metal", "spokes", "saddle"],
)  # fmt: skip
"""Materials that nothing heats but the sun."""


def render_thermal(surface: Surface, light: Light, factors: SceneFactors) -> Floats:
    """Temperature of each pixel, (H, W) float32 degrees above the air; not yet blurred or noisy."""
    strength = texture_strength(factors)
    table = np.zeros((len(surface.facets.material) + 1, 4), np.uint8)
    degrees = np.concatenate([[-34.0], _facet_degrees(surface, light, factors)])
    table[:, 0] = np.clip((degrees - _COLDEST) / _SPAN * 255, 0, 255)
    table[0, 1] = 255
    mean = average(table, surface.drawing)
    heat = mean[..., 0].astype(np.float32) * np.float32(_SPAN / 255) + np.float32(_COLDEST)
    heat += np.take(_TEXTURES, surface.material) * strength * surface.patches
    heat -= surface.window * np.where(
        surface.window_lit < light.lit_windows, np.float32(-4), np.float32(5)
    )
    if not light.is_night:
        heat -= 5.0 * light.direct * surface.shadow
    # The sky is warmer towards the horizon, where the path through the air is longer.
    up = surface.camera.turned(surface.rays)[1]
    lower = 14 * np.exp(-6 * np.maximum(up, 0)) * (mean[..., 1] / np.float32(255))
    return np.asarray(heat + lower, np.float32)


def _facet_degrees(surface: Surface, light: Light, factors: SceneFactors) -> Floats:
    facets = surface.facets
    of_material = _NIGHT if light.is_night else _DAY
    degrees = of_material[facets.material]
    degrees = degrees + _HEAT[facets.material] * facets.warmth
    if not light.is_night:
        facing = np.maximum(surface.drawing.normals[1:] @ light.sun, 0)
        degrees = degrees + 4.0 * light.direct * (facing - 0.5) * ~facets.on_ground
    if factors.passive_contrast != 1:
        road = of_material[materials.INDEX["asphalt"]]
        closer = road + factors.passive_contrast * (degrees - road)
        degrees = np.where(_PASSIVE[facets.material], closer, degrees)
    return np.asarray(degrees, np.float32)


def develop(
    heat: Floats, factors: SceneFactors, seed: int, index: int, generator: np.random.Generator
) -> Floats:
    """Contrast, lens, drift and noise of `heat` (H, W): grey levels, some below 0 or above 1.

    The noise has three parts of the same strength factor: per pixel, per column, and smeared over
    neighbours. The drift is an offset that varies slowly over the image and a gain per scene; both
    belong to the scene (`seed`, `index`), so two frames of one scene share them; `generator` is
    that of the noise of this frame.
    """
    height, width = heat.shape
    drift = numpy_generator(seed, "synth/drift", index)
    gain = 1.0 + 2.0 * factors.thermal_drift * float(drift.standard_normal())
    coarse = drift.standard_normal((4, 5)).astype(np.float32)
    offset = (
        cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) * factors.thermal_drift
    )
    grey = _LEVEL + _PER_DEGREE * factors.thermal_contrast * gain * _blurred(heat) + offset
    pixel, column = (
        generator.standard_normal(heat.shape, np.float32),
        generator.standard_normal(width, np.float32),
    )
    noise = 0.75 * pixel + 0.35 * column + 1.4 * _blurred(pixel)
    if factors.thermal_noise_radius_gain != 0:
        noise *= 1 + factors.thermal_noise_radius_gain * squared_radius(height, width)
    grey += factors.thermal_noise * noise
    return np.asarray(grey, np.float32)


def _blurred(image: Floats) -> Floats:
    """The thermal lens is softer than the RGB lens: 0.7 pixels at a width of 160."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7 * image.shape[1] / 160))
