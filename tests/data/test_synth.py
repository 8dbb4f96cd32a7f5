from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt.data.synth import scene, sheet
from rgbt.data.synth.camera import SynthCamera, camera_of, flow_between
from rgbt.data.synth.facets import sorted_for_drawing
from rgbt.data.synth.factors import EgoMotion, SceneFactors
from rgbt.data.synth.layout import place_objects
from rgbt.data.synth.light import is_night
from rgbt.data.synth.materials import MATERIALS
from rgbt.data.synth.raster import draw
from rgbt.data.synth.rgb import develop, squared_radius
from rgbt.data.synth.road import draw_road
from rgbt.data.synth.scene import Scene, render_pair, render_scene
from rgbt.data.synth.shapes import CAR, PERSON, box, shape_of
from rgbt.randomness import numpy_generator
from tests.commands import code_of

FACTORS = SceneFactors()
DAY, NIGHT = replace(FACTORS, night_share=0.0), replace(FACTORS, night_share=1.0)


def images(scene: Scene) -> tuple[bytes, bytes, bytes]:
    return scene.rgb.tobytes(), scene.thermal.tobytes(), scene.label.tobytes()


# ---- scenes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("hw", [(120, 160), (60, 80), (97, 131)])
def test_shapes_and_ranges(hw: tuple[int, int]) -> None:
    scene = render_scene(0, 5, replace(FACTORS, height=hw[0], width=hw[1]))
    assert scene.rgb.shape == (*hw, 3)
    assert scene.thermal.shape == scene.label.shape == scene.depth.shape == hw
    assert scene.rgb.dtype == scene.thermal.dtype == scene.label.dtype == np.uint8
    assert scene.label.max() <= 8
    assert scene.depth.min() > 0
    assert np.isinf(scene.depth[:5]).any()


def test_same_arguments_give_same_bytes() -> None:
    first = images(render_scene(0, 7, FACTORS))
    render_scene(1, 2, FACTORS)
    assert images(render_scene(0, 7, FACTORS)) == first
    assert images(render_scene(0, 8, FACTORS))[2] != first[2]
    assert images(render_scene(1, 7, FACTORS))[2] != first[2]


def test_every_class_is_frequent_and_large() -> None:
    pixels, shown, large = np.zeros(9), np.zeros(9), np.zeros(9)
    for index in range(100):
        counts = np.bincount(render_scene(0, index, FACTORS).label.ravel(), minlength=9)
        pixels, shown, large = pixels + counts, shown + (counts > 0), large + (counts > 60)
    assert 0.75 < pixels[0] / pixels.sum() < 0.9
    assert (shown / 100 >= 0.35).all()
    assert (large / 100 >= 0.35).all()


# ---- independence of the factors ------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        ({"rgb_noise": 0.1}, ("thermal", "label")),
        ({"rgb_noise_radius_gain": 4.0}, ("thermal", "label")),
        ({"rgb_noise_dark_gain": 0.0}, ("thermal", "label")),
        ({"thermal_noise": 0.1}, ("rgb", "label")),
        ({"thermal_contrast": 0.3}, ("rgb", "label")),
        ({"thermal_drift": 0.2}, ("rgb", "label")),
        ({"texture_strength": 0.0}, ("label",)),
        ({"night_share": 1.0}, ("label", "depth")),
        ({"rgb_noise_radius_gain": -0.5}, ("thermal", "label")),
        ({"thermal_noise_radius_gain": -0.5}, ("rgb", "label")),
        ({"rgb_blur": 1.0}, ("thermal", "label")),
        ({"texture_radius_gain": 2.0}, ("label",)),
        ({"passive_contrast": 0.0}, ("rgb", "label")),
    ],
)
def test_factor_changes_its_own_image_only(change: dict, kept: tuple) -> None:
    before, after = render_scene(0, 4, DAY), render_scene(0, 4, replace(DAY, **change))
    for name in ("rgb", "thermal", "label", "depth"):
        same = np.array_equal(getattr(before, name), getattr(after, name))
        if name in kept:
            assert same, name
        elif name in ("rgb", "thermal"):
            assert not same, name


