"""Draw the flat parts of a scene into a map of their numbers, and what follows for each pixel.

The map has twice the image size. Labels and depth are read at pixel centres, so they are exact;
colours are averaged around them (`average`), so edges are smooth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.randomness import numpy_generator
from rgbt.synth.camera import NEAR_M, Floats, Key, SynthCamera, floats
from rgbt.synth.light import Light
from rgbt.synth.street import COLOURS, INDEX, MAX_CORNERS, Placed, Quads

# Facets are drawn at this multiple of the image size, with so many binary digits.
SCALE, _SHIFT = 2, 4

# Facets with a smaller projected extent, in pixels, are left out.
_SMALLEST = 0.8

_TILE, _LAST_SHADOW_M = 256, 45.0
_FACADES = [INDEX["facade"], INDEX["facade_side"]]


@dataclass(frozen=True)
class Facets:
    """Holds N facets, far to near: (N,) each, corners (N, 8, 3) world points, colour (N, 3).

    `warmth` and `lit` are as in `Placed`; what is `on_ground` lies flat and receives shadows;
    `owner` is the number of the object, -1 the ground.
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
    """Sort by layer, and within a layer the farthest first (painter's algorithm)."""
    return sorted(placed, key=lambda thing: (thing.layer, -thing.z))


def facets_of(ground: Quads, placed: Sequence[Placed]) -> Facets:
    """Join the ground's quads and the parts of `placed`, one or more, in the order given."""
    shapes = [thing.shape for thing in placed]
    owner = np.repeat(np.arange(len(placed)), [len(shape.meta) for shape in shapes])
    # One table of numbers per object: many small arrays would cost more than all the arithmetic.
    columns = [
        (p.x, p.y, p.z, p.yaw, p.warmth, p.lit, *p.scale, *p.paints[0], *p.paints[1])
        for p in placed
    ]
    numbers = floats(columns)[owner]
    meta = np.concatenate([shape.meta for shape in shapes])
    corners = _in_world(np.concatenate([shape.corners for shape in shapes]), numbers)
    painted = np.where(meta[:, 2:3] == 2, numbers[:, 12:15], numbers[:, 9:12])
    colour = np.where(meta[:, 2:3] > 0, painted, COLOURS[meta[:, 0]])

    (corners_of_ground, material, label), join = ground, np.concatenate
    number = len(material)
    no_heat = np.zeros(number, np.float32)
    return Facets(
        corners=join([corners_of_ground, corners]),
        num_corners=join([np.full(number, MAX_CORNERS), *(s.num_corners for s in shapes)]),
        material=join([material, meta[:, 0]]),
        label=join([label, meta[:, 1]]),
        thin=join([np.ones(number, bool), meta[:, 3] > 0]),
        colour=join([COLOURS[material], colour]),
        warmth=join([no_heat, numbers[:, 4]]),
        lit=join([no_heat, numbers[:, 5]]),
        on_ground=np.arange(number + len(meta)) < number,
        owner=join([np.full(number, -1), owner]),
    )


def _in_world(local: Floats, numbers: Floats) -> Floats:
    """Scale corners, turn them about the upright axis and move them to where an object stands."""
    x, y, z, yaw = numbers[:, :4].T[:, :, None]
    scaled = local * numbers[:, None, 6:9]
    sin, cos = np.sin(yaw), np.cos(yaw)
    turned = np.empty_like(scaled)
    turned[..., 0] = scaled[..., 0] * cos + scaled[..., 2] * sin + x
    turned[..., 1] = scaled[..., 1] + y
    turned[..., 2] = scaled[..., 2] * cos - scaled[..., 0] * sin + z
    return turned


@dataclass(frozen=True)
class Drawing:
    """Says what the camera sees, by numbers of facets; 0 is the sky, n + 1 is facet n.

    Attributes:
        fine: (2H, 2W); the entry (2i, 2j) lies at the centre of pixel (i, j).
        ids: (H, W), the entries at pixel centres.
        planes: (N + 1, 3); inverse depth of a pixel is ``planes[id] @ ray``.
        bounds: (N + 1, 2), smallest and largest inverse depth of each facet's corners.
        normals: (N + 1, 3) unit normals in world coordinates, towards the camera.
    """

    fine: NDArray[np.intp]
    ids: NDArray[np.intp]
    planes: Floats
    bounds: Floats
    normals: Floats

    def inverse_depth(self, rays_3HW: Floats) -> Floats:
        """Return 1 / metres along the optical axis, (H, W) float32, 0 for the sky."""
        total = np.zeros(self.ids.shape, np.float32)
        for plane, ray in zip(np.ascontiguousarray(self.planes.T), rays_3HW, strict=True):
            total += np.take(plane, self.ids) * ray
        # Outlines are up to half a pixel wide: there the plane of a grazing facet would run away.
        low, high = np.ascontiguousarray(self.bounds.T)
        return np.clip(total, np.take(low, self.ids), np.take(high, self.ids))


