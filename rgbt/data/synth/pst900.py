"""The data set `synth_pst900`: scenes in the form of PST900, read by its own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rgbt.data.pst900 import PST900, Bags
from rgbt.data.synth.cache import cache_of, described, key_of, written_once
from rgbt.data.synth.dataset import VERSION as SCENES_VERSION
from rgbt.data.synth.factors import NumScenes, SceneFactors, with_factors
from rgbt.data.synth.pst900_writer import VAL_BAG, write
from rgbt.data.synth.writer import SynthPlan
from rgbt.ranges import Seed, Text

VERSION = 1
"""Of the files beside the scenes. Raise it with every change that changes a byte of them."""


@with_factors(width=214, field_of_view_deg=80.0)
def synth_pst900(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: Text | None = None,
    num_classes: Literal[5] = 5,
    val_bags: Bags = (VAL_BAG,),
    seed: Seed = 0,
    num_train: NumScenes = 400,
    num_val: NumScenes = 50,
    num_test: NumScenes = 80,
    factors: SceneFactors,
) -> PST900:
    """The data set with these factors, generated on first use.

    These are streets and no tunnels. They stand in for the files and for how rare the four objects
    are (about 1 % of the pixels each, as backpack and survivor are there; the other two are rarer):
    traffic cones for fire extinguishers, car stops for backpacks, bumps for hand drills, persons
    for survivors. What is learnt on them says nothing of PST900.

    Args:
        cache_dir: folder that holds written data sets; None: $XDG_CACHE_HOME/rgbt or ~/.cache/rgbt.
        num_classes: the five of PST900; other nodes of the configuration interpolate it.
        val_bags: see `rgbt.data.pst900.PST900`; () makes "val" the test part, as in the releases,
            and leaves the scenes for validation in training.
        seed: of the data set; independent of the seed of a run.
        num_train: scenes of the training part without those for validation.
        num_val: scenes of the recording that is held out.
        num_test: scenes of the test part; no scene is in two splits.
        factors: given as keywords, from `height` to `field_of_view_deg`; see `SceneFactors`.

    Returns:
        the reader of the written folder.

    Raises:
        InputError: a factor out of range, a bag that is not there, a cache that cannot be written.
    """
    plan = SynthPlan(
        seed=seed, num_train=num_train, num_val=num_val, num_test=num_test, factors=factors
    )
    folder = cached(plan, cache_of(cache_dir))
    return PST900(str(folder), name="synth_pst900", num_classes=num_classes, val_bags=val_bags)


def cached(plan: SynthPlan, cache: Path) -> Path:
    """Folder of the data set `plan` inside `cache`, written now if it is not there yet.

    Raises:
        InputError: the cache cannot be written.
    """
    text = described({"scenes": SCENES_VERSION, "files": VERSION}, plan)
    return written_once(
        cache / f"synth_pst900-{key_of(text)}", text, lambda made: write(plan, made)
    )
