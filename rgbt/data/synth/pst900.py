"""The data set `synth_pst900`: scenes as the PST900 archive has its images, read by its own reader.

{train,test}/{rgb,thermal,labels}/NAME.png, NAME as in 58_bag21_rect_rgb_frame0000000440
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from rgbt.data.pst900 import CLASSES, PST900, Bags
from rgbt.data.pst900_layout import FOLDERS, PARTS
from rgbt.data.synth.cache import written_once
from rgbt.data.synth.dataset import VERSION as SCENES_VERSION
from rgbt.data.synth.factors import NumScenes, SceneFactors, with_factors
from rgbt.data.synth.scene import render_scene
from rgbt.data.synth.shapes import BUMP, CAR_STOP, COLOR_CONE, PERSON
from rgbt.data.synth.writer import SynthPlan, bgr, write_each, write_image
from rgbt.ranges import Seed, Text

VERSION = 1
"""Of the files beside the scenes. Raise it with every change that changes a byte of them."""

VAL_BAG = 20
"""The recording of the training part that scenes for validation lie in."""

_TRAIN_BAGS = tuple(range(1, VAL_BAG))
_TEST_BAGS = (21, 22, 23, 24, 25)
"""Those of the real test part."""

_FRAME_STEP = 10

STANDS_FOR = {
    COLOR_CONE: "fire_extinguisher",
    CAR_STOP: "backpack",
    BUMP: "hand_drill",
    PERSON: "survivor",
}
"""Which object of a street stands for which of the four; everything else is background."""

CLASS_OF = np.array(
    [CLASSES.index(STANDS_FOR.get(label, "background")) for label in range(BUMP + 1)], np.uint8
)


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

    Args and errors as of `rgbt.data.synth.dataset.synth`, without a second frame, and `val_bags` of
    `rgbt.data.pst900.PST900`; () makes "val" the test part, as in the releases, and leaves the
    scenes for validation in training.
    """
    plan = SynthPlan(
        seed=seed, num_train=num_train, num_val=num_val, num_test=num_test, factors=factors
    )
    folder = str(cached(plan, cache_dir))
    return PST900(folder, name="synth_pst900", num_classes=num_classes, val_bags=val_bags)


def cached(plan: SynthPlan, cache_dir: str | Path | None) -> Path:
    """The folder of `plan`, see `written_once`."""
    versions = {"scenes": SCENES_VERSION, "files": VERSION}
    return written_once("synth_pst900", versions, plan, cache_dir, write)


class ImageToWrite(NamedTuple):
    """One picture to be written: number of its scene, its part, the recording that it is of."""

    scene: int
    part: str
    bag: int

    @property
    def name(self) -> str:
        """As the archive calls its pictures."""
        return f"{self.scene}_bag{self.bag:02d}_rect_rgb_frame{self.scene * _FRAME_STEP:010d}"


def shots_of(plan: SynthPlan) -> tuple[ImageToWrite, ...]:
    """Every picture, numbered over all splits: no scene is in two of them."""
    train, test = PARTS
    parts = [
        *((train, bag) for bag in _spread(plan.num_train, _TRAIN_BAGS)),
        *((train, VAL_BAG) for _ in range(plan.num_val)),
        *((test, bag) for bag in _spread(plan.num_test, _TEST_BAGS)),
    ]
    return tuple(ImageToWrite(scene, part, bag) for scene, (part, bag) in enumerate(parts))


def _spread(num: int, bags: tuple[int, ...]) -> Iterator[int]:
    return (bags[number * len(bags) // num] for number in range(num))


def write(plan: SynthPlan, folder: Path) -> None:
    """Write the whole data set into `folder`, which exists; OSError if that is not possible."""
    shots = shots_of(plan)
    write_each(partial(_write_numbered, plan, shots, folder), len(shots))


def _write_numbered(
    plan: SynthPlan, shots: tuple[ImageToWrite, ...], folder: Path, number: int
) -> None:
    shot = shots[number]
    scene = render_scene(plan.seed, shot.scene, plan.factors)
    images = (bgr(scene), scene.thermal, CLASS_OF[scene.label])
    for kind, image in zip(FOLDERS, images, strict=True):
        write_image(folder / shot.part / kind / f"{shot.name}.png", image)
