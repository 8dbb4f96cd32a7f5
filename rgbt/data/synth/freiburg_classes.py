"""The class ids of Freiburg Thermal of what a scene shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rgbt.data.freiburg import CLASSES
from rgbt.data.synth.classes import class_table, ids_in
from rgbt.data.synth.shapes import BIKE, BUMP, CAR, CAR_STOP, COLOR_CONE, CURVE, GUARDRAIL, PERSON

BY_LABEL = {
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

OF_SCENERY = {
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

_TABLE = class_table(CLASSES, BY_LABEL, OF_SCENERY)


def class_ids(label: NDArray[np.uint8], material: NDArray[np.intp]) -> NDArray[np.uint8]:
    """Class ids of Freiburg Thermal.

    Args:
        label: (H, W) MFNet's.
        material: (H, W) index into `MATERIALS`.

    Returns:
        (H, W) uint8, 0 to 12.
    """
    return ids_in(_TABLE, label, material)
