"""Draw a contact sheet of scenes: ``rgbt scenes out=sheet.png [key=value ...]``.

Rows RGB, thermal, label by day, then the same scenes by night.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
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


@dataclass(frozen=True)
class Options(SceneFactors):
    """Options of the sheet, in addition to the factors of a scene."""

    out: Annotated[Path, Help("picture file to write, in an existing folder")] = Path("sheet.png")
    seed: Annotated[Seed, Help("seed of the data set")] = 0
    first: Annotated[int, Interval(ge=0, le=99_999), Help("index of the first scene")] = 0
    columns: Annotated[int, Interval(ge=1, le=100), Help("scenes per row")] = 5
    zoom: Annotated[int, Interval(ge=1, le=16), Help("enlargement")] = 2


def contact_sheet(
    seed: int, first: int, factors: SceneFactors, columns: int = 5, zoom: int = 2
) -> NDArray[np.uint8]:
    """`columns` scenes from `first` by day above the same scenes by night, enlarged by `zoom`.

    Returns (6 zoom H, columns zoom W, 3) uint8, RGB. The share of night in `factors` is not used.
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


def main(options: Options, overrides: list[str]) -> int:
    """Draw scenes of the embedded data set: RGB, thermal, label by day, then the same by night."""
    del overrides  # none is heeded
    factors = SceneFactors(
        **{each.name: getattr(options, each.name) for each in fields(SceneFactors)}
    )
    if not options.out.parent.is_dir():
        raise InputError(
            f"out={options.out} cannot be written; name a PNG file in an existing folder."
        )
    sheet = contact_sheet(options.seed, options.first, factors, options.columns, options.zoom)
    encoded = cv2.imencode(options.out.suffix, sheet[..., ::-1])[1]
    options.out.write_bytes(encoded.tobytes())
    sys.stdout.write(f"{options.out}\n")
    return 0


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
