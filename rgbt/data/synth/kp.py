"""The data set `synth_kp`: scenes as the CRM release lays out KP, read by its own reader.

images/setXX/VYYY/{visible,lwir}/IZZZZZ.jpg   three channels each, those of lwir equal
labels/setXX_VYYY_IZZZZZ.png                  class ids, 19 for void
{train,val,test}{,_day,_night}.txt            one label file per line
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from rgbt.data.kp import KP
from rgbt.data.kp_layout import is_night as is_night_name
from rgbt.data.kp_layout import sets_of
from rgbt.data.synth.cache import written_once
from rgbt.data.synth.classes import kp_ids
from rgbt.data.synth.dataset import VERSION as SCENES_VERSION
from rgbt.data.synth.factors import NumScenes, SceneFactors, with_factors
from rgbt.data.synth.light import is_night
from rgbt.data.synth.scene import render_scene
from rgbt.data.synth.writer import SynthPlan, bgr, write_each, write_image, write_list
from rgbt.ranges import Seed, Text

VERSION = 1
"""Of the files beside the scenes. Raise it with every change that changes a byte of them."""

_FRAMES_PER_VIDEO = 40


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

    Five of the 19 classes are in no scene (see `rgbt.data.synth.classes`): where absent classes
    count as 0, as in the published tables, no network scores more than 14 / 19 = 73.7 %.

    Args and errors as of `rgbt.data.synth.dataset.synth`, without a second frame.
    """
    plan = SynthPlan(
        seed=seed, num_train=num_train, num_val=num_val, num_test=num_test, factors=factors
    )
    return KP(str(cached(plan, cache_dir)), name="synth_kp", num_classes=num_classes)


def cached(plan: SynthPlan, cache_dir: str | Path | None) -> Path:
    """The folder of `plan`, see `written_once`."""
    versions = {"scenes": SCENES_VERSION, "files": VERSION}
    return written_once("synth_kp", versions, plan, cache_dir, write)


def write(plan: SynthPlan, folder: Path) -> None:
    """Write the whole data set into `folder`, which exists; OSError if that is not possible."""
    by_split = names_of(plan)
    names = [name for split in by_split.values() for name in split]
    write_each(partial(_write_numbered, plan, names, folder), plan.num_scenes)
    for split, own in by_split.items():
        nights = {name for name in own if is_night_name(name)}
        for suffix, listed in (("", own), ("_day", set(own) - nights), ("_night", nights)):
            if listed:
                path = folder / f"{split}{suffix}.txt"
                write_list(path, [f"{name}.png" for name in sorted(listed)])


def names_of(plan: SynthPlan) -> dict[str, list[str]]:
    """Split -> names of its scenes.

    The recordings are those that the CRM release gives to a split, by day and at night.
    """
    found: dict[str, list[str]] = {}
    for split, scenes in plan.splits.items():
        nights = [is_night(plan.seed, scene, plan.factors.night_share) for scene in scenes]
        found[split] = []
        for number, (scene, night) in enumerate(zip(scenes, nights, strict=True)):
            # How many scenes of the same time of day come before this one.
            before = nights[:number].count(night)
            sets = sets_of(f"{split}_{'night' if night else 'day'}")
            recording = sets[before * len(sets) // nights.count(night)]
            found[split].append(
                f"set{recording:02d}_V{before // _FRAMES_PER_VIDEO:03d}_I{scene:05d}"
            )
    return found


def _write_numbered(plan: SynthPlan, names: list[str], folder: Path, number: int) -> None:
    scene = render_scene(plan.seed, number, plan.factors)
    recording, video, frame = names[number].split("_")
    images = folder / "images" / recording / video
    write_image(images / "visible" / f"{frame}.jpg", bgr(scene))
    write_image(images / "lwir" / f"{frame}.jpg", np.repeat(scene.thermal[..., None], 3, axis=2))
    write_image(folder / "labels" / f"{names[number]}.png", kp_ids(scene))
