"""Render one scene from its factors, and the second frame after a motion.

RGB has sun or lamps on coloured surfaces, sky, haze, glow and camera noise. Thermal has the
temperatures of materials, not classes, with blur, drift and noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.randomness import numpy_generator
from rgbt.synth.camera import Floats, Key, SynthCamera, camera_of, floats, flow_between
from rgbt.synth.factors import EgoMotion, SceneFactors
from rgbt.synth.light import Light, draw_light, headlight, lamplight, lamps_of, veil_of
from rgbt.synth.objects import place_objects, place_scenery
from rgbt.synth.street import INDEX, Placed, column, draw_road, ground_quads
from rgbt.synth.surface import (
    Facets,
    Surface,
    average,
    draw,
    facets_of,
    sample_tile,
    shadow_map,
    sorted_for_drawing,
    surface_of,
)

# Glow is stored in eight bits up to this brightness.
_GLOW_RANGE = 4.0

_GLASS = floats([0.035, 0.045, 0.055])[:, None, None]
_WINDOW_GLOW = floats([0.95, 0.80, 0.48])[:, None, None]
_GLOWS = column("glow_red", "glow_green", "glow_blue")
_RGB_TEXTURES, _HEAT_TEXTURES = column("rgb_texture"), column("heat_texture")
_DAY, _NIGHT, _HEAT = (column(name) for name in ("day", "night", "heat"))
_PASSIVE = column("passive") > 0

# Range in degrees above the air that eight bits per facet cover.
_COLDEST, _SPAN = -45.0, 95.0

# Grey level (1 = full scale) of air temperature, and per degree, as MFNet's camera shows them.
_LEVEL, _PER_DEGREE = 0.21, 0.026


@dataclass(frozen=True)
class Scene:
    """Holds one frame; the label has MFNet's class ids 0..8.

    Attributes:
        depth: (H, W) float32, metres along the optical axis; infinity for the sky.
        grey: (H, W) float32, `thermal` before it became bytes: 1 = full scale, and not clipped.
        material: (H, W) index of the material that each pixel shows.
        owner: (H, W) index into `placed` of the object that it shows; -1 for ground and sky.
    """

    rgb: NDArray[np.uint8]
    thermal: NDArray[np.uint8]
    label: NDArray[np.uint8]
    depth: Floats
    grey: Floats
    material: NDArray[np.intp]
    owner: NDArray[np.intp]
    placed: tuple[Placed, ...]
    is_night: bool
    camera: SynthCamera


@dataclass(frozen=True)
class ScenePair:
    """Holds two consecutive frames of one scene in which nothing moves but the camera.

    For each pixel of `second`, `flow` (H, W, 2) float32 is the displacement (rows, columns) to its
    surface point in `first`, NaN behind that camera; `visible` (H, W): whether that is seen.
    """

    first: Scene
    second: Scene
    flow: Floats
    visible: NDArray[np.bool_]


World = tuple[Facets, list[Placed], Light]


def render_scene(seed: int, index: int, factors: SceneFactors) -> Scene:
    """Render scene `index` (>= 0) of the endless data set `seed`; equal arguments, equal bytes."""
    return _frame(_world(seed, index, factors), camera_of(factors), factors, (seed, index, 0))


def render_pair(seed: int, index: int, factors: SceneFactors, motion: EgoMotion) -> ScenePair:
    """Render scene `index` as `render_scene` does, and after a `motion`, with exact flow.

    Texture, light and thermal drift stay, sensor noise is drawn anew.
    """
    world = _world(seed, index, factors)
    camera = camera_of(factors)
    first = _frame(world, camera, factors, (seed, index, 0))
    second = _frame(world, camera.moved(motion), factors, (seed, index, 1))
    flow = flow_between(second.depth, second.camera, first.camera)
    return ScenePair(first, second, flow, _visible(first, second, flow))


def _world(seed: int, index: int, factors: SceneFactors) -> World:
    road = draw_road(seed, index, factors)
    light = draw_light(seed, index, factors.night_share, factors.night_light)
    placed = place_objects(seed, index, road, factors) + place_scenery(seed, index, road)
    placed = sorted_for_drawing(placed)
    return facets_of(ground_quads(road), placed), placed, light


def _frame(
    world: World, camera: SynthCamera, factors: SceneFactors, key: tuple[int, int, int]
) -> Scene:
    (facets, placed, light), (seed, index, frame) = world, key
    drawing = draw(facets, camera)
    shadow = shadow_map(placed, camera, light, whole=factors.whole_shadows)
    surface = surface_of(drawing, facets, camera, shadow, (seed, index))
    image = render_rgb(surface, light, placed, factors, (seed, index))
    heat = render_thermal(surface, light, factors)
    rgb_noise = numpy_generator(seed, "synth/rgb_noise", index, frame)
    thermal_noise = numpy_generator(seed, "synth/thermal_noise", index, frame)
    grey = develop_thermal(heat, factors, seed, index, thermal_noise)
    return Scene(
        rgb=develop_rgb(image, factors, rgb_noise),
        thermal=eight_bits(grey.copy()),
        label=np.take(np.concatenate([[0], facets.label]).astype(np.uint8), drawing.ids),
        depth=surface.depth,
        grey=grey,
        material=surface.material,
        owner=np.take(np.concatenate([[-1], facets.owner]), drawing.ids),
        placed=tuple(placed),
        is_night=light.is_night,
        camera=camera,
    )


def _visible(first: Scene, second: Scene, flow: Floats) -> NDArray[np.bool_]:
    """Find pixels of `second` whose surface point is inside `first` and the nearest thing there."""
    height, width = second.depth.shape
    rows, columns = np.mgrid[:height, :width]
    target_rows, target_columns = rows + flow[..., 0], columns + flow[..., 1]
    inside = (target_rows >= 0) & (target_rows <= height - 1)
    inside &= (target_columns >= 0) & (target_columns <= width - 1)
    nearest_rows = np.rint(np.where(inside, target_rows, 0)).astype(int)
    nearest_columns = np.rint(np.where(inside, target_columns, 0)).astype(int)
    points = second.camera.to_world(second.camera.rays(), 1.0 / second.depth)
    expected = first.camera.to_camera(np.moveaxis(points, 0, 2).astype(np.float64))[..., 2]
    expected = np.where(np.isinf(second.depth), np.inf, expected).astype(np.float32)
    found = first.depth[nearest_rows, nearest_columns]
    with np.errstate(invalid="ignore", divide="ignore"):
        agrees = np.abs(1 / found - 1 / expected) < 0.03 / expected + 2e-3
    return np.asarray(inside & agrees)


def render_rgb(
    surface: Surface, light: Light, placed: list[Placed], factors: SceneFactors, key: Key
) -> Floats:
    """Render the light that reaches the sensor: (3, H, W) in 0..1, gamma-encoded, no noise."""
    strength = texture_strength(factors)
    colour = average(_colour_table(surface, light), surface.drawing)
    glow = average(_glow_table(surface.facets, light), surface.drawing)
    image = _decoded(colour)
    texture = np.take(_RGB_TEXTURES, surface.material) * strength * surface.texture
    image *= np.maximum(1.0 + texture, 0.1)
    image += surface.window * (_GLASS - image)
    image *= _lamplight(surface, light, placed) if light.is_night else 1.0 - 0.72 * surface.shadow

    depth = np.where(surface.drawing.ids == 0, 0, surface.depth)
    through = cv2.exp(depth * np.float32(-1 / light.visibility_m))
    image *= through
    image += light.horizon[:, None, None] * (1.0 - through)
    if light.is_night:
        shining = _decoded(glow) * np.float32(_GLOW_RANGE)
        lit = (surface.window_lit < light.lit_windows) * surface.window
        shining += _WINDOW_GLOW * (lit * (0.3 + 2 * surface.window_lit))
        image += shining + _bloom(shining)

    # Below the last row that shows sky there is none to compute.
    last = int(np.flatnonzero(glow[..., 3].any(1)).max(initial=-1)) + 1
    share = glow[:last, :, 3] * np.float32(1 / 255)
    image[:, :last] += share * _sky(surface.rays[:, :last], light, surface.camera, key[0])
    veil = veil_of(placed, surface.camera, light, factors.glare, key)
    if veil is not None:
        image += veil
    optical = image * (light.tint * np.float32(-1.7 * light.exposure))[:, None, None]
    # cv2.exp is five times as fast as NumPy's; it takes two dimensions.
    exposed = 1.0 - cv2.exp(optical.reshape(-1, image.shape[2])).reshape(image.shape)
    return np.asarray(np.sqrt(np.maximum(exposed, 0)), np.float32)


def _colour_table(surface: Surface, light: Light) -> NDArray[np.uint8]:
    """Return the square root of reflectance times the facet's share of sun and sky, (N + 1, 4)."""
    colour = surface.facets.colour
    if light.is_night:
        shade = np.full(len(colour), 0.9, np.float32)
    else:
        normals = surface.drawing.normals[1:]
        facing = np.maximum(normals @ light.sun, 0)
        shade = light.ambient * (0.75 + 0.25 * normals[:, 1]) + light.direct * facing
    table = np.zeros((len(shade) + 1, 4), np.uint8)
    table[1:, :3] = np.sqrt(np.clip(colour * shade[:, None], 0, 1)) * 255
    return table


