"""The data set `synth`: written into a cache folder on first use, then read like MFNet."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.data.synth.cache import default_cache, written_once
from rgbt.data.synth.factors import EgoMotion, SceneFactors
from rgbt.data.synth.writer import Plan, write

VERSION = 2
"""Of the generator. Raise it with every change that changes a byte, so that no cache is stale."""


def synth(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: str | None = None,
    num_classes: Literal[9] = 9,
    seed: int = 0,
    num_train: int = 600,
    num_val: int = 100,
    num_test: int = 100,
    height: int = 120,
    width: int = 160,
    num_objects: int = 7,
    num_far_objects: int = 16,
    texture_strength: float = 1.0,
    rgb_noise: float = 0.012,
    rgb_noise_radius_gain: float = 0.5,
    rgb_noise_dark_gain: float = 1.5,
    thermal_noise: float = 0.012,
    thermal_contrast: float = 1.0,
    thermal_drift: float = 0.02,
    night_share: float = 0.5,
    camera_height_m: float = 1.6,
    camera_pitch_deg: float = 2.0,
    field_of_view_deg: float = 64.0,
    ego_forward_m: float | None = None,
    ego_yaw_deg: float = 0.0,
) -> MFNet:
    """The synthetic data set with these factors, generated if no earlier call has done so.

    What a factor means is said in `SceneFactors` and `EgoMotion`.

    Args:
        cache_dir: folder that holds written data sets; None: $XDG_CACHE_HOME/rgbt or ~/.cache/rgbt.
        num_classes: MFNet's nine; other nodes of the configuration interpolate it.
        seed: of the data set; independent of the seed of a run.
        num_train: scenes of the training split.
        num_val: scenes of the validation split.
        num_test: scenes of the test split; no scene is in two splits.
        height: see `SceneFactors`, like all that follow.
        width: image width in pixels.
        num_objects: groups of near objects.
        num_far_objects: small objects around the vanishing point.
        texture_strength: factor on surface texture.
        rgb_noise: sensor noise by day at the image centre.
        rgb_noise_radius_gain: how much more at the corners.
        rgb_noise_dark_gain: how much more in the dark.
        thermal_noise: noise of the thermal image.
        thermal_contrast: factor on temperature differences.
        thermal_drift: low-frequency offset of the thermal image.
        night_share: share of night scenes.
        camera_height_m: height of the camera.
        camera_pitch_deg: its downward tilt.
        field_of_view_deg: its horizontal field of view.
        ego_forward_m: None: single frames. A number: every scene is also written as it looks after
            this motion, in the sub-folder `next`, with the exact flow back to the first frame.
        ego_yaw_deg: turn of that motion.

    Returns:
        the reader of the written folder.

    Raises:
        InputError: a factor out of range, a turn without a motion, a cache that cannot be written.
    """
    if ego_forward_m is None and ego_yaw_deg != 0:
        raise InputError(
            f"dataset.ego_yaw_deg is {ego_yaw_deg:g} but no second frame is asked for; "
            "set dataset.ego_forward_m too (0 to turn on the spot)."
        )
    factors = SceneFactors(
        height=height,
        width=width,
        num_objects=num_objects,
        num_far_objects=num_far_objects,
        texture_strength=texture_strength,
        rgb_noise=rgb_noise,
        rgb_noise_radius_gain=rgb_noise_radius_gain,
        rgb_noise_dark_gain=rgb_noise_dark_gain,
        thermal_noise=thermal_noise,
        thermal_contrast=thermal_contrast,
        thermal_drift=thermal_drift,
        night_share=night_share,
        camera_height_m=camera_height_m,
        camera_pitch_deg=camera_pitch_deg,
        field_of_view_deg=field_of_view_deg,
    )
    motion = None if ego_forward_m is None else EgoMotion(ego_forward_m, ego_yaw_deg)
    plan = Plan(
        seed=seed,
        num_train=num_train,
        num_val=num_val,
        num_test=num_test,
        factors=factors,
        motion=motion,
    )
    folder = cached(plan, Path(cache_dir).expanduser() if cache_dir else default_cache())
    return MFNet(str(folder), name="synth", num_classes=num_classes)


def cached(plan: Plan, cache: Path) -> Path:
    """Folder of the data set `plan` inside `cache`, written now if it is not there yet.

    Raises:
        InputError: the cache cannot be written.
    """
    folder = cache / f"synth-{plan_key(plan)}"
    return written_once(folder, _described(plan), lambda made: write(plan, made))


def plan_key(plan: Plan) -> str:
    """12 hexadecimal digits that name the plan: a hash of all its numbers and `VERSION`."""
    return hashlib.sha256(_described(plan).encode()).hexdigest()[:12]


def _described(plan: Plan) -> str:
    return json.dumps({"version": VERSION, **asdict(plan)}, sort_keys=True, indent=1)