def test_more_objects_do_not_move_others() -> None:
    road = draw_road(0, 9, FACTORS)
    few = place_objects(0, 9, road, replace(FACTORS, num_objects=3, num_far_objects=0))
    more = place_objects(0, 9, road, replace(FACTORS, num_objects=8, num_far_objects=0))
    assert more[: len(few)] == few
    assert len(more) > len(few)
    far = place_objects(0, 9, road, replace(FACTORS, num_objects=3, num_far_objects=20))
    assert far[: len(few)] == few
    assert len(far) > len(few) + 10


def test_night_share_flips_scenes_one_by_one() -> None:
    counts = [sum(is_night(0, index, share) for index in range(200)) for share in (0, 0.25, 0.5, 1)]
    assert counts == [0, 50, 100, 200]
    assert all(is_night(0, i, 0.6) for i in range(200) if is_night(0, i, 0.4))


# ---- what is in the images ------------------------------------------------------------------


def test_night_is_darker_than_day_and_noisier() -> None:
    quiet = {"rgb_noise_radius_gain": 0.0, "rgb_noise": 0.02}
    noise = {}
    for name, factors in (("day", DAY), ("night", NIGHT)):
        clean = [render_scene(0, i, replace(factors, rgb_noise=0.0)).rgb for i in range(6)]
        noisy = [render_scene(0, i, replace(factors, **quiet)).rgb for i in range(6)]
        middle = [(c > 40) & (c < 215) for c in clean]
        noise[name] = np.concatenate(
            [(n.astype(float) - c)[m] for n, c, m in zip(noisy, clean, middle, strict=True)]
        ).std()
        noise[f"{name} mean"] = np.mean(clean)
    assert noise["night mean"] < 0.75 * noise["day mean"]
    assert noise["night"] > 1.1 * noise["day"]


def test_noise_grows_with_the_squared_radius() -> None:
    factors = replace(FACTORS, rgb_noise=0.02, rgb_noise_radius_gain=3.0, rgb_noise_dark_gain=0.0)
    grey = np.full((3, 400, 400), 0.5, np.float32)
    noise = develop(grey.copy(), factors, numpy_generator(0, "test")).astype(float)
    radius = squared_radius(400, 400)
    vignette = 0.5 * (1 - 0.18 * radius) * 255
    for low, high in ((0.0, 0.1), (0.45, 0.55), (0.85, 1.0)):
        ring = (radius >= low) & (radius < high)
        expected = 0.02 * 255 * (1 + 3 * radius[ring].mean())
        assert np.std((noise - vignette[..., None])[ring]) == pytest.approx(expected, rel=0.03)


def test_squared_radius_is_normalised() -> None:
    radius = squared_radius(3, 5)
    assert radius[1, 2] == 0
    assert radius[[0, 0, 2, 2], [0, 4, 0, 4]] == pytest.approx(1)


def test_far_objects_are_small_and_central() -> None:
    shares, offsets = [], []
    for index in range(12):
        near = render_scene(0, index, replace(FACTORS, num_objects=6, num_far_objects=0)).label
        far = render_scene(0, index, replace(FACTORS, num_objects=0, num_far_objects=16)).label
        none = render_scene(0, index, replace(FACTORS, num_objects=0, num_far_objects=0)).label
        rows, columns = np.nonzero((far != none) & (far > 0))
        shares.append((len(rows), ((near != none) & (near > 0)).sum()))
        offsets.append(np.hypot(rows - 59.5, columns - 79.5))
    far_pixels, near_pixels = np.sum(shares, axis=0)
    assert 0 < far_pixels < 0.35 * near_pixels
    assert np.mean(np.concatenate(offsets)) < 25


def test_persons_are_warmer_than_street_at_night() -> None:
    gaps, spread = [], []
    for index in range(60):
        scene = render_scene(0, index, NIGHT)
        person = (scene.label == PERSON) & (scene.depth < 15)
        if person.sum() > 60:
            street = (scene.label == 0) & (scene.depth < 15)
            gaps.append(scene.thermal[person].mean() - scene.thermal[street].mean())
            spread.append(scene.thermal[person].std())
    assert np.mean(gaps) > 30
    assert min(gaps) < 0.5 * np.mean(gaps)  # some are dressed so warmly that they hardly show
    assert np.mean(spread) > 10


