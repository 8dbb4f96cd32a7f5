"""The class ids of Freiburg Thermal of what a scene shows: by material, and by label where one is.

Curbs, fences, poles, plants, sky have materials of their own; tyres and glass belong to a car or a
bike, which only the label tells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rgbt.data.freiburg import CLASSES
from rgbt.data.synth.materials import INDEX
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

_ELSEWHERE = 255
"""Of materials that only labelled objects are made of."""


def _table() -> NDArray[np.uint8]:
    """(labels, materials) -> class id."""
    table = np.full((len(BY_LABEL) + 1, len(INDEX)), _ELSEWHERE, np.uint8)
    for name, materials in OF_SCENERY.items():
        table[UNLABELED, [INDEX[material] for material in materials]] = CLASSES.index(name)
    for label, name in BY_LABEL.items():
        table[label] = CLASSES.index(name)
    return table


_TABLE = _table()


def class_ids(label: NDArray[np.uint8], material: NDArray[np.intp]) -> NDArray[np.uint8]:
    """Class ids of Freiburg Thermal.

    Args:
        label: (H, W) MFNet's.
        material: (H, W) index into `MATERIALS`.

    Returns:
        (H, W) uint8, 0 to 12.
    """
    ids = _TABLE[label, material]
    assert (ids != _ELSEWHERE).all(), "every material of the scenery has a class"
    return ids
