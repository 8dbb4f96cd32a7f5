"""The data set `synth`: written into a cache folder on first use, then read like MFNet."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.data.synth.cache import written_once
from rgbt.data.synth.factors import (
    EgoMotion,
    ForwardMetres,
    NumScenes,
    SceneFactors,
    YawDegrees,
    with_factors,
)
from rgbt.data.synth.writer import SynthPlan, write
from rgbt.ranges import Seed, Text

VERSION = 2
"""Of the generator. Raise it with every change that changes a byte, so that no cache is stale."""


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
    if ego_forward_m is None and ego_yaw_deg != 0:
        raise InputError(
            f"dataset.ego_yaw_deg is {ego_yaw_deg:g} but no second frame is requested; "
            "set dataset.ego_forward_m too (0 to turn on the spot)."
        )
    motion = None if ego_forward_m is None else EgoMotion(ego_forward_m, ego_yaw_deg)
    plan = SynthPlan(
        seed=seed,
        num_train=num_train,
        num_val=num_val,
        num_test=num_test,
        factors=factors,
        motion=motion,
    )
    return MFNet(str(cached(plan, cache_dir)), name="synth", num_classes=num_classes)


def cached(plan: SynthPlan, cache_dir: str | Path | None) -> Path:
    """The folder of `plan`, see `written_once`."""
    return written_once("synth", {"version": VERSION}, plan, cache_dir, write)
