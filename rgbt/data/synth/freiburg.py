"""The data set `synth_freiburg`: scenes in the form of Freiburg Thermal, read by its own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.data.freiburg import THERMAL_RANGE, CountRange, Crop, Freiburg
from rgbt.data.synth.cache import cache_of, described, key_of, written_once
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
        factors: given as keywords, all but `night_share`; see `SceneFactors`.

    Returns:
        the reader of the written folder.

    Raises:
        InputError: a factor out of range, a cache that cannot be written.
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
        str(cached(plan, cache_of(cache_dir))),
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
    text = described({"scenes": SCENES_VERSION, "files": VERSION}, plan)
    return written_once(
        cache / f"synth_freiburg-{key_of(text)}", text, lambda made: write(plan, made)
    )
