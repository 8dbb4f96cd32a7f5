"""Writes scenes as the PST900 archive lays out its pictures: a folder per part and kind of image.

{train,test}/{rgb,thermal,labels}/NAME.png, NAME as in 58_bag21_rect_rgb_frame0000000440
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from rgbt.data.pst900 import CLASSES
from rgbt.data.pst900_layout import FOLDERS, PARTS
from rgbt.data.synth.scene import render_scene
from rgbt.data.synth.shapes import BUMP, CAR_STOP, COLOR_CONE, PERSON
from rgbt.data.synth.writer import SynthPlan, write_each, write_png

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
    """Write the whole data set into `folder`, which exists.

    Raises:
        OSError: the files cannot be written.
    """
    for part in PARTS:
        for kind in FOLDERS:
            (folder / part / kind).mkdir(parents=True)
    shots = shots_of(plan)
    write_each(partial(_write_numbered, plan, shots, folder), len(shots))


def _write_numbered(
    plan: SynthPlan, shots: tuple[ImageToWrite, ...], folder: Path, number: int
) -> None:
    cv2.setNumThreads(1)
    shot = shots[number]
    scene = render_scene(plan.seed, shot.scene, plan.factors)
    # OpenCV stores blue first.
    images = (np.ascontiguousarray(scene.rgb[..., ::-1]), scene.thermal, CLASS_OF[scene.label])
    for kind, image in zip(FOLDERS, images, strict=True):
        write_png(folder / shot.part / kind / f"{shot.name}.png", image)
