"""Compute position, texture and shadow of each pixel before lighting, for RGB and thermal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.randomness import numpy_generator
from rgbt.synth.camera import NEAR_M, Floats, SynthCamera, floats
from rgbt.synth.light import Light
from rgbt.synth.raster import Drawing, Facets, beyond_near
from rgbt.synth.shapes import INDEX
from rgbt.synth.street import Placed

_TILE = 256
_LAST_SHADOW_M = 45.0
_FACADES = [INDEX["facade"], INDEX["facade_side"]]


@dataclass(frozen=True)
class Surface:
    """Maps (H, W) of one frame.

    Attributes:
        facets: what there is.
        camera: where it is seen from.
        drawing: which facet is where.
        rays: (3, H, W) in camera coordinates.
        world: (3, H, W), metres.
        depth: metres along the optical axis; infinity for the sky.
        material: material index.
        texture: zero mean, about unit variance near the camera.
        patches: its coarse part: heat spreads, so its fine grain is not seen.
        window: share of the pixel that is a window.
        window_lit: 0..1, draw of the window: lit where below the share of lit ones.
        shadow: 0..1.
    """

    facets: Facets
    camera: SynthCamera
    drawing: Drawing
    rays: Floats
    world: Floats
    depth: Floats
    material: NDArray[np.intp]
    texture: Floats
    patches: Floats
    window: Floats
    window_lit: Floats
    shadow: Floats


def surface_of(
    drawing: Drawing,
    facets: Facets,
    camera: SynthCamera,
    shadow: Floats,
    texture_key: tuple[int, int],
) -> Surface:
    """Surface maps of one frame; `shadow` is (H, W) of `shadow_map`.

    `texture_key` is (seed, scene index): textures stay where they are when the camera moves.
    """
    rays = camera.rays()
    inverse_depth = drawing.inverse_depth(rays)
    world = camera.to_world(rays, inverse_depth)
    on_ground = np.take(np.concatenate([[False], facets.on_ground]), drawing.ids)
    material = np.take(np.concatenate([[0], facets.material]), drawing.ids)
    with np.errstate(divide="ignore"):
        depth = 1.0 / inverse_depth
    pixel_m = depth / np.float32(camera.focal)
    window, window_lit = _windows(world, pixel_m, material, drawing, facets, camera)
    texture, patches = _texture(world, on_ground, pixel_m, texture_key)
    return Surface(
        facets=facets,
        camera=camera,
        drawing=drawing,
        rays=rays,
        world=world,
        depth=depth,
        material=material,
        texture=texture,
        patches=patches,
        window=window,
        window_lit=window_lit,
        shadow=shadow * on_ground,
    )


@lru_cache(maxsize=8)
def noise_tile(seed: int) -> Floats:
    """(256, 256) float32 periodic noise, stronger at low frequencies; zero mean, unit variance."""
    white = numpy_generator(seed, "synth/texture/tile").standard_normal((_TILE, _TILE))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(_TILE), np.fft.fftfreq(_TILE))) * _TILE
    shaped = np.fft.ifft2(np.fft.fft2(white) / np.maximum(frequency, 3.0) ** 0.9).real
    return floats((shaped - shaped.mean()) / shaped.std())


def sample_tile(seed: int, s: Floats, t: Floats) -> Floats:
    """The tile at (s, t) in texels, repeated, bilinear."""
    columns, rows = s - _TILE * np.floor(s / _TILE), t - _TILE * np.floor(t / _TILE)
    tile = noise_tile(seed)
    return np.asarray(cv2.remap(tile, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


def _texture(
    world: Floats, on_ground: NDArray[np.bool_], pixel_m: Floats, key: tuple[int, int]
) -> tuple[Floats, Floats]:
    """Fine grain (5 cm) and coarse patches (40 cm) where pixels resolve them; patches alone."""
    seed, index = key
    offset = numpy_generator(seed, "synth/texture", index).random(4).astype(np.float32) * _TILE
    s = np.where(on_ground, world[0], world[0] + world[2])
    t = np.where(on_ground, world[2], world[1])
    fine = sample_tile(seed, s * 20 + offset[0], t * 20 + offset[1])
    coarse = sample_tile(seed, s * 2.5 + offset[2], t * 2.5 + offset[3])
    coarse /= 1.0 + (pixel_m / 0.6) ** 2
    fine /= 1.0 + (pixel_m / 0.08) ** 2
    return 0.75 * fine + 0.65 * coarse, coarse


def _windows(
    world: Floats,
    pixel_HW: Floats,
    material: NDArray[np.intp],
    drawing: Drawing,
    facets: Facets,
    camera: SynthCamera,
) -> tuple[Floats, Floats]:
    """Cover of windows, smooth at their edges, and a number in 0..1 per window."""
    cover, lit = np.zeros(material.size, np.float32), np.ones(material.size, np.float32)
    flat, pixel_m = material.ravel(), pixel_HW.ravel()
    on_wall = np.flatnonzero((flat == _FACADES[0]) | (flat == _FACADES[1]))
    ids = drawing.ids.ravel()[on_wall]
    x, y, z = (axis.ravel()[on_wall] for axis in world)
    style = np.concatenate([np.zeros(1, np.float32), facets.lit])[ids]
    # One of x and z is constant on an axis-parallel wall, so their sum runs along it.
    along, up = (x + z) / (2.2 + 1.6 * style), y / (2.8 + 0.6 * style)
    wide = floats(np.where(style > 0.7, 0.52, 0.30))
    facing = np.abs(drawing.normals @ floats(camera.rotation[2]))[ids]
    blur = pixel_m[on_wall] / np.float32(2.7)
    cover[on_wall] = _band(along, wide, blur / np.maximum(facing, np.float32(0.15)))
    cover[on_wall] *= _band(up, 0.24, blur) * ((style > 0.12) & (up > 0.15))
    number = np.floor(along) * 12.9898 + np.floor(up) * 78.233 + style * 37.719
    lit[on_wall] = np.modf(np.abs(np.sin(number)) * 4375.85)[0]
    return cover.reshape(material.shape), lit.reshape(material.shape)


def _band(position: Floats, half: Floats | float, blur: Floats) -> Floats:
    """1 within `half` of the middle of each unit cell, falling to 0 over `blur`."""
    distance = np.abs(position - np.floor(position) - 0.5)
    return np.asarray(np.clip((half - distance) / np.maximum(blur, 0.02) + 0.5, 0, 1), np.float32)


def shadow_map(
    placed: Sequence[Placed], camera: SynthCamera, light: Light, *, whole: bool = False
) -> Floats:
    """(H, W) float32: how much of the light an object takes from each ground point, 0..1.

    A dark spot below each object, and by day the shadow of its box along the sun's direction.
    `whole` also draws those of which a part lies behind the camera.
    """
    canvas = np.zeros((camera.height, camera.width), np.uint8)
    casting = [thing for thing in placed if thing.shadow_from >= 0 and thing.z < _LAST_SHADOW_M]
    if not casting:
        return canvas.astype(np.float32)
    base, height, start = _footprints(casting)
    per_metre = -light.sun[[0, 2]] / light.sun[1] if light.direct > 0.5 else np.zeros(2, np.float32)
    reach = height[:, None, None] * per_metre
    near_end, far_end = base + reach * start[:, None, None], base + reach
    points = np.insert(np.concatenate([near_end, far_end, base], 1), 1, 0.0, axis=2)
    in_camera = camera.to_camera(points)
    pixels = np.rint(camera.project(in_camera) * 16).astype(np.int32)
    ahead = in_camera[..., 2] > NEAR_M
    if light.direct > 0.5:
        for row in np.flatnonzero(ahead.all(1)).tolist():
            cv2.fillConvexPoly(canvas, cv2.convexHull(pixels[row, :8]), 190, cv2.LINE_8, 4)
        for row in np.flatnonzero(ahead[:, :8].any(1) & ~ahead.all(1) & whole).tolist():
            _fill_beyond(canvas, points[row, :8], camera, 190)
    for row in np.flatnonzero(ahead[:, 8:].all(1)).tolist():
        cv2.fillConvexPoly(canvas, pixels[row, 8:], 230, cv2.LINE_8, 4)
    for row in np.flatnonzero(ahead[:, 8:].any(1) & ~ahead[:, 8:].all(1) & whole).tolist():
        _fill_beyond(canvas, points[row, 8:], camera, 230)
    return np.asarray(cv2.GaussianBlur(canvas, (3, 3), 0.7), np.float32) / 255.0


def _fill_beyond(
    canvas: NDArray[np.uint8], points: Floats, camera: SynthCamera, value: int
) -> None:
    """Fill the part beyond the near plane of the hull of points (M, 3) on the ground."""
    hull = cv2.convexHull(np.ascontiguousarray(points[:, [0, 2]]), returnPoints=False).ravel()
    outline = beyond_near(camera.to_camera(points[None, hull])[0].tolist(), camera)
    cv2.fillConvexPoly(canvas, np.rint(outline * 16).astype(np.int32), value, cv2.LINE_8, 4)


def _footprints(casting: Sequence[Placed]) -> tuple[Floats, Floats, Floats]:
    """Corners (M, 4, 2) of each object's base in (X, Z), its height, the start of its shadow."""
    numbers = np.array(
        [
            (p.x, p.z, p.yaw, p.shape.half_width * p.scale[0], p.shape.half_length * p.scale[2],
             p.shape.height * p.scale[1], p.shadow_from)
            for p in casting
        ],
        np.float32,
    )  # fmt: skip
    x, z, yaw, half_width, half_length, height, start = numbers.T
    sin, cos = np.sin(yaw), np.cos(yaw)
    corners = []
    for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1)):
        across, along = a * half_width, b * np.maximum(half_length, 0.12)
        corners.append(
            np.stack([x + across * cos + along * sin, z - across * sin + along * cos], 1)
        )
    return np.stack(corners, 1), height, start
