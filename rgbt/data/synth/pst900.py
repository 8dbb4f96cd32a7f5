"""The data set `synth_pst900`, in the layout of the PST900 archive and read by its reader.

{train,test}/{rgb,thermal,labels}/NAME.png, NAME as in 58_bag21_rect_rgb_frame0000000440
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from rgbt.data.pst900 import CLASSES, PST900, Bags
from rgbt.data.synth.factors import NumScenes, SceneFactors, with_factors
from rgbt.data.synth.scene import Scene
from rgbt.data.synth.shapes import BUMP, CAR_STOP, COLOR_CONE, PERSON
from rgbt.data.synth.writer import VERSION, Images, Layout, Plan, Shot, bgr
from rgbt.ranges import Seed, Text

VAL_BAG = 20
"""The recording of the training part that scenes for validation lie in."""

_BAGS = {"train": range(1, VAL_BAG), "val": (VAL_BAG,), "test": (21, 22, 23, 24, 25)}
"""Recordings of each split; those for testing are the real ones."""

_FRAME_STEP = 10

_STANDS_FOR = {
    COLOR_CONE: "fire_extinguisher",
    CAR_STOP: "backpack",
    BUMP: "hand_drill",
    PERSON: "survivor",
}
"""Which object of a street stands for which of the four; everything else is background."""

CLASS_OF = np.array(
    [CLASSES.index(_STANDS_FOR.get(label, "background")) for label in range(9)], np.uint8
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

    These are streets and not tunnels. They imitate the files and the rarity of the four objects
    (about 1 % of the pixels each, as backpack and survivor in PST900; the other two are rarer
    there): traffic cones for fire extinguishers, car stops for backpacks, bumps for hand drills,
    persons for survivors. Results on them say nothing about PST900.

    Args and errors as of `rgbt.data.synth.dataset.synth`, without a second frame, and `val_bags` of
    `rgbt.data.pst900.PST900`; () makes "val" the test part, as in the releases, and leaves the
    scenes for validation in training.
    """
    numbers = {"num_train": num_train, "num_val": num_val, "num_test": num_test}
    plan = Plan(seed=seed, numbers=numbers, factors=factors)
    folder = str(LAYOUT.cached(plan, cache_dir))
    return PST900(folder, name="synth_pst900", num_classes=num_classes, val_bags=val_bags)


def _shots(plan: Plan) -> list[Shot]:
    shots = []
    for split, scenes in plan.splits:
        bags, part = _BAGS[split], "test" if split == "test" else "train"
        for number, scene in enumerate(scenes):
            bag = bags[number * len(bags) // len(scenes)]
            name = f"{scene}_bag{bag:02d}_rect_rgb_frame{scene * _FRAME_STEP:010d}"
            shots.append(Shot(scene, split, plan.is_night(scene), name, part))
    return shots


def _images(scene: Scene, shot: Shot) -> Images:
    return {
        f"{shot.folder}/rgb/{shot.name}.png": bgr(scene),
        f"{shot.folder}/thermal/{shot.name}.png": scene.thermal,
        f"{shot.folder}/labels/{shot.name}.png": CLASS_OF[scene.label],
    }


LAYOUT = Layout(
    name="synth_pst900", versions={"scenes": VERSION, "files": 1}, shots=_shots, images=_images
)
