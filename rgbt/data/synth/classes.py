"""Class ids of other data sets of what a scene shows: by label where one is, else by material.

Tyres and glass belong to a car or a bike, which only the label tells; curbs, plants and the sky
have materials of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rgbt.data.synth.materials import INDEX
from rgbt.data.synth.shapes import UNLABELED

ELSEWHERE = 255
"""Of materials that only labelled objects are made of."""

Table = NDArray[np.uint8]
"""(labels, materials) -> class id."""


def class_table(
    classes: Sequence[str], by_label: Mapping[int, str], of_scenery: Mapping[str, Sequence[str]]
) -> Table:
    """The class of every pair of label and material.

    Args:
        classes: names in the order of their ids.
        by_label: class of each label of MFNet but the unlabelled.
        of_scenery: materials of what MFNet leaves unlabelled, by class.
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
