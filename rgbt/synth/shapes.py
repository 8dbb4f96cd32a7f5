"""The tables of materials and shapes: ``materials.csv`` and ``shapes.csv`` beside this module.

Materials have a reflectance, degrees above the air by day and at night, further degrees when the
object is warm (engine on, a body), amplitudes of the texture in RGB (relative) and in degrees, the
light that they give off at night (1 = white of the day), whether nothing heats them but the sun,
and the class of scenery made of them in KP and in Freiburg Thermal. Temperatures are plausible, not
measured. An object's paint takes the place of the reflectance on painted parts.

Shapes are flat, convex faces in drawing order, one a line: x right, y up, z ahead (away from the
camera for yaw 0), metres, standing on y = 0; `thin` ones are seen from both sides, the others from
outside, where their normals point.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

UNLABELED, CAR, PERSON, BIKE, CURVE, CAR_STOP, GUARDRAIL, COLOR_CONE, BUMP = range(9)
"""MFNet's label ids."""

MAX_CORNERS = 8
"""Faces are padded to this many corners by repeating the last one."""


def _rows(name: str) -> list[dict[str, str]]:
    with Path(__file__).with_name(name).open(newline="") as lines:
        return list(csv.DictReader(lines))


_MATERIALS = _rows("materials.csv")
INDEX = {row["name"]: number for number, row in enumerate(_MATERIALS)}
"""Material -> number. The sky comes first: index 0 is what is seen where nothing is drawn."""


def column(*fields: str) -> NDArray[np.float32]:
    """Columns of the table of materials: (M,) of one, (M, n) of several; rows as in `INDEX`."""
    values = [[float(row[field]) for field in fields] for row in _MATERIALS]
    found = np.array(values, np.float32)
    return found[:, 0] if len(fields) == 1 else found


COLOURS = column("red", "green", "blue")

Table = NDArray[np.uint8]
"""(labels, materials) -> class id."""

ELSEWHERE = 255
"""Of materials that only labelled objects are made of."""


def class_table(classes: Sequence[str], by_label: Sequence[str], scenery: str) -> Table:
    """The class of every pair of label and material; ids follow the order of `classes`.

    By label where one is: tyres and glass belong to a car or a bike, which only the label tells.
    Else by material: curbs, plants and the sky have materials of their own.

    `by_label` has the classes of MFNet's labels from 1 on; `scenery` is the column of the table of
    materials for what MFNet leaves unlabelled (0).
    """
    table = np.full((1 + len(by_label), len(INDEX)), ELSEWHERE, np.uint8)
    for number, row in enumerate(_MATERIALS):
        if row[scenery]:
            table[0, number] = classes.index(row[scenery])
    for label, name in enumerate(by_label, 1):
        table[label] = classes.index(name)
    return table


@dataclass(frozen=True, eq=False)
class Shape:
    """The faces of one kind of object, as arrays in drawing order.

    Attributes:
        name: in the table.
        corners: (F, 8, 3) float32.
        num_corners: (F,) int.
        meta: (F, 4) int: material index, label, paint (0: the material's own colour, 1 or 2: the
            object's first or second), thin.
        half_width: half the extent along x, for shadows and collisions.
        half_length: half the extent along z.
        height: extent along y.
    """

    name: str
    corners: NDArray[np.float32]
    num_corners: NDArray[np.intp]
    meta: NDArray[np.intp]
    half_width: float
    half_length: float
    height: float

    @classmethod
    def of(cls, name: str, faces: Sequence[tuple[NDArray[np.float32], Sequence[int]]]) -> Shape:
        """The shape of faces: corners (n, 3) and a row of `meta` each."""
        counts = np.array([len(corners) for corners, _ in faces], np.intp)
        corners = np.stack(
            [np.pad(each, ((0, MAX_CORNERS - len(each)), (0, 0)), mode="edge") for each, _ in faces]
        )
        low, high = corners.min((0, 1)), corners.max((0, 1))
        half_width, height, half_length = np.maximum(np.abs(low), np.abs(high)).tolist()
        meta = np.array([row for _, row in faces], np.intp)
        return cls(name, corners, counts, meta, half_width, half_length, height)


@cache
def shapes() -> dict[str, Shape]:
    """Every shape of the table, by name."""
    found = {}
    for name, rows in groupby(_rows("shapes.csv"), key=lambda row: row["shape"]):
        faces = [
            (
                np.array(row["corners"].split(), np.float32).reshape(-1, 3),
                (INDEX[row["material"]], int(row["label"]), int(row["paint"]), int(row["thin"])),
            )
            for row in rows
        ]
        found[name] = Shape.of(name, faces)
    return found
