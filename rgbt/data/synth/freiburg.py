"""The data set `synth_freiburg`: scenes in the form of Freiburg Thermal, read by its own reader."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from rgbt.data.freiburg import THERMAL_RANGE, Freiburg
from rgbt.data.synth.cache import default_cache, written_once
from rgbt.data.synth.dataset import VERSION as SCENES_VERSION
from rgbt.data.synth.factors import SceneFactors
from rgbt.data.synth.freiburg_writer import VAL_SEQUENCE, FreiburgPlan, write

VERSION = 1
"""Of the files beside the scenes. Raise it with every change that changes a byte of them."""


def synth_freiburg(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: str | None = None,
    num_classes: Literal[14] = 14,
    unscored: tuple[str, ...] = ("background", "ignore"),
    crop: tuple[int, int, int, int] | None = (1, 97, 48, 240),
    thermal_range: tuple[int, int] = THERMAL_RANGE,
    ignored_test: tuple[str, ...] = ("ignore",),
    seed: int = 0,
    num_train_day: int = 300,
    num_train_night: int = 300,
    num_val: int = 40,
    num_test: int = 60,
    height: int = 98,
    width: int = 288,
    num_objects: int = 7,
    num_far_objects: int = 16,
    texture_strength: float = 1.0,
    rgb_noise: float = 0.012,
    rgb_noise_radius_gain: float = 0.5,
    rgb_noise_dark_gain: float = 1.5,
    thermal_noise: float = 0.012,
    thermal_contrast: float = 1.0,
    thermal_drift: float = 0.02,
    camera_height_m: float = 1.6,
    camera_pitch_deg: float = 2.0,
    field_of_view_deg: float = 96.0,
) -> Freiburg:
    """The data set with these factors, generated if no earlier call has done so.

    Labels are exact, those for training too, which in the real data set a network has predicted.
    "ignore" is in test labels alone: what the thermal camera does not see.

    Args:
        cache_dir: folder that holds written data sets; None: $XDG_CACHE_HOME/rgbt or ~/.cache/rgbt.
        num_classes: the fourteen of Freiburg; other nodes of the configuration interpolate it.
        unscored: see `rgbt.data.freiburg.Freiburg`, like the three that follow.
        crop: what is read of each frame; it fits the size of the frames.
        thermal_range: counts that become black and white; scenes use the thesis' range.
        ignored_test: classes that do not count in "val" and "test".
        seed: of the data set; independent of the seed of a run.
        num_train_day: labelled scenes by day.
        num_train_night: unlabelled scenes at night; other scenes than those by day.
        num_val: labelled scenes by day of the sequence that is held out.
        num_test: labelled scenes for testing, half by day and half at night.
        height: of the frame; see `rgbt.data.synth.factors.SceneFactors`, like all that follow.
        width: of the frame in pixels.
        num_objects: groups of near objects.
        num_far_objects: small objects around the vanishing point.
        texture_strength: factor on surface texture.
        rgb_noise: sensor noise by day at the image centre.
        rgb_noise_radius_gain: how much more at the corners.
        rgb_noise_dark_gain: how much more in the dark.
        thermal_noise: noise of the thermal image.
        thermal_contrast: factor on temperature differences.
        thermal_drift: low-frequency offset of the thermal image.
        camera_height_m: height of the camera.
        camera_pitch_deg: its downward tilt.
        field_of_view_deg: its horizontal field of view, of the whole frame.

    Returns:
        the reader of the written folder.

    Raises:
        InputError: a factor out of range, a cache that cannot be written.
    """
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
        camera_height_m=camera_height_m,
        camera_pitch_deg=camera_pitch_deg,
        field_of_view_deg=field_of_view_deg,
    )
    plan = FreiburgPlan(
        seed=seed,
        num_train_day=num_train_day,
        num_train_night=num_train_night,
        num_val=num_val,
        num_test=num_test,
        factors=factors,
    )
    folder = cached(plan, Path(cache_dir).expanduser() if cache_dir else default_cache())
    return Freiburg(
        str(folder),
        name="synth_freiburg",
        num_classes=num_classes,
        unscored=unscored,
        crop=crop,
        thermal_range=thermal_range,
        ignored_test=ignored_test,
        val_sequences=(VAL_SEQUENCE,),
    )


def cached(plan: FreiburgPlan, cache: Path) -> Path:
    """Folder of the data set `plan` inside `cache`, written now if it is not there yet.

    Raises:
        InputError: the cache cannot be written.
    """
    versions = {"scenes": SCENES_VERSION, "files": VERSION}
    described = json.dumps({**versions, **asdict(plan)}, sort_keys=True, indent=1)
    key = hashlib.sha256(described.encode()).hexdigest()[:12]
    folder = cache / f"synth_freiburg-{key}"
    return written_once(folder, described, lambda made: write(plan, made))
