"""Writes scenes as the archives of Freiburg Thermal lay out theirs, with what is odd about them.

Thermal images are counts of 16 bits that end in slanted black margins, because the thermal camera
sees less than the RGB camera; labels of one sequence have another size than its frames; test
folders are spelt in two ways, and stamps there end in another 0 or not; test labels are arrays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.data.freiburg import CLASSES
from rgbt.data.freiburg_layout import LABEL, RGB, TEST_LABEL, THERMAL
from rgbt.data.synth.camera import Floats
from rgbt.data.synth.classes import freiburg_ids
from rgbt.data.synth.factors import SceneFactors
from rgbt.data.synth.scene import Scene, render_scene
from rgbt.data.synth.writer import bgr, write_each, write_image

VAL_SEQUENCE = "seq_04_day"
_DAY_SEQUENCES, _NIGHT_SEQUENCES = 4, 3
_PIECES = 2
"""Of each sequence."""

_LARGE_LABELS = "seq_01_day"
"""The sequence whose labels are twice the size of its frames."""

_TEST_FOLDERS = {False: ("ImagesRGB", "ImagesIR"), True: ("ImagesRgb", "ImagesIr")}
"""By day and at night."""

BLACK, WHITE = 21800, 23700
"""Counts of the grey levels 0 and 1, which some pixels lie beyond."""

_MARGINS = ((0.151, 0.0), (0.172, 1.0), (0.826, 1.0), (0.845, 0.0))
"""Corners (share of the width, of the height) of what the thermal camera sees, which leaves a few
pixels of the crop without."""

_IGNORE = CLASSES.index("ignore")


@dataclass(frozen=True, kw_only=True)
class FreiburgPlan:
    """What a written data set consists of; equal plans give equal files.

    Attributes:
        seed: of the data set.
        num_train_day: labelled frames by day.
        num_train_night: unlabelled frames at night.
        num_val: labelled frames of the day sequence that is held out.
        num_test: labelled frames for testing, half by day and half at night.
        factors: what the scenes are made of; the share of night is not used.
    """

    seed: int
    num_train_day: int
    num_train_night: int
    num_val: int
    num_test: int
    factors: SceneFactors

    def shots(self) -> tuple[FrameToWrite, ...]:
        """Every frame, numbered over all splits: no scene is in two of them."""
        parts: list[tuple[str, bool]] = [
            *_in_sequences("day", self.num_train_day, _DAY_SEQUENCES),
            *_in_sequences("night", self.num_train_night, _NIGHT_SEQUENCES),
            *((f"train/{VAL_SEQUENCE}/00", False) for _ in range(self.num_val)),
            *(("test/day", False) for _ in range(self.num_test - self.num_test // 2)),
            *(("test/night", True) for _ in range(self.num_test // 2)),
        ]
        return tuple(FrameToWrite(index, part, night) for index, (part, night) in enumerate(parts))


class FrameToWrite(NamedTuple):
    """One frame to be written: number of its scene, its folder, whether it is night."""

    scene: int
    part: str
    night: bool

    @property
    def stamp(self) -> str:
        """Seconds and nanoseconds, which end in the number of the frame in its burst: 0."""
        return f"{1_570_000_000 + 3 * self.scene}_{self.scene * 618_033_989 % 10**9:09d}0"


def _in_sequences(time: str, num: int, sequences: int) -> Iterator[tuple[str, bool]]:
    pieces = sequences * _PIECES
    for number in range(num):
        sequence, piece = divmod(number * pieces // num, _PIECES)
        yield f"train/seq_{sequence:02d}_{time}/{piece:02d}", time == "night"


def write(plan: FreiburgPlan, folder: Path) -> None:
    """Write the whole data set into `folder`, which exists; OSError if that is not possible."""
    shots = plan.shots()
    write_each(partial(_write_numbered, plan, shots, folder), len(shots))


def _write_numbered(
    plan: FreiburgPlan, shots: tuple[FrameToWrite, ...], folder: Path, number: int
) -> None:
    shot = shots[number]
    factors = replace(plan.factors, night_share=float(shot.night))
    scene = render_scene(plan.seed, shot.scene, factors)
    ids = freiburg_ids(scene.label, scene.material)
    seen = seen_in_thermal(*ids.shape)
    counts = np.where(seen, counts_of(scene.grey), np.uint16(0))
    write_shot = _write_test if shot.part.startswith("test/") else _write_training
    write_shot(shot, folder / shot.part, scene, ids, counts)


def _write_training(
    shot: FrameToWrite,
    piece: Path,
    scene: Scene,
    ids: NDArray[np.uint8],
    counts: NDArray[np.uint16],
) -> None:
    write_image(piece / RGB / f"{RGB}_{shot.stamp}.png", bgr(scene))
    write_image(piece / THERMAL / f"{THERMAL}_{shot.stamp}.png", counts)
    if shot.night:
        return
    if piece.parent.name == _LARGE_LABELS:
        ids = np.repeat(np.repeat(ids, 2, axis=0), 2, axis=1)
    write_image(piece / LABEL / f"{LABEL}_{shot.stamp}.png", ids)


def _write_test(
    shot: FrameToWrite, part: Path, scene: Scene, ids: NDArray[np.uint8], counts: NDArray[np.uint16]
) -> None:
    rgb, thermal = _TEST_FOLDERS[shot.night]
    of_thermal = shot.stamp if shot.night else shot.stamp.removesuffix("0")
    write_image(part / rgb / f"{shot.stamp}_rgb.png", bgr(scene))
    write_image(part / thermal / f"{of_thermal}_ir.png", counts)
    # By hand only that is labelled which both cameras see.
    label = np.where(counts > 0, ids, np.uint8(_IGNORE))
    path = part / TEST_LABEL / f"{shot.stamp}_rgb.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, label)


def counts_of(grey: Floats) -> NDArray[np.uint16]:
    """Counts (H, W) uint16 of grey levels: `BLACK` is 0 and `WHITE` is 1, in a straight line."""
    return np.rint(BLACK + (WHITE - BLACK) * grey.astype(np.float64)).astype(np.uint16)


def seen_in_thermal(height: int, width: int) -> NDArray[np.bool_]:
    """(H, W): whether the thermal camera sees a pixel of the frame; it never moves on its mount."""
    size = np.array([width - 1, height - 1])
    corners = np.rint(np.array(_MARGINS) * size).astype(np.int32)
    canvas = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(canvas, corners, 1)
    return canvas > 0
