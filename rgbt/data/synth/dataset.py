"""The data set `synth`, in MFNet's layout, written on first use and read like MFNet.

images/00012D.png   four channels R, G, B, thermal       labels/00012D.png   class ids
train.txt val.txt test.txt test_day.txt test_night.txt   one name per line
next/               the same names after the ego-motion, with flow/NAME.npy, if requested
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.data.synth.factors import (
    EgoMotion,
    ForwardMetres,
    NumScenes,
    SceneFactors,
    YawDegrees,
    with_factors,
)
from rgbt.data.synth.scene import Scene
from rgbt.data.synth.writer import VERSION, Images, Layout, Plan, Shot, bgr
from rgbt.ranges import Seed, Text


@with_factors()
def synth(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: Text | None = None,
    num_classes: Literal[9] = 9,
    seed: Seed = 0,
    num_train: NumScenes = 600,
    num_val: NumScenes = 100,
    num_test: NumScenes = 100,
    factors: SceneFactors,
    ego_forward_m: ForwardMetres | None = None,
    ego_yaw_deg: YawDegrees = 0.0,
) -> MFNet:
    """The synthetic data set with these factors, generated on first use.

    Args:
        cache_dir: folder that holds written data sets; None: $XDG_CACHE_HOME/rgbt or ~/.cache/rgbt.
        num_classes: MFNet's nine; other nodes of the configuration interpolate it.
        seed: of the data set; independent of the seed of a run.
        num_train: scenes of the training split.
        num_val: scenes of the validation split.
        num_test: scenes of the test split; no scene is in two splits.
        factors: given as keywords, from `height` to `field_of_view_deg`; see `SceneFactors`.
        ego_forward_m: None: single frames. A number: every scene is also written as it looks after
            this motion, in the sub-folder `next`, with the exact flow back to the first frame; see
            `EgoMotion`.
        ego_yaw_deg: turn of that motion.

    Returns:
        the reader of the written folder.

    Raises:
        InputError: a factor out of range, a turn without a motion, a cache that cannot be written.
    """
    motion = ego_motion(ego_forward_m, ego_yaw_deg)
    numbers = {"num_train": num_train, "num_val": num_val, "num_test": num_test}
    plan = Plan(seed=seed, numbers=numbers, factors=factors, motion=motion)
    return MFNet(str(LAYOUT.cached(plan, cache_dir)), name="synth", num_classes=num_classes)


def ego_motion(forward_m: float | None, yaw_deg: float) -> EgoMotion | None:
    """The motion to a second frame; None for single frames.

    Raises:
        InputError: a turn without a motion.
    """
    if forward_m is None and yaw_deg != 0:
        raise InputError(
            f"dataset.ego_yaw_deg is {yaw_deg:g}, but no second frame is requested. Set "
            "dataset.ego_forward_m too (0 turns on the spot)."
        )
    return None if forward_m is None else EgoMotion(forward_m, yaw_deg)


def shots(plan: Plan) -> list[Shot]:
    """Names have five digits and D (day) or N (night), as in MFNet."""
    return [
        Shot(scene, split, night, f"{scene:05d}{'N' if night else 'D'}")
        for split, scenes in plan.splits
        for scene in scenes
        for night in [plan.is_night(scene)]
    ]


def images(scene: Scene, shot: Shot) -> Images:
    """Image and label of a scene."""
    return {
        # The fourth channel, alpha, is thermal.
        f"images/{shot.name}.png": np.dstack([bgr(scene), scene.thermal]),
        f"labels/{shot.name}.png": scene.label,
    }


def split_lists(shots: Sequence[Shot]) -> dict[str, list[str]]:
    """The names of each split, and those of the test split by day and at night."""
    lists: dict[str, list[str]] = {}
    for shot in shots:
        lists.setdefault(f"{shot.split}.txt", []).append(shot.name)
        if shot.split == "test":
            time = "night" if shot.night else "day"
            lists.setdefault(f"test_{time}.txt", []).append(shot.name)
    return lists


LAYOUT = Layout(
    name="synth", versions={"version": VERSION}, shots=shots, images=images, lists=split_lists
)