def _glow_table(facets: Facets, light: Light) -> NDArray[np.uint8]:
    """Return the square root of what lamps give off, (N + 1, 4); the last column says sky."""
    table = np.zeros((len(facets.material) + 1, 4), np.uint8)
    table[0, 3] = 255
    if light.is_night:
        glow = _GLOWS[facets.material] * facets.lit[:, None]
        table[1:, :3] = np.sqrt(np.clip(glow / _GLOW_RANGE, 0, 1)) * 255
    return table


def _decoded(encoded_HW4: NDArray[np.uint8]) -> Floats:
    """Square the first three of four channels, (3, H, W): the tables hold square roots."""
    value = np.moveaxis(encoded_HW4[..., :3], 2, 0).astype(np.float32, order="C")
    value *= np.float32(1 / 255)
    return value * value


def _lamplight(surface: Surface, light: Light, placed: list[Placed]) -> Floats:
    total = lamplight(surface.world, lamps_of(placed, light))
    own = (floats([1.0, 0.96, 0.86]) * light.headlight)[:, None, None]
    total += headlight(surface.world, surface.camera) * own
    total *= 1.0 - 0.5 * surface.shadow
    return total + np.float32(light.ambient)


def _bloom(shining: Floats) -> Floats:
    """Scatter light in the lens: a narrow and a wide halo."""
    _, height, width = shining.shape
    halo = np.empty_like(shining)
    for plane, out in zip(shining, halo, strict=True):
        small = cv2.resize(plane, (width // 4, height // 4), interpolation=cv2.INTER_AREA)
        narrow, wide = (cv2.GaussianBlur(small, (0, 0), width / by) for by in (160, 50))
        small = 0.5 * narrow + wide
        cv2.resize(small, (width, height), dst=out, interpolation=cv2.INTER_LINEAR)
    return halo


def _sky(rays: Floats, light: Light, camera: SynthCamera, seed: int) -> Floats:
    """Return the colour of the sky in the direction of each pixel, (3, H, W)."""
    x, y, z = camera.turned(rays)
    up = np.maximum(y / np.sqrt(x * x + y * y + z * z), 0)
    high = np.sqrt(np.minimum(up * 1.8, 1))
    ahead = np.maximum(z, 0.05) * (up + 0.12)
    clouds = sample_tile(seed, x / ahead * 9, up / (up + 0.12) * 90)
    cover = np.clip(clouds * 0.6, 0, 1) * np.float32(light.cloud)
    colour = light.horizon[:, None, None] + (light.zenith - light.horizon)[:, None, None] * high
    colour += cover * (np.float32(1.05) * light.horizon.max() - colour)
    return np.asarray(colour, np.float32)


def develop_rgb(
    image: Floats, factors: SceneFactors, generator: np.random.Generator
) -> NDArray[np.uint8]:
    """Give vignette, noise and eight bits to an image (3, H, W) in 0..1: (H, W, 3) uint8.

        sd(p) = rgb_noise (1 + radius_gain r(p)^2) (1 + dark_gain (1 - mean of the image))

    with r the distance from the centre (1 at the corners): in the dark, a camera raises its gain.
    """
    radius_squared = squared_radius(*image.shape[1:])
    sd = factors.rgb_noise * (1 + factors.rgb_noise_radius_gain * radius_squared)
    sd *= 1 + factors.rgb_noise_dark_gain * (1 - float(image.mean()))
    noisy = generator.standard_normal(image.shape, np.float32)
    noisy *= sd
    noisy += image * (1 - factors.vignette * radius_squared)
    return np.asarray(cv2.merge(list(eight_bits(noisy))), np.uint8)


def texture_strength(factors: SceneFactors) -> Floats | float:
    """Return the factor on the texture, (H, W) where it changes with the radius."""
    if factors.texture_radius_gain == 0:
        return factors.texture_strength
    growth = 1 + factors.texture_radius_gain * squared_radius(factors.height, factors.width)
    return np.asarray(factors.texture_strength * growth, np.float32)


def eight_bits(image: Floats) -> NDArray[np.uint8]:
    """Convert an image in 0..1 to bytes; values outside are clipped. The image is overwritten."""
    image *= 255
    image += 0.5
    np.clip(image, 0, 255, out=image)
    return image.astype(np.uint8)


@lru_cache(maxsize=8)
def squared_radius(height: int, width: int) -> Floats:
    """Return the squared distance from the image centre, (H, W) float32, 1 at the corners."""
    rows = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    columns = np.linspace(-1, 1, width, dtype=np.float32)
    aspect = np.float32(height / width)
    return np.asarray((columns**2 + (rows * aspect) ** 2) / (1 + aspect**2), np.float32)


def render_thermal(surface: Surface, light: Light, factors: SceneFactors) -> Floats:
    """Render the temperature of each pixel, (H, W) degrees above the air; not blurred or noisy."""
    strength = texture_strength(factors)
    table = np.zeros((len(surface.facets.material) + 1, 4), np.uint8)
    degrees = np.concatenate([[-34.0], _facet_degrees(surface, light, factors)])
    table[:, 0] = np.clip((degrees - _COLDEST) / _SPAN * 255, 0, 255)
    table[0, 1] = 255
    mean = average(table, surface.drawing)
    heat = mean[..., 0].astype(np.float32) * np.float32(_SPAN / 255) + np.float32(_COLDEST)
    heat += np.take(_HEAT_TEXTURES, surface.material) * strength * surface.patches
    colder = floats([5, -4])[(surface.window_lit < light.lit_windows).astype(np.intp)]
    heat -= surface.window * colder
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
        road = of_material[INDEX["asphalt"]]
        closer = road + factors.passive_contrast * (degrees - road)
        degrees = np.where(_PASSIVE[facets.material], closer, degrees)
    return np.asarray(degrees, np.float32)


def develop_thermal(
    heat: Floats, factors: SceneFactors, seed: int, index: int, generator: np.random.Generator
) -> Floats:
    """Convert `heat` (H, W) to grey levels, some below 0 or above 1, with drift and noise.

    The noise is per pixel, per column, and smeared over neighbours, from `generator`. The drift, an
    offset that varies slowly and a gain, belongs to the scene.
    """
    height, width = heat.shape
    drift = numpy_generator(seed, "synth/drift", index)
    gain = 1.0 + 2.0 * factors.thermal_drift * float(drift.standard_normal())
    coarse = drift.standard_normal((4, 5)).astype(np.float32)
    offset = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    offset *= factors.thermal_drift
    grey = _LEVEL + _PER_DEGREE * factors.thermal_contrast * gain * _softened(heat) + offset
    pixel = generator.standard_normal(heat.shape, np.float32)
    column = generator.standard_normal(width, np.float32)
    noise = 0.75 * pixel + 0.35 * column + 1.4 * _softened(pixel)
    if factors.thermal_noise_radius_gain != 0:
        noise *= 1 + factors.thermal_noise_radius_gain * squared_radius(height, width)
    grey += factors.thermal_noise * noise
    return np.asarray(grey, np.float32)


def _softened(image: Floats) -> Floats:
    """Blur as the thermal lens, which is softer than that of RGB: 0.7 pixels of 160."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7 * image.shape[1] / 160))