def test_thermal_contrast_zero_is_flat() -> None:
    flat = replace(FACTORS, thermal_contrast=0.0, thermal_noise=0.0, thermal_drift=0.0)
    assert np.ptp(render_scene(0, 0, flat).thermal) == 0


# ---- geometry -------------------------------------------------------------------------------


def test_label_and_depth_of_box_follow_camera() -> None:
    # A 2 m wide, 1 m high box whose front is 10 m ahead; focal length 100, horizon in the middle.
    camera = SynthCamera(101, 201, focal=100.0, position=(0.0, 1.5, 0.0), pitch=0.0)
    shape = shape_of(box((-1.0, 0.0, 10.0), (1.0, 1.0, 12.0), "paint", CAR))
    ground = scene.ground_quads(draw_road(0, 0, FACTORS))
    placed = [scene.Placed(shape, 0.0, 0.0)]
    facets = scene.facets_of(ground, placed)
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


def test_near_objects_hide_far_ones() -> None:
    road = draw_road(0, 2, FACTORS)
    placed = sorted_for_drawing(place_objects(0, 2, road, FACTORS))
    order = [(thing.layer, -thing.z) for thing in placed]
    assert order == sorted(order)


@pytest.mark.parametrize("pitch", [-3.0, 0.0, 6.0])
def test_pitch_moves_the_horizon(pitch: float) -> None:
    factors = replace(FACTORS, camera_pitch_deg=pitch, num_objects=0, num_far_objects=0)
    camera = camera_of(factors)
    horizon = 59.5 - camera.focal * np.tan(np.deg2rad(pitch))
    depth = render_scene(0, 3, factors).depth
    on_ground = np.arange(120) > horizon + 8
    assert np.isfinite(depth[on_ground]).all()
    assert np.isinf(depth[: int(horizon) - 3]).any()


def test_flow_of_still_and_of_turning_camera() -> None:
    camera = SynthCamera(11, 21, focal=20.0, position=(0.0, 1.5, 0.0), pitch=0.0)
    depth = np.full((11, 21), np.inf, np.float32)
    assert np.abs(flow_between(depth, camera, camera)).max() < 1e-5
    turned = camera.moved(EgoMotion(0.0, 2.0))
    flow = flow_between(depth, camera, turned)
    # A turn to the right by 2 degrees moves the centre 20 tan(2 deg) pixels to the left.
    assert flow[5, 10] == pytest.approx([0.0, -20 * np.tan(np.deg2rad(2.0))], abs=1e-4)


def test_flow_of_a_forward_motion_by_hand() -> None:
    camera = SynthCamera(11, 21, focal=20.0, position=(0.0, 1.5, 0.0), pitch=0.0)
    flow = flow_between(np.full((11, 21), 8.0, np.float32), camera, camera.moved(EgoMotion(2.0)))
    # From depth 8 to 6 every offset from the centre grows by 8 / 6: (5, 10) becomes (6.67, 13.3).
    assert flow[10, 20] == pytest.approx([5 / 3, 10 / 3], abs=1e-4)
    assert flow[5, 10] == pytest.approx([0, 0], abs=1e-5)


def test_flow_needs_equal_cameras() -> None:
    camera = camera_of(FACTORS)
    with pytest.raises(ValueError, match="same"):
        flow_between(np.ones((120, 160), np.float32), camera, replace(camera, focal=1.0))


def ground_homography(source: SynthCamera, target: SynthCamera) -> np.ndarray:
    """``K' (R' R^T + R' (C - C') n^T / d) K^-1``, n the downward normal and d the height."""
    first, second = (
        np.array([[each.focal, 0, each.centre[0]], [0, each.focal, each.centre[1]], [0, 0, 1.0]])
        for each in (source, target)
    )
    shift = target.rotation @ (np.asarray(source.position) - np.asarray(target.position))
    plane = np.outer(shift, source.rotation @ [0.0, -1.0, 0.0]) / source.position[1]
    return second @ (target.rotation @ source.rotation.T + plane) @ np.linalg.inv(first)