def draw(facets: Facets, camera: SynthCamera) -> Drawing:
    """Draw facets in their order, later ones over earlier ones."""
    corners = camera.to_camera(facets.corners)
    # In double precision: the terrain is a plane through corners kilometres away.
    three = camera.to_camera(facets.corners[:, :3].astype(np.float64))
    first, second, third = three.transpose(1, 0, 2)
    normals = _cross(second - first, third - first)
    offset = (normals * first).sum(1)
    # y runs down in camera coordinates, which mirrors the world: outward normals point inwards.
    seen = (offset > 1e-9) | (facets.thin & (offset < -1e-9))
    ids = _paint(corners, facets.num_corners, seen, camera).astype(np.intp)
    planes = normals / np.where(offset == 0, 1, offset)[:, None]
    length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    towards = -np.sign(offset)[:, None] * normals / length[:, None]
    depth = corners[..., 2].T
    bounds = 1.0 / np.maximum(np.stack([depth.max(0), depth.min(0)], 1), NEAR_M)
    sky = np.zeros((1, 3), np.float32)
    return Drawing(
        fine=ids,
        ids=np.ascontiguousarray(ids[::SCALE, ::SCALE]),
        planes=np.concatenate([sky, planes.astype(np.float32)]),
        bounds=np.concatenate([sky[:, :2], bounds.astype(np.float32)]),
        normals=np.concatenate([sky, (towards @ camera.rotation).astype(np.float32)]),
    )


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply row by row; np.cross takes ten times as long on arrays of this size."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def average(values_N4: NDArray[np.uint8], drawing: Drawing) -> NDArray[np.uint8]:
    """Average four values per facet around each pixel (binomial weights, 0.5 pixels wide).

    From (N + 1, 4) uint8, row 0 for the sky, to (H, W, 4) uint8.
    """
    packed = np.ascontiguousarray(values_N4).view(np.uint32)[:, 0]
    fine = np.take(packed, drawing.fine, mode="clip").view(np.uint8)
    return np.asarray(cv2.pyrDown(fine.reshape(*drawing.fine.shape, 4)), np.uint8)


def _paint(
    corners: Floats, num_corners: NDArray[np.intp], seen: NDArray[np.bool_], camera: SynthCamera
) -> NDArray[np.uint16]:
    numbers = np.flatnonzero(seen)
    # Corners first: the reductions over them are several times faster along the first axis.
    by_corner = np.ascontiguousarray(corners[numbers].transpose(1, 0, 2))
    columns_rows = camera.project(by_corner)
    low, high = columns_rows.min(0), columns_rows.max(0)
    nearest, farthest = by_corner[..., 2].min(0), by_corner[..., 2].max(0)
    crosses = nearest < NEAR_M
    size = (camera.width, camera.height)
    inside = (high >= 0).all(1) & (low < size).all(1) & ((high - low).max(1) > _SMALLEST)
    drawn = np.flatnonzero((inside | crosses) & (farthest > NEAR_M))

    points = np.ascontiguousarray(_fixed_point(columns_rows[:, drawn]).transpose(1, 0, 2))
    counts = num_corners[numbers[drawn]].tolist()
    fine = np.zeros((camera.height * SCALE, camera.width * SCALE), np.uint16)
    polygons = [points[row, :count] for row, count in enumerate(counts)]
    for row in np.flatnonzero(crosses[drawn]).tolist():
        corners_of = by_corner[: counts[row], drawn[row]].tolist()
        polygons[row] = _fixed_point(_beyond_near(corners_of, camera))
    for number, polygon in zip(numbers[drawn].tolist(), polygons, strict=True):
        cv2.fillConvexPoly(fine, polygon, number + 1, cv2.LINE_8, _SHIFT)
    return fine


def _fixed_point(columns_rows: Floats) -> NDArray[np.int32]:
    limit = 2**26
    return np.clip(np.rint(columns_rows * (SCALE << _SHIFT)), -limit, limit).astype(np.int32)


def _beyond_near(polygon: list[list[float]], camera: SynthCamera) -> Floats:
    """Cut a polygon at the near plane (Sutherland-Hodgman): (M, 2) as (column, row)."""
    kept = []
    for start, end in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        if start[2] >= NEAR_M:
            kept.append(start)
        if (start[2] >= NEAR_M) != (end[2] >= NEAR_M):
            share = (NEAR_M - start[2]) / (end[2] - start[2])
            kept.append([a + share * (b - a) for a, b in zip(start, end, strict=True)])
    return camera.project(np.array(kept, np.float32))


