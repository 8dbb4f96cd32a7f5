"""Render one scene from its factors, and the second frame after a motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rgbt.randomness import numpy_generator
from rgbt.synth.camera import Floats, SynthCamera, camera_of, flow_between
from rgbt.synth.factors import EgoMotion, SceneFactors
from rgbt.synth.light import Lamp, Light, draw_light, lamps_of, veil_of
from rgbt.synth.objects import place_objects, place_scenery
from rgbt.synth.raster import Facets, draw, facets_of, sorted_for_drawing
from rgbt.synth.render import (
    develop_rgb,
    develop_thermal,
    eight_bits,
    render_rgb,
    render_thermal,
)
from rgbt.synth.street import Placed, draw_road, ground_quads
from rgbt.synth.surface import shadow_map, surface_of


@dataclass(frozen=True)
class Scene:
    """One frame.

    Attributes:
        label: MFNet's class ids 0..8.
        depth: (H, W) float32, metres along the optical axis; infinity for the sky.
        grey: (H, W) float32, `thermal` before it became bytes: 1 = full scale, and not clipped.
        material: (H, W) index of the material that each pixel shows.
        owner: (H, W) index into `placed` of the object that it shows; -1 for ground and sky.
        placed: the objects of the scene, far ones before near ones.
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
    """Two consecutive frames of one scene in which nothing moves but the camera.

    Attributes:
        flow: (H, W, 2) float32, for each pixel of `second` the displacement (rows, columns) to
            where its surface point lies in `first`; NaN where that is behind the first camera.
        visible: (H, W) bool, for each pixel of `second`: its surface point is seen in `first`.
    """

    first: Scene
    second: Scene
    flow: Floats
    visible: NDArray[np.bool_]


class _World(NamedTuple):
    facets: Facets
    placed: list[Placed]
    light: Light
    lamps: list[Lamp]


def render_scene(seed: int, index: int, factors: SceneFactors) -> Scene:
    """Scene `index` (>= 0) of the endless data set `seed`; equal arguments give equal bytes."""
    return _frame(_world(seed, index, factors), camera_of(factors), factors, (seed, index, 0))


def render_pair(seed: int, index: int, factors: SceneFactors, motion: EgoMotion) -> ScenePair:
    """Scene `index` before and after the camera's `motion`, with exact flow.

    The first frame is that of `render_scene`; texture, light and thermal drift stay, sensor noise
    is drawn anew.
    """
    world = _world(seed, index, factors)
    camera = camera_of(factors)
    first = _frame(world, camera, factors, (seed, index, 0))
    second = _frame(world, camera.moved(motion), factors, (seed, index, 1))
    flow = flow_between(second.depth, second.camera, first.camera)
    return ScenePair(first, second, flow, _visible(first, second, flow))


def _world(seed: int, index: int, factors: SceneFactors) -> _World:
    road = draw_road(seed, index, factors)
    light = draw_light(seed, index, factors.night_share, factors.night_light)
    placed = place_objects(seed, index, road, factors) + place_scenery(seed, index, road)
    placed = sorted_for_drawing(placed)
    return _World(facets_of(ground_quads(road), placed), placed, light, lamps_of(placed, light))


def _frame(
    world: _World, camera: SynthCamera, factors: SceneFactors, key: tuple[int, int, int]
) -> Scene:
    seed, index, frame = key
    facets, light = world.facets, world.light
    drawing = draw(facets, camera)
    shadow = shadow_map(world.placed, camera, light, whole=factors.whole_shadows)
    surface = surface_of(drawing, facets, camera, shadow, (seed, index))
    veil = veil_of(world.placed, camera, light, factors.glare, (seed, index))
    image = render_rgb(surface, light, world.lamps, veil, factors, seed)
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
        placed=tuple(world.placed),
        is_night=light.is_night,
        camera=camera,
    )


def _visible(first: Scene, second: Scene, flow: Floats) -> NDArray[np.bool_]:
    """Pixels of `second` whose surface point is inside `first` and the nearest thing there."""
    height, width = second.depth.shape
    rows, columns = np.mgrid[:height, :width]
    target_rows, target_columns = rows + flow[..., 0], columns + flow[..., 1]
    inside = (target_rows >= 0) & (target_rows <= height - 1)
    inside &= (target_columns >= 0) & (target_columns <= width - 1)
    to_rows = np.rint(np.where(inside, target_rows, 0)).astype(int)
    to_columns = np.rint(np.where(inside, target_columns, 0)).astype(int)
    points = second.camera.to_world(second.camera.rays(), 1.0 / second.depth)
    expected = first.camera.to_camera(np.moveaxis(points, 0, 2).astype(np.float64))[..., 2]
    expected = np.where(np.isinf(second.depth), np.inf, expected).astype(np.float32)
    found = first.depth[to_rows, to_columns]
    with np.errstate(invalid="ignore", divide="ignore"):
        agrees = np.abs(1 / found - 1 / expected) < 0.03 / expected + 2e-3
    return np.asarray(inside & agrees)
