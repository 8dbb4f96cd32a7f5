"""The class ids of KP, those of Cityscapes, of what a scene shows.

Of the 19 classes five are never there: traffic_light, truck, bus, train, motorcycle; vans are cars
as in Cityscapes. Guardrails are "fence" so that there is one; Cityscapes gives them no class.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rgbt.data.kp import CLASSES
from rgbt.data.synth import people
from rgbt.data.synth.classes import class_table, ids_in
from rgbt.data.synth.scene import Scene
from rgbt.data.synth.shapes import BIKE, BUMP, CAR, CAR_STOP, COLOR_CONE, CURVE, GUARDRAIL, PERSON

VOID = "void"
"""What has no class: the id after the last one, ignored in training and in every score."""

BY_LABEL = {
    CAR: "car",
    PERSON: "person",
    BIKE: "bicycle",
    CURVE: "sidewalk",
    CAR_STOP: VOID,
    GUARDRAIL: "fence",
    COLOR_CONE: VOID,
    BUMP: "road",
}
"""Class of each label of MFNet but the unlabelled; a person on a bicycle is a "rider"."""

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

_TABLE = class_table([*CLASSES, VOID], BY_LABEL, OF_SCENERY)


def class_ids(scene: Scene) -> NDArray[np.uint8]:
    """Class ids of KP, (H, W) uint8, 0 to 19."""
    ids = ids_in(_TABLE, scene.label, scene.material)
    ridden = [n for n, thing in enumerate(scene.placed) if thing.shape is people.bike(True)]
    on_bike = (scene.label == PERSON) & np.isin(scene.owner, ridden)
    return np.where(on_bike, np.uint8(CLASSES.index("rider")), ids)
