"""The factors of calibrated scenes, and the maps of the scenes that the data set writes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.synth.calibrated import SceneDataset, synth_calibrated
from rgbt.data.synth.factors import NEUTRAL, SceneFactors
from rgbt.data.synth.glare import veil_of
from rgbt.data.synth.materials import INDEX
from rgbt.data.synth.rgb import blurred, develop, squared_radius, texture_strength
from rgbt.data.synth.scene import Scene, render_scene
from rgbt.data.synth.shapes import CURVE
from rgbt.randomness import numpy_generator

FACTORS = SceneFactors()
QUIET = replace(FACTORS, rgb_noise=0.0, thermal_noise=0.0, thermal_drift=0.0)


def scene(index: int, *, night: bool = False, **changed: object) -> Scene:
    factors = replace(QUIET, night_share=float(night), **changed)  # type: ignore[arg-type]
    return render_scene(0, index, factors)


def test_neutral_factors_leave_the_name_of_a_written_data_set() -> None:
    assert set(FACTORS.values()).isdisjoint(NEUTRAL)
    assert {"seed"} | set(replace(FACTORS, glare=0.5).values()) == {
        *("seed", "glare"),
        *FACTORS.values(),
    }


def test_noise_grows_towards_the_centre() -> None:
    factors = replace(FACTORS, rgb_noise=0.05, rgb_noise_radius_gain=-0.8, rgb_noise_dark_gain=0.0)
    grey = np.full((3, 300, 400), 0.5, np.float32)
    noise = develop(grey.copy(), factors, numpy_generator(0, "test")).astype(float)
    radius = squared_radius(300, 400)
    vignette = 0.5 * (1 - 0.18 * radius) * 255
    for low, high in ((0.0, 0.1), (0.45, 0.55), (0.85, 1.0)):
        ring = (radius >= low) & (radius < high)
        expected = 0.05 * 255 * (1 - 0.8 * radius[ring].mean())
        assert np.std((noise - vignette[..., None])[ring]) == pytest.approx(expected, rel=0.05)


def test_blur_has_the_variance_of_its_factor() -> None:
    """The spread of a point, by hand: sd (1 + gain r^2) at its place."""
    for gain, row, column in ((0.0, 60, 80), (-0.5, 60, 80), (-0.5, 20, 30), (3.0, 20, 30)):
        point = np.zeros((3, 120, 160), np.float32)
        point[:, row, column] = 1.0
        # The mix of each pixel belongs to the pixel, so the mix is held at that of the point.
        radius = squared_radius(120, 160)[row, column]
        soft = blurred(point, 2.0, gain)[0]
        rows = np.arange(120)[:, None] - row
        variance = (soft * rows**2).sum() / soft.sum()
        expected = (2.0 * (1 + gain * radius)) ** 2
        assert variance == pytest.approx(expected, rel=0.12), (gain, row, column)
    sharp = np.random.default_rng(0).random((3, 12, 16)).astype(np.float32)
    assert blurred(sharp, 0.0, 5.0) is sharp


def test_texture_by_radius() -> None:
    assert texture_strength(FACTORS) == 1.0
    strength = np.asarray(
        texture_strength(replace(FACTORS, texture_strength=2.0, texture_radius_gain=-0.5))
    )
    assert strength[60, 80] == pytest.approx(2.0, abs=0.01)
    assert strength[0, 0] == pytest.approx(1.0)


def test_night_light_darkens_the_night_alone() -> None:
    assert np.array_equal(scene(3, night_light=0.1).rgb, scene(3).rgb)
    dark, lit = scene(3, night=True, night_light=0.1), scene(3, night=True)
    assert dark.rgb.mean() < 0.6 * lit.rgb.mean()
    assert np.array_equal(dark.thermal, lit.thermal)


def test_without_passive_contrast_thermal_does_not_show_markings_and_kerbs() -> None:
    """Between a kerb and the asphalt beside it, away from their border."""
    shown = []
    for contrast in (1.0, 0.0):
        degrees = []
        for index in range(12):
            one = scene(
                index, night=True, passive_contrast=contrast, texture_strength=0.0, kerb_scale=4.0
            )
            near = (one.depth < 8) & (one.owner == -1)
            kerb = near & (one.label == CURVE)
            road = near & (one.material == INDEX["asphalt"])
            if kerb.sum() > 20 and road.any():
                degrees.append(one.grey[kerb].mean() - one.grey[road].mean())
        shown.append(np.mean(np.abs(degrees)))
    assert shown[1] < 0.3 * shown[0]


def test_glare_surrounds_headlights_that_point_at_the_camera() -> None:
    found = 0
    for index in range(40):
        plain, veiled = scene(index, night=True), scene(index, night=True, glare=1.0)
        assert np.array_equal(plain.thermal, veiled.thermal)
        lit = [thing for thing in plain.placed if thing.lit and np.cos(thing.yaw) < 0]
        gain = veiled.rgb.astype(int).sum() - plain.rgb.astype(int).sum()
        assert gain >= 0
        found += gain > 0
        assert lit or gain == 0
    assert found >= 5


def test_no_veil_without_glare() -> None:
    one = scene(0, night=True)
    light = None
    assert veil_of(one.placed, one.camera, light, 0.0, (0, 0)) is None  # type: ignore[arg-type]


def test_far_objects_are_scaled() -> None:
    few = {"num_objects": 0, "rail_share": 0.0, "bump_share": 0.0, "kerb_share": 0.0}
    sizes = [
        sum(
            int((scene(index, far_object_scale=factor, **few).label > 0).sum())
            for index in range(20)
        )
        for factor in (1.0, 2.0)
    ]
    assert 2.5 < sizes[1] / sizes[0] < 4.5  # four times, less what they hide of one another


def test_shares_of_structures() -> None:
    for key, label in (("rail_share", 6), ("bump_share", 8), ("kerb_share", CURVE)):
        none = [scene(index, **{key: 0.0}).label for index in range(8)]
        assert not any((label == one).any() for one in none), key


def test_maps_of_the_test_split(tmp_path: Path) -> None:
    sizes = {"num_train": 2, "num_val": 1, "num_test": 3, "height": 48, "width": 64}
    dataset = synth_calibrated(cache_dir=str(tmp_path), **sizes, far_object_scale=1.5)
    assert isinstance(dataset, SceneDataset)
    for number, name in enumerate(dataset.names("test")):
        maps = dataset.scene_maps(name)
        factors = SceneFactors(
            height=48, width=64, far_object_scale=1.5, night_share=float(name.endswith("N"))
        )
        rendered = render_scene(0, 3 + number, factors)
        assert np.array_equal(rendered.label, dataset.read(name).label)
        near = rendered.depth < 655
        assert np.abs(maps.depth_m[near] - rendered.depth[near]).max() <= 0.0051
        assert np.isinf(maps.depth_m[np.isinf(rendered.depth)]).all()
        labelled = (rendered.owner >= 0) & (rendered.label > 0)
        assert np.array_equal(maps.objects > 0, labelled)
        assert np.array_equal(maps.objects[labelled], rendered.owner[labelled] + 1)
    with pytest.raises(InputError, match="expected depth and objects of a rendered scene"):
        dataset.scene_maps(dataset.names("train")[0])
