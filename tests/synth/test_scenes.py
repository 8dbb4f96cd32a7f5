"""Scenes: shapes, independence of the factors, what the images show, geometry, two frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.randomness import numpy_generator
from rgbt.synth import scene
from rgbt.synth.camera import SynthCamera, camera_of, flow_between
from rgbt.synth.factors import EgoMotion, SceneFactors
from rgbt.synth.light import is_night
from rgbt.synth.objects import place_objects
from rgbt.synth.scene import (
    Scene,
    ScenePair,
    develop_rgb,
    render_pair,
    render_scene,
    squared_radius,
    texture_strength,
)
from rgbt.synth.street import INDEX, Placed, Shape, draw_road, ground_quads
from rgbt.synth.surface import draw, facets_of, sorted_for_drawing

CAR, PERSON, CURVE = 1, 2, 4
FACTORS = SceneFactors()
DAY, NIGHT = replace(FACTORS, night_share=0.0), replace(FACTORS, night_share=1.0)
QUIET = replace(FACTORS, rgb_noise=0.0, thermal_noise=0.0, thermal_drift=0.0)
STILL = SceneFactors(rgb_noise=0.0, texture_strength=0.0)
MOTION = EgoMotion(0.7, 1.0)

Array = np.ndarray[Any, Any]


def images(scene: Scene) -> tuple[bytes, bytes, bytes]:
    return scene.rgb.tobytes(), scene.thermal.tobytes(), scene.label.tobytes()


def quiet(index: int, *, night: bool = False, **changed: Any) -> Scene:
    return render_scene(0, index, replace(QUIET, night_share=float(night), **changed))


# ---- independence of the factors ------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        ({"rgb_noise": 0.1}, ("thermal", "label")),
        ({"rgb_noise_radius_gain": -0.5}, ("thermal", "label")),
        ({"rgb_noise_dark_gain": 0.0}, ("thermal", "label")),
        ({"vignette": 0.0}, ("thermal", "label")),
        ({"thermal_noise": 0.1}, ("rgb", "label")),
        ({"thermal_noise_radius_gain": -0.5}, ("rgb", "label")),
        ({"thermal_contrast": 0.3}, ("rgb", "label")),
        ({"thermal_drift": 0.2}, ("rgb", "label")),
        ({"passive_contrast": 0.0}, ("rgb", "label")),
        ({"texture_strength": 0.0}, ("label",)),
        ({"texture_radius_gain": 2.0}, ("label",)),
        ({"night_share": 1.0}, ("label", "depth")),
    ],
)
def test_factor_changes_its_own_image_only(change: dict, kept: tuple) -> None:
    before, after = render_scene(0, 4, DAY), render_scene(0, 4, replace(DAY, **change))
    for name in ("rgb", "thermal", "label", "depth"):
        same = np.array_equal(getattr(before, name), getattr(after, name))
        assert same if name in kept else name == "depth" or not same, name


def test_more_objects_do_not_move_others() -> None:
    road = draw_road(0, 9, FACTORS)
    few, more, far = (
        place_objects(0, 9, road, replace(FACTORS, num_objects=near, num_far_objects=far))
        for near, far in ((3, 0), (8, 0), (3, 20))
    )
    assert more[: len(few)] == far[: len(few)] == few
    assert len(more) > len(few)
    assert len(far) > len(few) + 10


def test_night_share_flips_scenes_one_by_one() -> None:
    counts = [sum(is_night(0, index, share) for index in range(200)) for share in (0, 0.25, 0.5, 1)]
    assert counts == [0, 50, 100, 200]
    assert all(is_night(0, i, 0.6) for i in range(200) if is_night(0, i, 0.4))


# ---- what is in the images ------------------------------------------------------------------


def test_dark_images_are_noisier() -> None:
    factors = replace(FACTORS, rgb_noise=0.02, rgb_noise_radius_gain=0.0, vignette=0.0)
    stds = []
    for level in (0.2, 0.8):
        grey = np.full((3, 200, 200), level, np.float32)
        noise = develop_rgb(grey, factors, numpy_generator(0, "test")).astype(float)
        stds.append(noise.std())
        assert noise.mean() == pytest.approx(255 * level, abs=0.5)
    assert stds[0] / stds[1] == pytest.approx((1 + 1.5 * 0.8) / (1 + 1.5 * 0.2), rel=0.02)


@pytest.mark.parametrize("gain", [3.0, -0.8])
def test_noise_changes_with_the_squared_radius(gain: float) -> None:
    factors = replace(FACTORS, rgb_noise=0.02, rgb_noise_radius_gain=gain, rgb_noise_dark_gain=0.0)
    grey = np.full((3, 400, 400), 0.5, np.float32)
    noise = develop_rgb(grey.copy(), factors, numpy_generator(0, "test")).astype(float)
    radius = squared_radius(400, 400)
    vignette = 0.5 * (1 - 0.18 * radius) * 255
    for low, high in ((0.0, 0.1), (0.45, 0.55), (0.85, 1.0)):
        ring = (radius >= low) & (radius < high)
        expected = 0.02 * 255 * (1 + gain * radius[ring].mean())
        assert np.std((noise - vignette[..., None])[ring]) == pytest.approx(expected, rel=0.05)


def test_squared_radius_and_texture_by_hand() -> None:
    radius = squared_radius(3, 5)
    assert radius[1, 2] == 0
    assert radius[[0, 0, 2, 2], [0, 4, 0, 4]] == pytest.approx(1)
    assert texture_strength(FACTORS) == 1.0
    changed = replace(FACTORS, texture_strength=2.0, texture_radius_gain=-0.5)
    strength = np.asarray(texture_strength(changed))
    assert (strength[60, 80], strength[0, 0]) == pytest.approx((2.0, 1.0), abs=0.01)


def test_persons_are_warmer_than_street_at_night() -> None:
    gaps, spread = [], []
    for index in range(60):
        found = render_scene(0, index, NIGHT)
        person = (found.label == PERSON) & (found.depth < 15)
        if person.sum() > 60:
            street = (found.label == 0) & (found.depth < 15)
            gaps.append(found.thermal[person].mean() - found.thermal[street].mean())
            spread.append(found.thermal[person].std())
    assert np.mean(gaps) > 30
    assert min(gaps) < 0.5 * np.mean(gaps)  # some are dressed so warmly that they hardly show
    assert np.mean(spread) > 10


def test_night_light_darkens_the_night_alone() -> None:
    assert np.array_equal(quiet(3, night_light=0.1).rgb, quiet(3).rgb)
    dark, lit = quiet(3, night=True, night_light=0.1), quiet(3, night=True)
    assert dark.rgb.mean() < 0.6 * lit.rgb.mean()
    assert np.array_equal(dark.thermal, lit.thermal)


def test_without_passive_contrast_thermal_does_not_show_kerbs() -> None:
    shown = []
    for contrast in (1.0, 0.0):
        degrees = []
        for index in range(12):
            changed = {"passive_contrast": contrast, "texture_strength": 0.0, "kerb_scale": 4.0}
            one = quiet(index, night=True, **changed)
            near = (one.depth < 8) & (one.owner == -1)
            kerb, road = near & (one.label == CURVE), near & (one.material == INDEX["asphalt"])
            if kerb.sum() > 20 and road.any():
                degrees.append(one.grey[kerb].mean() - one.grey[road].mean())
        shown.append(np.mean(np.abs(degrees)))
    assert shown[1] < 0.3 * shown[0]


def test_glare_surrounds_headlights_that_point_at_the_camera() -> None:
    found = 0
    for index in range(24):
        plain, veiled = quiet(index, night=True), quiet(index, night=True, glare=1.0)
        assert np.array_equal(plain.thermal, veiled.thermal)
        lit = [thing for thing in plain.placed if thing.lit and np.cos(thing.yaw) < 0]
        gain = veiled.rgb.astype(int).sum() - plain.rgb.astype(int).sum()
        assert gain >= 0
        assert lit or gain == 0
        found += gain > 0
    assert found >= 3


def test_far_objects_are_small_central_and_scaled() -> None:
    few = {"rail_share": 0.0, "bump_share": 0.0, "kerb_share": 0.0, "num_objects": 0}
    near = {**few, "num_objects": 6, "num_far_objects": 0}
    far, twice, others = (
        np.stack([quiet(index, **changed).label > 0 for index in range(12)])
        for changed in (few, {**few, "far_object_scale": 2.0}, near)
    )
    assert 2.5 < twice.sum() / far.sum() < 4.5  # four times, less what they hide of one another
    assert 0 < far.sum() < 0.35 * others.sum()
    _, rows, columns = np.nonzero(far)
    assert np.hypot(rows - 59.5, columns - 79.5).mean() < 40


@pytest.mark.parametrize(
    ("key", "label"), [("rail_share", 6), ("bump_share", 8), ("kerb_share", 4)]
)
def test_share_of_structures(key: str, label: int) -> None:
    none, all_of_them = (
        [(quiet(index, **{key: share}).label == label).any() for index in range(8)]
        for share in (0.0, 1.0)
    )
    assert (sum(none), sum(all_of_them) > 4) == (0, True)


# ---- geometry -------------------------------------------------------------------------------


def test_label_and_depth_of_a_box_follow_the_camera() -> None:
    # A 2 m wide, 1 m high box whose front is 10 m ahead; focal length 100, horizon in the middle.
    camera = SynthCamera(101, 201, focal=100.0, position=(0.0, 1.5, 0.0), pitch=0.0)
    top = [(-1, 1, 10), (1, 1, 10), (1, 1, 12), (-1, 1, 12)]
    front = [(-1, 0, 10), (1, 0, 10), (1, 1, 10), (-1, 1, 10)]
    meta = (INDEX["paint"], CAR, 0, 1)
    shape = Shape.of("box", [(np.array(face, np.float32), meta) for face in (top, front)])
    facets = facets_of(ground_quads(draw_road(0, 0, FACTORS)), [Placed(shape, 0.0, 0.0)])
    drawing = draw(facets, camera)
    label = np.concatenate([[0], facets.label])[drawing.ids]
    inverse_depth = drawing.inverse_depth(camera.rays())
    # The front stands from row 50 + 100 * 1.5 / 10 = 65 up to 55, columns 100 -+ 10; above it the
    # top is seen up to row 50 + 100 * 0.5 / 12 = 54.2. Outlines belong to the box.
    rows, columns = np.nonzero(label == CAR)
    assert (rows.min(), rows.max()) == (54, 65)
    assert (columns.min(), columns.max()) == (90, 110)
    assert 1 / inverse_depth[60, 100] == pytest.approx(10.0, rel=1e-4)
    # The ground 20 rows below the horizon is 1.5 * 100 / 20 = 7.5 m ahead.
    assert 1 / inverse_depth[70, 150] == pytest.approx(7.5, rel=1e-3)
    # A face that is solid is seen where its normal points at the camera: of these, from behind.
    seen = []
    for way in (1, -1):
        faces = [(np.array(face[::way], np.float32), (*meta[:3], 0)) for face in (top, front)]
        box = Placed(Shape.of("box", faces), 0.0, 0.0)
        made = facets_of(ground_quads(draw_road(0, 0, FACTORS)), [box])
        seen.append((np.concatenate([[0], made.label])[draw(made, camera).ids] == CAR).sum())
    assert sorted(seen) == [0, (label == CAR).sum()]


def test_normals_of_facets_point_at_the_camera() -> None:
    road, camera = draw_road(0, 3, FACTORS), camera_of(FACTORS)
    facets = facets_of(ground_quads(road), place_objects(0, 3, road, FACTORS))
    normals = draw(facets, camera).normals[1:].astype(float)
    first, second, third = facets.corners[:, :3].astype(float).transpose(1, 0, 2)
    for edge in (second - first, third - first):
        edge /= np.linalg.norm(edge, axis=1, keepdims=True)
        assert np.abs((edge * normals).sum(1)).max() < 1e-3
    assert ((np.array(camera.position) - first) * normals).sum(1).min() > -1e-3


def test_far_objects_are_drawn_before_near_ones() -> None:
    placed = sorted_for_drawing(place_objects(0, 2, draw_road(0, 2, FACTORS), FACTORS))
    order = [(thing.layer, -thing.z) for thing in placed]
    assert order == sorted(order)


@pytest.mark.parametrize("pitch", [-3.0, 6.0])
def test_pitch_moves_the_horizon(pitch: float) -> None:
    factors = replace(FACTORS, camera_pitch_deg=pitch, num_objects=0, num_far_objects=0)
    horizon = 59.5 - camera_of(factors).focal * np.tan(np.deg2rad(pitch))
    depth = render_scene(0, 3, factors).depth
    assert np.isfinite(depth[np.arange(120) > horizon + 8]).all()
    assert np.isinf(depth[: int(horizon) - 3]).any()


def test_flow_by_hand() -> None:
    camera = SynthCamera(11, 21, focal=20.0, position=(0.0, 1.5, 0.0), pitch=0.0)
    sky, wall = np.full((11, 21), np.inf, np.float32), np.full((11, 21), 8.0, np.float32)
    assert np.abs(flow_between(sky, camera, camera)).max() < 1e-5
    # A turn to the right by 2 degrees moves the centre 20 tan(2 deg) pixels to the left.
    turned = flow_between(sky, camera, camera.moved(EgoMotion(0.0, 2.0)))
    assert turned[5, 10] == pytest.approx([0.0, -20 * np.tan(np.deg2rad(2.0))], abs=1e-4)
    # From depth 8 to 6 every offset from the centre grows by 8 / 6: (5, 10) becomes (6.67, 13.3).
    ahead = flow_between(wall, camera, camera.moved(EgoMotion(2.0)))
    assert ahead[10, 20] == pytest.approx([5 / 3, 10 / 3], abs=1e-4)


# ---- two frames -----------------------------------------------------------------------------


def warped(values: Array, pair: ScenePair, how: int = cv2.INTER_LINEAR) -> Array:
    rows, columns = np.mgrid[: values.shape[0], : values.shape[1]].astype(np.float32)
    flow = np.nan_to_num(pair.flow, nan=-1e6)
    target = (columns + flow[..., 1], rows + flow[..., 0])
    return np.asarray(cv2.remap(values.astype(np.float32), *target, how))


def inside(pair: ScenePair) -> Array:
    """Pixels that both frames show, two pixels from every border of a surface."""
    number = (pair.second.material * 1000 + pair.second.owner).astype(np.float32)
    square = np.ones((5, 5), np.uint8)
    return pair.visible & (cv2.erode(number, square) == cv2.dilate(number, square))


@pytest.mark.parametrize("motion", [EgoMotion(0.6, 0.0), EgoMotion(0.5, 2.0), EgoMotion(-0.7, -3)])
def test_flow_carries_labels_from_frame_to_frame(motion: EgoMotion) -> None:
    pairs = [render_pair(0, index, FACTORS, motion) for index in range(6)]
    visible = np.stack([p.visible for p in pairs])
    label = np.stack([p.second.label for p in pairs])
    moved = np.stack([warped(p.first.label, p, cv2.INTER_NEAREST) for p in pairs])
    place = np.stack(np.mgrid[:120, :160], -1) + np.stack([p.flow for p in pairs])
    within = ((place >= 0) & (place <= (119, 159))).all(-1)
    assert np.mean((moved == label)[visible]) > 0.97
    # Pixels of objects lie on outlines more often, where the nearest pixel may be the neighbour's.
    assert np.mean((moved == label)[visible & (label > 0)]) > 0.9
    assert np.mean(visible) > 0.75
    assert np.sum(within & ~visible) > 50 * len(pairs)  # behind an object in the first frame


def test_first_frame_of_a_pair_is_the_scene() -> None:
    pair = render_pair(0, 11, FACTORS, EgoMotion(0.0))
    assert images(pair.first) == images(render_scene(0, 11, FACTORS))
    assert images(render_scene(0, 8, FACTORS))[2] != images(pair.first)[2]
    assert images(render_scene(1, 11, FACTORS))[2] != images(pair.first)[2]
    assert np.array_equal(pair.second.label, pair.first.label)
    assert not np.array_equal(pair.second.rgb, pair.first.rgb)  # the noise is another one
    assert np.abs(pair.flow).max() < 1e-3
    assert pair.visible.all()


def test_whole_shadows_stay_on_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scene 52 by day: a shadow with a corner behind the camera covered most of the street."""
    seen: list[Array] = []
    made = scene.surface_of

    def keep(*arguments: Any) -> Any:
        seen.append(made(*arguments).shadow)
        return made(*arguments)

    monkeypatch.setattr(scene, "surface_of", keep)
    lost = {}
    for whole in (False, True):
        seen.clear()
        pair = render_pair(0, 52, replace(STILL, whole_shadows=whole), MOTION)
        first, second = seen
        lost[whole] = float((warped(first, pair) - second > 0.5)[inside(pair)].mean())
    assert lost[False] > 0.2
    assert lost[True] == 0.0
