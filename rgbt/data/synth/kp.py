"""The data set `synth_kp`, in the layout of KP in the CRM release and read by its reader.

images/setXX/VYYY/{visible,lwir}/IZZZZZ.jpg   three channels each, those of lwir equal
labels/setXX_VYYY_IZZZZZ.png                  class ids, 19 for void
{train,val,test}{,_day,_night}.txt            one label file per line
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rgbt.data.kp import CLASSES, KP
from rgbt.data.synth import people
from rgbt.data.synth.factors import NumScenes, SceneFactors, with_factors
from rgbt.data.synth.materials import class_table, ids_in
from rgbt.data.synth.scene import Scene
from rgbt.data.synth.shapes import PERSON
from rgbt.data.synth.writer import VERSION, Images, Layout, Plan, Shot, bgr
from rgbt.ranges import Seed, Text

_FRAMES_PER_VIDEO = 40

_SETS = {
    ("train", False): (0, 1, 2),
    ("train", True): (3, 4, 5),
    ("val", False): (6,),
    ("val", True): (10,),
    ("test", False): (7, 8),
    ("test", True): (9, 11),
}
"""(split, night) -> recordings that the CRM release gives to it."""

VOID = "void"
"""What has no class: the id after the last one, ignored in training and in every score."""

BY_LABEL = ("car", "person", "bicycle", "sidewalk", VOID, "fence", VOID, "road")
"""Class of MFNet's labels 1 to 8; a person on a bicycle is a "rider"."""

OF_SCENERY = {
    "road": ("asphalt", "patch", "line", "manhole"),
    "sidewalk": ("paving",),
    "building": ("facade", "facade_side", "far_wall", "vent"),
    "wall": ("wall",),
    "pole": ("pole", "lamp", "transformer"),
    "traffic_sign": ("sign_blue", "sign_red", "sign_white"),
    "vegetation": ("leaf_dark", "leaf", "leaf_light", "bark"),
    "terrain": ("grass",),
    "sky": ("sky",),
    VOID: ("wire", "vending", "vending_body"),
}
"""Materials of what MFNet leaves unlabelled, by class."""

TABLE = class_table([*CLASSES, VOID], BY_LABEL, OF_SCENERY)


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

    Five of the 19 classes are in no scene (see `kp_ids`): where absent classes count as 0, as in
    the published tables, no network scores more than 14 / 19 = 73.7 %.

    Args and errors as of `rgbt.data.synth.dataset.synth`, without a second frame.
    """
    numbers = {"num_train": num_train, "num_val": num_val, "num_test": num_test}
    plan = Plan(seed=seed, numbers=numbers, factors=factors)
    return KP(str(LAYOUT.cached(plan, cache_dir)), name="synth_kp", num_classes=num_classes)


def _shots(plan: Plan) -> list[Shot]:
    shots = []
    for split, scenes in plan.splits:
        nights = [plan.is_night(scene) for scene in scenes]
        for number, (scene, night) in enumerate(zip(scenes, nights, strict=True)):
            # How many scenes of the same time of day come before this one.
            before = nights[:number].count(night)
            sets = _SETS[split, night]
            recording = sets[before * len(sets) // nights.count(night)]
            name = f"set{recording:02d}_V{before // _FRAMES_PER_VIDEO:03d}_I{scene:05d}"
            shots.append(Shot(scene, split, night, name))
    return shots


def _images(scene: Scene, shot: Shot) -> Images:
    recording, video, frame = shot.name.split("_")
    folder = f"images/{recording}/{video}"
    return {
        f"{folder}/visible/{frame}.jpg": bgr(scene),
        f"{folder}/lwir/{frame}.jpg": np.repeat(scene.thermal[..., None], 3, axis=2),
        f"labels/{shot.name}.png": kp_ids(scene),
    }


def _lists(shots: Sequence[Shot]) -> dict[str, list[str]]:
    lists: dict[str, list[str]] = {}
    for shot in sorted(shots, key=lambda shot: shot.name):
        for suffix in ("", "_night" if shot.night else "_day"):
            lists.setdefault(f"{shot.split}{suffix}.txt", []).append(f"{shot.name}.png")
    return lists


def kp_ids(scene: Scene) -> NDArray[np.uint8]:
    """Class ids of KP, those of Cityscapes: (H, W) uint8, 0 to 19.

    Of the 19 classes five are never there: traffic_light, truck, bus, train, motorcycle; vans are
    cars as in Cityscapes. Guardrails are "fence" so that there is one; Cityscapes gives them no
    class.
    """
    ids = ids_in(TABLE, scene.label, scene.material)
    ridden = [n for n, thing in enumerate(scene.placed) if thing.shape is people.bike(True)]
    on_bike = (scene.label == PERSON) & np.isin(scene.owner, ridden)
    return np.where(on_bike, np.uint8(CLASSES.index("rider")), ids)


LAYOUT = Layout(
    name="synth_kp",
    versions={"scenes": VERSION, "files": 1},
    shots=_shots,
    images=_images,
    lists=_lists,
)
