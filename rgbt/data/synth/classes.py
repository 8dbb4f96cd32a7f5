"""Class ids of other data sets of what a scene shows: by label where one is, else by material.

Tyres and glass belong to a car or a bike, which only the label tells; curbs, plants and the sky
have materials of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rgbt.data import freiburg, kp
from rgbt.data.synth import people
from rgbt.data.synth.materials import INDEX
from rgbt.data.synth.scene import Scene
from rgbt.data.synth.shapes import (
    BIKE,
    BUMP,
    CAR,
    CAR_STOP,
    COLOR_CONE,
    CURVE,
    GUARDRAIL,
    PERSON,
    UNLABELED,
)

ELSEWHERE = 255
"""Of materials that only labelled objects are made of."""

VOID = "void"
"""What has no class: the id after the last one, ignored in training and in every score."""

KP_BY_LABEL = {
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

KP_OF_SCENERY = {
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

FREIBURG_BY_LABEL = {
    CAR: "car",
    PERSON: "person",
    BIKE: "bicycle",
    CURVE: "curb",
    CAR_STOP: "background",
    GUARDRAIL: "fence",
    COLOR_CONE: "background",
    BUMP: "road",
}
"""Class of each label of MFNet but the unlabelled."""

FREIBURG_OF_SCENERY = {
    "road": ("asphalt", "patch", "line"),
    "sidewalk": ("paving",),
    "building": ("facade", "facade_side", "far_wall", "wall", "vent"),
    "pole": ("pole", "lamp", "transformer", "sign_blue", "sign_red", "sign_white"),
    "vegetation": ("leaf_dark", "leaf", "leaf_light", "bark"),
    "terrain": ("grass",),
    "sky": ("sky",),
    "background": ("manhole", "wire", "vending", "vending_body"),
}
"""Materials of what MFNet leaves unlabelled, by class."""

Table = NDArray[np.uint8]
"""(labels, materials) -> class id."""


def class_table(
    classes: Sequence[str], by_label: Mapping[int, str], of_scenery: Mapping[str, Sequence[str]]
) -> Table:
    """The class of every pair of label and material; ids follow the order of `classes`.

    `by_label` has the class of each label of MFNet but the unlabelled, `of_scenery` the materials
    of what MFNet leaves unlabelled, by class.
    """
    table = np.full((len(by_label) + 1, len(INDEX)), ELSEWHERE, np.uint8)
    for name, materials in of_scenery.items():
        table[UNLABELED, [INDEX[material] for material in materials]] = classes.index(name)
    for label, name in by_label.items():
        table[label] = classes.index(name)
    return table


def ids_in(table: Table, label: NDArray[np.uint8], material: NDArray[np.intp]) -> NDArray[np.uint8]:
    """Class ids (H, W) uint8 of a scene.

    Args:
        table: of `class_table`.
        label: (H, W) MFNet's.
        material: (H, W) index into `MATERIALS`.
    """
    ids = table[label, material]
    assert (ids != ELSEWHERE).all(), "every material of the scenery has a class"
    return ids


KP_TABLE = class_table([*kp.CLASSES, VOID], KP_BY_LABEL, KP_OF_SCENERY)
_FREIBURG_TABLE = class_table(freiburg.CLASSES, FREIBURG_BY_LABEL, FREIBURG_OF_SCENERY)


def kp_ids(scene: Scene) -> NDArray[np.uint8]:
    """Class ids of KP, those of Cityscapes: (H, W) uint8, 0 to 19.

    Of the 19 classes five are never there: traffic_light, truck, bus, train, motorcycle; vans are
    cars as in Cityscapes. Guardrails are "fence" so that there is one; Cityscapes gives them no
    class.
    """
    ids = ids_in(KP_TABLE, scene.label, scene.material)
    ridden = [n for n, thing in enumerate(scene.placed) if thing.shape is people.bike(True)]
    on_bike = (scene.label == PERSON) & np.isin(scene.owner, ridden)
    return np.where(on_bike, np.uint8(kp.CLASSES.index("rider")), ids)


def freiburg_ids(label: NDArray[np.uint8], material: NDArray[np.intp]) -> NDArray[np.uint8]:
    """Class ids of Freiburg Thermal, (H, W) uint8, 0 to 12; arguments as of `ids_in`."""
    return ids_in(_FREIBURG_TABLE, label, material)
