"""Why a surface has another brightness in the second frame than in the first one.

The flow is exact, so without noise and texture the first frame, warped, would be the second one if
nothing depended on the place of the camera. Each cause is taken away here, one after the other.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.data.synth import rgb, scene, surface
from rgbt.data.synth.camera import camera_of
from rgbt.data.synth.factors import EgoMotion, SceneFactors
from rgbt.data.synth.light import Light
from rgbt.data.synth.scene import ScenePair, render_pair, render_scene

STILL = SceneFactors(rgb_noise=0.0, texture_strength=0.0)
MOTION = EgoMotion(0.7, 1.0)
SCENES = range(16)

Array = np.ndarray[Any, Any]


def warped(values: Array, pair: ScenePair) -> Array:
    rows, columns = np.mgrid[: values.shape[0], : values.shape[1]].astype(np.float32)
    flow = np.nan_to_num(pair.flow, nan=-1e6)
    target = (columns + flow[..., 1], rows + flow[..., 0])
    return np.asarray(cv2.remap(values.astype(np.float32), *target, cv2.INTER_LINEAR))


def inside(pair: ScenePair) -> Array:
    """Pixels that both frames show, two pixels from every border of a surface."""
    number = (pair.second.material * 1000 + pair.second.owner).astype(np.float32)
    square = np.ones((5, 5), np.uint8)
    return pair.visible & (cv2.erode(number, square) == cv2.dilate(number, square))


def apart(factors: SceneFactors) -> float:
    """Mean absolute difference of grey levels between the second frame and the warped first."""
    found = []
    for index in SCENES:
        pair = render_pair(0, index, factors, MOTION)
        difference = pair.second.rgb - warped(pair.first.rgb, pair)
        found.append(np.abs(difference.mean(2))[inside(pair)].mean())
    return float(np.mean(found))


def without(patch: pytest.MonkeyPatch, *causes: str) -> None:
    """Take causes away from the world or the camera."""
    world = scene._world

    def changed(*arguments: Any) -> Any:
        made = world(*arguments)
        light: Light = made.light
        if "haze" in causes:
            light = light._replace(visibility_m=1e9)
        if "headlights" in causes:
            light = light._replace(headlight=0.0)
        return made._replace(light=light)

    patch.setattr(scene, "_world", changed)
    if "halos" in causes:
        patch.setattr(rgb, "_bloom", np.zeros_like)


@pytest.mark.slow
def test_by_day_vignette_shadows_and_haze_are_all(monkeypatch: pytest.MonkeyPatch) -> None:
    day = replace(STILL, night_share=0.0)
    found = [apart(day), apart(replace(day, vignette=0.0))]
    found.append(apart(replace(day, vignette=0.0, whole_shadows=True)))
    without(monkeypatch, "haze")
    found.append(apart(replace(day, vignette=0.0, whole_shadows=True)))
    assert found == sorted(found, reverse=True)
    assert found[0] > 2.0
    assert found[3] < 0.6  # rounding to bytes of both frames, and interpolation


@pytest.mark.slow
def test_by_night_headlights_halos_and_vignette_are_all(monkeypatch: pytest.MonkeyPatch) -> None:
    night = replace(STILL, night_share=1.0)
    found = [apart(night)]
    with monkeypatch.context() as patch:
        without(patch, "headlights")
        found.append(apart(night))
    with monkeypatch.context() as patch:
        without(patch, "headlights", "halos")
        found += [apart(night), apart(replace(night, vignette=0.0))]
    assert found == sorted(found, reverse=True)
    assert found[0] > 2.5
    assert found[3] < 0.6


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


def test_clipped_shadow_is_that_of_the_part_in_front() -> None:
    """A square of ground from 1 m behind the camera to 10 m ahead, seen from 1.6 m."""
    camera = camera_of(replace(STILL, camera_pitch_deg=0.0))
    canvas = np.zeros((camera.height, camera.width), np.uint8)
    corners = [[-0.5, 0.0, -1.0], [-0.5, 0.0, 10.0], [0.5, 0.0, 10.0], [0.5, 0.0, -1.0]]
    surface._fill_beyond(canvas, np.array(corners, np.float32), camera, 200)
    rays = camera.rays()
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = 1.6 / rays[1]
        across = rays[0] * depth
    expected = (rays[1] > 0) & (depth < 10.0) & (depth > 0.3) & (np.abs(across) < 0.5)
    assert expected.sum() > 500
    # The outline is drawn as well.
    assert (expected & (canvas == 0)).sum() == 0
    assert (
        (canvas > 0) & ~cv2.dilate(expected.astype(np.uint8), np.ones((3, 3))).astype(bool)
    ).sum() == 0


def test_new_factors_change_nothing_unless_set() -> None:
    plain = render_scene(0, 52, STILL)
    stated = render_scene(0, 52, replace(STILL, vignette=0.18, whole_shadows=False))
    assert np.array_equal(plain.rgb, stated.rgb)
    assert STILL.values().keys().isdisjoint({"vignette", "whole_shadows"})
    corner = render_scene(0, 52, replace(STILL, vignette=0.0)).rgb[:12, :16].mean()
    assert corner > plain.rgb[:12, :16].mean()
