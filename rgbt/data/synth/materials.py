"""The table of materials: colour, temperature, texture, glow, and class in other data sets.

Temperatures are degrees above the air: by day (sun-warmed), by night, and what running adds
(an engine, a body). They are plausible, not measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

RGB = tuple[float, float, float]


class Material(NamedTuple):
    """One row of the table.

    Attributes:
        colour: reflectance (R, G, B) in 0..1; an object's paint takes its place on painted parts.
        day: degrees above the air by day.
        night: degrees above the air by night.
        heat: further degrees when the object is warm (engine on, warm person).
        rgb_texture: relative amplitude of the texture in RGB.
        heat_texture: amplitude of the texture in degrees.
        glow: light (R, G, B) that it gives off by night, 1 = white of the day.
    """

    colour: RGB
    day: float
    night: float
    heat: float = 0.0
    rgb_texture: float = 0.12
    heat_texture: float = 0.3
    glow: RGB = (0.0, 0.0, 0.0)


MATERIALS: dict[str, Material] = {
    "sky": Material((0.0, 0.0, 0.0), -34, -30, rgb_texture=0, heat_texture=0),
    # ground
    "asphalt": Material((0.20, 0.20, 0.21), 6, 3, rgb_texture=0.15, heat_texture=1.0),
    "patch": Material((0.10, 0.10, 0.11), 8, 3.6, rgb_texture=0.2, heat_texture=0.8),
    "paving": Material((0.46, 0.42, 0.37), 4.5, 2, rgb_texture=0.16, heat_texture=0.9),
    "grass": Material((0.16, 0.26, 0.07), 2, -2.5, rgb_texture=0.6, heat_texture=1.6),
    "line": Material((0.78, 0.78, 0.75), 4.5, 2.6, rgb_texture=0.3),
    "kerb_top": Material((0.62, 0.60, 0.55), 5, 2.5, rgb_texture=0.15),
    "kerb_face": Material((0.42, 0.40, 0.37), 3, 3.5, rgb_texture=0.15),
    "manhole": Material((0.09, 0.09, 0.09), 12, 14, rgb_texture=0.25),
    "yellow": Material((0.85, 0.60, 0.05), 8, 3, rgb_texture=0.12),
    "black_band": Material((0.05, 0.05, 0.05), 12, 3),
    # background
    "facade": Material((0.5, 0.48, 0.44), 7, 5, rgb_texture=0.14, heat_texture=0.5),
    "facade_side": Material((0.36, 0.35, 0.33), 3, 3, rgb_texture=0.14, heat_texture=0.5),
    "far_wall": Material((0.36, 0.40, 0.46), -1, -2, rgb_texture=0.08),
    "wall": Material((0.55, 0.54, 0.50), 6, 3, rgb_texture=0.2, heat_texture=0.6),
    "leaf_dark": Material((0.055, 0.10, 0.025), -1, 0, rgb_texture=1.1, heat_texture=1.6),
    "leaf": Material((0.12, 0.21, 0.045), 0.5, 0.3, rgb_texture=0.9, heat_texture=1.6),
    "leaf_light": Material((0.22, 0.33, 0.07), 2, 0.3, rgb_texture=0.8, heat_texture=1.6),
    "bark": Material((0.12, 0.09, 0.06), 1, 1.5, rgb_texture=0.4, heat_texture=0.8),
    "pole": Material((0.36, 0.35, 0.34), 4, 1, rgb_texture=0.1),
    "wire": Material((0.05, 0.05, 0.06), -6, -6, rgb_texture=0),
    "lamp": Material((0.75, 0.75, 0.72), 5, 9, glow=(3.0, 2.7, 2.0)),
    "sign_blue": Material((0.05, 0.16, 0.50), 5, -2),
    "sign_red": Material((0.65, 0.06, 0.06), 5, -2),
    "sign_white": Material((0.80, 0.80, 0.78), 4, -2),
    "vending": Material((0.75, 0.75, 0.78), 8, 9, heat_texture=0.6, glow=(0.5, 0.55, 0.6)),
    "vending_body": Material((0.55, 0.10, 0.09), 9, 8),
    "vent": Material((0.45, 0.45, 0.45), 15, 18),
    # vehicles
    "paint": Material((0.5, 0.5, 0.5), 8, -3, heat=4, rgb_texture=0.04, heat_texture=0.4),
    "hood": Material((0.5, 0.5, 0.5), 9, -3, heat=17, rgb_texture=0.04, heat_texture=0.4),
    "glass": Material((0.07, 0.09, 0.11), -4, -8, heat=3, rgb_texture=0.1, heat_texture=0.2),
    "trim": Material((0.05, 0.05, 0.055), 5, -1, heat=10, rgb_texture=0.05),
    "underside": Material((0.02, 0.02, 0.02), 4, 3, heat=14, rgb_texture=0.0),
    "tyre": Material((0.03, 0.03, 0.03), 7, 0, heat=15, rgb_texture=0.1),
    "rim": Material((0.45, 0.45, 0.47), 5, -1, heat=17, rgb_texture=0.05),
    "headlamp": Material((0.85, 0.87, 0.90), 5, -1, heat=14, glow=(4.0, 3.8, 3.2)),
    "tail_lamp": Material((0.55, 0.04, 0.03), 6, -1, heat=10, glow=(2.2, 0.12, 0.06)),
    "plate": Material((0.85, 0.85, 0.80), 4, -3),
    # people
    "skin": Material((0.60, 0.40, 0.30), 13, 18, heat=3, rgb_texture=0.05, heat_texture=0.5),
    "hair": Material((0.045, 0.035, 0.03), 9, 11, heat=3, rgb_texture=0.1),
    "cloth": Material((0.3, 0.3, 0.3), 6, 5, heat=10, rgb_texture=0.18, heat_texture=0.9),
    "trousers": Material((0.2, 0.2, 0.25), 6, 4, heat=9, rgb_texture=0.15, heat_texture=0.8),
    "shoe": Material((0.06, 0.05, 0.05), 4, 2, heat=3),
    "bag": Material((0.10, 0.10, 0.12), 3, 1, heat=1),
    # street furniture
    "metal": Material((0.42, 0.43, 0.45), 7, -3, rgb_texture=0.05),
    "spokes": Material((0.24, 0.25, 0.26), 6, -1, rgb_texture=0.25),
    "saddle": Material((0.06, 0.05, 0.05), 8, -1),
    "cone_orange": Material((0.85, 0.17, 0.03), 6, -2, rgb_texture=0.08),
    "cone_white": Material((0.88, 0.88, 0.86), 3, -3, rgb_texture=0.05),
    "cone_base": Material((0.12, 0.05, 0.03), 8, -1),
    "rail_light": Material((0.80, 0.81, 0.82), 5, -4, rgb_texture=0.06),
    "rail_dark": Material((0.46, 0.48, 0.52), 4, -4, rgb_texture=0.06),
    "rail_mesh": Material((0.30, 0.34, 0.36), 3, -2, rgb_texture=0.25),
    # last, so that all above keep their numbers
    "transformer": Material((0.45, 0.45, 0.45), 15, 18),
}
"""Name -> material. The sky comes first: index 0 is what is seen where nothing is drawn."""

INDEX = {name: number for number, name in enumerate(MATERIALS)}


def column(field: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """One column of the table: (M,) or (M, 3) float32 in the order of `INDEX`."""
    return np.array([getattr(material, field) for material in MATERIALS.values()], np.float32)


ELSEWHERE = 255
"""Of materials that only labelled objects are made of."""

Table = NDArray[np.uint8]
"""(labels, materials) -> class id."""


def class_table(
    classes: Sequence[str], by_label: Sequence[str], of_scenery: Mapping[str, Sequence[str]]
) -> Table:
    """The class of every pair of label and material; ids follow the order of `classes`.

    By label where one is: tyres and glass belong to a car or a bike, which only the label tells.
    Else by material: curbs, plants and the sky have materials of their own.

    `by_label` has the classes of MFNet's labels from 1 on, `of_scenery` the materials of what MFNet
    leaves unlabelled (0), by class.
    """
    table = np.full((1 + len(by_label), len(INDEX)), ELSEWHERE, np.uint8)
    for name, materials in of_scenery.items():
        table[0, [INDEX[material] for material in materials]] = classes.index(name)
    for label, name in enumerate(by_label, 1):
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