@dataclass(frozen=True)
class Surface:
    """Holds maps (H, W) of one frame.

    Attributes:
        rays: (3, H, W) in camera coordinates; `world`: (3, H, W), metres.
        depth: metres along the optical axis; infinity for the sky.
        texture: zero mean, about unit variance near the camera.
        patches: its coarse part: heat spreads, so its fine grain is not seen.
        window: share of the pixel that is a window.
        window_lit: 0..1, draw of the window: lit where below the share of lit ones.
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
    drawing: Drawing, facets: Facets, camera: SynthCamera, shadow: Floats, key: Key
) -> Surface:
    """Compute surface maps of one frame; `shadow` is (H, W) of `shadow_map`."""
    rays = camera.rays()
    inverse_depth = drawing.inverse_depth(rays)
    world = camera.to_world(rays, inverse_depth)
    on_ground = np.take(np.concatenate([[False], facets.on_ground]), drawing.ids)
    material = np.take(np.concatenate([[0], facets.material]), drawing.ids)
    with np.errstate(divide="ignore"):
        depth = 1.0 / inverse_depth
    pixel_m = depth / np.float32(camera.focal)
    window, window_lit = _windows(world, pixel_m, material, drawing, facets, camera)
    texture, patches = _texture(world, on_ground, pixel_m, key)
    maps = (rays, world, depth, material, texture, patches, window, window_lit)
    return Surface(facets, camera, drawing, *maps, shadow * on_ground)


@lru_cache(maxsize=8)
def noise_tile(seed: int) -> Floats:
    """Make periodic noise (256, 256), stronger at low frequencies; mean 0, variance 1."""
    white = numpy_generator(seed, "synth/texture/tile").standard_normal((_TILE, _TILE))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(_TILE), np.fft.fftfreq(_TILE))) * _TILE
    shaped = np.fft.ifft2(np.fft.fft2(white) / np.maximum(frequency, 3.0) ** 0.9).real
    return floats((shaped - shaped.mean()) / shaped.std())


def sample_tile(seed: int, s: Floats, t: Floats) -> Floats:
    """Read the tile at (s, t) in texels, repeated, bilinear."""
    columns, rows = s - _TILE * np.floor(s / _TILE), t - _TILE * np.floor(t / _TILE)
    tile = noise_tile(seed)
    return np.asarray(cv2.remap(tile, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


def _texture(
    world: Floats, on_ground: NDArray[np.bool_], pixel_m: Floats, key: Key
) -> tuple[Floats, Floats]:
    """Return fine grain (5 cm) with coarse patches (40 cm) where resolved, and patches alone."""
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
    """Return the cover of windows, smooth at their edges, and a number in 0..1 per window."""
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
    """Return 1 within `half` of the middle of each unit cell, falling to 0 over `blur`."""
    distance = np.abs(position - np.floor(position) - 0.5)
    return np.asarray(np.clip((half - distance) / np.maximum(blur, 0.02) + 0.5, 0, 1), np.float32)


def shadow_map(
    placed: Sequence[Placed], camera: SynthCamera, light: Light, *, whole: bool = False
) -> Floats:
    """Compute how much of the light an object takes from each ground point, (H, W) in 0..1.

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

    def fill(part: slice, value: int, shown: Any) -> None:
        for row in np.flatnonzero(shown).tolist():
            outline = pixels[row, part]
            outline = cv2.convexHull(outline) if len(outline) > 4 else outline
            cv2.fillConvexPoly(canvas, outline, value, cv2.LINE_8, 4)
        for row in np.flatnonzero(ahead[:, part].any(1) & ~shown & whole).tolist():
            on_ground = np.ascontiguousarray(points[row, part][:, [0, 2]])
            hull = points[row, part][cv2.convexHull(on_ground, returnPoints=False).ravel()]
            outline = np.rint(_beyond_near(camera.to_camera(hull).tolist(), camera) * 16)
            cv2.fillConvexPoly(canvas, outline.astype(np.int32), value, cv2.LINE_8, 4)

    if light.direct > 0.5:
        fill(slice(0, 8), 190, ahead.all(1))
    fill(slice(8, 12), 230, ahead[:, 8:].all(1))
    return np.asarray(cv2.GaussianBlur(canvas, (3, 3), 0.7), np.float32) / 255.0


def _footprints(casting: Sequence[Placed]) -> tuple[Floats, Floats, Floats]:
    """Return corners (M, 4, 2) of bases in (X, Z), heights, and starts of shadows."""
    x, z, yaw, start = floats([(p.x, p.z, p.yaw, p.shadow_from) for p in casting]).T
    sizes = [(p.shape.half_width, p.shape.height, p.shape.half_length) for p in casting]
    scales = np.array([p.scale for p in casting])
    half_width, height, half_length = (np.array(sizes) * scales).astype(np.float32).T
    sin, cos = np.sin(yaw), np.cos(yaw)
    corners = np.empty((len(casting), 4, 2), np.float32)
    for number, (a, b) in enumerate(((-1, -1), (-1, 1), (1, 1), (1, -1))):
        across, along = a * half_width, b * np.maximum(half_length, 0.12)
        corners[:, number, 0] = x + across * cos + along * sin
        corners[:, number, 1] = z - across * sin + along * cos
    return corners, height, start
