"""The data set `synth_freiburg`: scenes in the form of Freiburg Thermal, read by its own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.data.freiburg import THERMAL_RANGE, CountRange, Crop, Freiburg
from rgbt.data.synth.cache import written_once
from rgbt.data.synth.dataset import VERSION as SCENES_VERSION
from rgbt.data.synth.factors import NumScenes, SceneFactors, with_factors
from rgbt.data.synth.freiburg_writer import VAL_SEQUENCE, FreiburgPlan, write
from rgbt.ranges import Names, Seed, Text

VERSION = 1
"""Of the files beside the scenes. Raise it with every change that changes a byte of them."""


@with_factors("night_share", height=98, width=288, field_of_view_deg=96.0)
def synth_freiburg(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: Text | None = None,
    num_classes: Literal[14] = 14,
    unscored: Names = ("background", "ignore"),
    crop: Crop | None = (1, 97, 48, 240),
    thermal_range: CountRange = THERMAL_RANGE,
    ignored_test: Names = ("ignore",),
    seed: Seed = 0,
    num_train_day: NumScenes = 300,
    num_train_night: NumScenes = 300,
    num_val: NumScenes = 40,
    num_test: Annotated[int, Interval(ge=2, le=30_000)] = 60,
    factors: SceneFactors,
) -> Freiburg:
    """The data set with these factors, generated on first use.

    Labels are exact, those for training too, which in the real data set a network has predicted.
    "ignore" is in test labels alone: what the thermal camera does not see.

    Args:
        cache_dir: see `rgbt.data.synth.dataset.synth`, as `seed`, `factors` and the errors.
        num_classes: see `rgbt.data.freiburg.Freiburg`, like the four that follow.
        unscored: the same.
        crop: what is read of each frame; it fits the size of the frames.
        thermal_range: counts that become black and white; scenes use the thesis' range.
        ignored_test: the same.
        seed: of the data set.
        num_train_day: labelled scenes by day.
        num_train_night: unlabelled scenes at night; other scenes than those by day.
        num_val: labelled scenes by day of the sequence that is held out.
        num_test: labelled scenes for testing, half by day and half at night.
        factors: all but `night_share`.
    """
    plan = FreiburgPlan(
        seed=seed,
        num_train_day=num_train_day,
        num_train_night=num_train_night,
        num_val=num_val,
        num_test=num_test,
        factors=factors,
    )
    return Freiburg(
        str(cached(plan, cache_dir)),
        name="synth_freiburg",
        num_classes=num_classes,
        unscored=unscored,
        crop=crop,
        thermal_range=thermal_range,
        ignored_test=ignored_test,
        val_sequences=(VAL_SEQUENCE,),
    )


def cached(plan: FreiburgPlan, cache_dir: str | Path | None) -> Path:
    """The folder of `plan`, see `written_once`."""
    versions = {"scenes": SCENES_VERSION, "files": VERSION}
    return written_once("synth_freiburg", versions, plan, cache_dir, write)