def test_ground_homography_agrees_with_flow() -> None:
    motion = EgoMotion(0.9, 2.0)
    pair = render_pair(0, 6, replace(FACTORS, num_objects=0, num_far_objects=0), motion)
    homography = ground_homography(pair.second.camera, pair.first.camera)
    ground = pair.second.depth[110, 60:100]
    height = pair.second.camera.position[1]
    rays = pair.second.camera.rays()[:, 110, 60:100]
    down = -(pair.second.camera.turned(rays[:, None])[1, 0]) * ground
    on_ground = np.abs(down - height) < 0.01
    assert on_ground.sum() > 20
    points = np.stack([np.arange(60, 100), np.full(40, 110), np.ones(40)])
    mapped = homography @ points
    expected = (mapped[:2] / mapped[2] - points[:2]).T[:, ::-1]
    assert pair.flow[110, 60:100][on_ground] == pytest.approx(expected[on_ground], abs=0.02)


@pytest.mark.parametrize("motion", [EgoMotion(0.6, 0.0), EgoMotion(0.5, 2.0), EgoMotion(-0.7, -3)])
def test_flow_carries_labels_from_frame_to_frame(motion: EgoMotion) -> None:
    agree, labelled, visible = [], [], []
    for index in range(8):
        pair = render_pair(0, index, FACTORS, motion)
        rows, columns = np.mgrid[:120, :160].astype(np.float32)
        target = (columns + pair.flow[..., 1], rows + pair.flow[..., 0])
        warped = cv2.remap(pair.first.label, *target, cv2.INTER_NEAREST)
        agree.append((warped == pair.second.label)[pair.visible])
        labelled.append(agree[-1][pair.second.label[pair.visible] > 0])
        visible.append(pair.visible.mean())
    assert np.mean(np.concatenate(agree)) > 0.97
    # Pixels of objects lie on outlines more often, where the nearest pixel may be the neighbour's.
    assert np.mean(np.concatenate(labelled)) > 0.9
    assert np.mean(visible) > 0.75


def test_first_frame_of_pair_equals_scene() -> None:
    pair = render_pair(0, 11, FACTORS, EgoMotion(0.0))
    assert images(pair.first) == images(render_scene(0, 11, FACTORS))
    assert np.array_equal(pair.second.label, pair.first.label)
    assert not np.array_equal(pair.second.rgb, pair.first.rgb)  # the noise is another one
    assert np.abs(pair.flow).max() < 1e-3
    assert pair.visible.all()


def test_texture_moves_with_the_ground() -> None:
    still = replace(DAY, rgb_noise=0.0, num_objects=0, num_far_objects=0)
    pair = render_pair(0, 1, still, EgoMotion(0.5))
    rows, columns = np.mgrid[:120, :160].astype(np.float32)
    target = (columns + pair.flow[..., 1], rows + pair.flow[..., 0])
    warped = cv2.remap(pair.first.rgb, *target, cv2.INTER_LINEAR).astype(float)
    below = pair.visible & (rows > 75)
    apart = np.abs(warped - pair.second.rgb)[below].mean()
    unmoved = np.abs(pair.first.rgb.astype(float) - pair.second.rgb)[below].mean()
    assert apart < 0.6 * unmoved


def test_materials_start_with_the_sky() -> None:
    assert next(iter(MATERIALS)) == "sky"


# ---- contact sheet --------------------------------------------------------------------------


def test_the_sheet_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sheet.png"
    assert code_of(sheet.entry, [f"out={out}", "columns=2", "zoom=1", "height=48", "width=64"]) == 0
    assert cv2.imread(str(out)).shape == (6 * 48, 2 * 64, 3)
    assert capsys.readouterr().out.strip() == str(out)


@pytest.mark.parametrize("argument", ["rgb_nois=1", "rgb_noise=much", "night_share=3"])
def test_the_sheet_names_a_mistake(argument: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(sheet.entry, [argument]) == 2
    assert argument.split("=")[0] in capsys.readouterr().err
