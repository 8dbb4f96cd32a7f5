"""The data set `synth_kp`: scenes in the form of KP, read by its own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rgbt.data.kp import KP
from rgbt.data.synth.cache import cache_of, described, key_of, written_once
from rgbt.data.synth.dataset import VERSION as SCENES_VERSION
from rgbt.data.synth.factors import NumScenes, SceneFactors, with_factors
from rgbt.data.synth.kp_writer import write
from rgbt.data.synth.writer import SynthPlan
from rgbt.ranges import Seed, Text

VERSION = 1
"""Of the files beside the scenes. Raise it with every change that changes a byte of them."""


@with_factors(night_share=0.48)
def synth_kp(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: Text | None = None,
    num_classes: Literal[19] = 19,
    seed: Seed = 0,
    num_train: NumScenes = 400,
    num_val: NumScenes = 60,
    num_test: NumScenes = 80,
    factors: SceneFactors,
) -> KP:
    """The data set with these factors, generated on first use.

    Five of the 19 classes are in no scene (see `rgbt.data.synth.kp_classes`): where absent classes
    count as 0, as in the published tables, no network scores more than 14 / 19 = 73.7 %.

    Args:
        cache_dir: folder that holds written data sets; None: $XDG_CACHE_HOME/rgbt or ~/.cache/rgbt.
        num_classes: the nineteen of KP; other nodes of the configuration interpolate it.
        seed: of the data set; independent of the seed of a run.
        num_train: scenes of the training split.
        num_val: scenes of the validation split.
        num_test: scenes of the test split; no scene is in two splits.
        factors: given as keywords, from `height` to `field_of_view_deg`; see `SceneFactors`.

    Returns:
        the reader of the written folder.

    Raises:
        InputError: a factor out of range, a cache that cannot be written.
    """
    plan = SynthPlan(
        seed=seed, num_train=num_train, num_val=num_val, num_test=num_test, factors=factors
    )
    folder = cached(plan, cache_of(cache_dir))
    return KP(str(folder), name="synth_kp", num_classes=num_classes)


def cached(plan: SynthPlan, cache: Path) -> Path:
    """Folder of the data set `plan` inside `cache`, written now if it is not there yet.

    Raises:
        InputError: the cache cannot be written.
    """
    text = described({"scenes": SCENES_VERSION, "files": VERSION}, plan)
    return written_once(cache / f"synth_kp-{key_of(text)}", text, lambda made: write(plan, made))
