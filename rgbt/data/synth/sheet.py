"""A contact sheet of scenes: ``python -m rgbt.data.synth.sheet out=sheet.png [key=value ...]``.

Rows RGB, thermal, label by day, then the same scenes by night. Keys: seed, first (index of the
first scene), columns, zoom, and every scene factor.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, nearest
from rgbt.config.values import check_value
from rgbt.data.synth.factors import SceneFactors
from rgbt.data.synth.scene import Scene, render_scene
from rgbt.ranges import Seed

COLOURS = np.array(
    [
        (40, 40, 40), (90, 60, 220), (230, 70, 60), (0, 170, 230), (60, 60, 255),
        (240, 220, 40), (150, 150, 200), (255, 140, 40), (250, 60, 200),
    ],
    np.uint8,
)  # fmt: skip
"""Loud colours, one per class; the published palette is too dark to be seen at this size."""


OWN: dict[str, Any] = {
    "seed": Seed,
    "first": Annotated[int, Interval(ge=0, le=99_999)],
    "columns": Annotated[int, Interval(ge=1, le=100)],
    "zoom": Annotated[int, Interval(ge=1, le=16)],
}


def contact_sheet(
    seed: int, first: int, factors: SceneFactors, columns: int = 5, zoom: int = 2
) -> NDArray[np.uint8]:
    """`columns` scenes by day above the same scenes by night.

    Args:
        seed: of the data set.
        first: index of the first scene.
        factors: what the scenes are made of; the share of night is not used.
        columns: scenes per row.
        zoom: enlargement.

    Returns:
        (6 zoom H, columns zoom W, 3) uint8, RGB.
    """
    blocks = []
    for share in (0.0, 1.0):
        chosen = replace(factors, night_share=share)
        scenes = [render_scene(seed, first + number, chosen) for number in range(columns)]
        blocks.append(np.hstack([_column(scene, zoom) for scene in scenes]))
    return np.vstack(blocks)


def _column(scene: Scene, zoom: int) -> NDArray[np.uint8]:
    height, width = scene.label.shape
    size = (width * zoom, height * zoom)
    thermal = np.repeat(scene.thermal[..., None], 3, axis=2)
    smooth = [
        cv2.resize(image, size, interpolation=cv2.INTER_CUBIC) for image in (scene.rgb, thermal)
    ]
    label = cv2.resize(COLOURS[scene.label], size, interpolation=cv2.INTER_NEAREST)
    return np.asarray(np.vstack([*smooth, label]), np.uint8)


def _parsed(arguments: list[str]) -> tuple[Path, dict[str, int], SceneFactors]:
    """Where to write, the sheet's own numbers, the factors."""
    own = {"seed": 0, "first": 0, "columns": 5, "zoom": 2}
    factors = asdict(SceneFactors())
    kinds = OWN | get_type_hints(SceneFactors, include_extras=True)
    out = Path("sheet.png")
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key == "out":
            out = Path(value)
        elif key in own:
            own[key] = check_value(key, _number(argument, value, int), kinds[key])
        elif key in factors:
            factors[key] = check_value(
                key, _number(argument, value, type(factors[key])), kinds[key]
            )
        else:
            known = nearest(key, ["out", *own, *factors])
            raise InputError(f"'{key}' is not a setting of the sheet; {known}.")
    return out, own, SceneFactors(**factors)


def _number(argument: str, value: str, kind: type[int] | type[float]) -> float:
    try:
        return kind(value)
    except ValueError:
        raise InputError(f"'{argument}': expected {kind.__name__}, got '{value}'.") from None


def main(arguments: list[str]) -> int:
    """Write the sheet; 2 after a mistake in the arguments."""
    try:
        out, own, factors = _parsed(arguments)
    except InputError as error:
        sys.stderr.write(f"rgbt: {error}\n")
        return 2
    sheet = contact_sheet(own["seed"], own["first"], factors, own["columns"], own["zoom"])
    if not out.parent.is_dir():
        sys.stderr.write(f"rgbt: out={out} cannot be written; name a PNG in an existing folder.\n")
        return 2
    out.write_bytes(cv2.imencode(out.suffix, sheet[..., ::-1])[1].tobytes())
    sys.stdout.write(f"{out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
