"""The data set `synth_freiburg`, in the layout of Freiburg Thermal and read by its reader.

train/SEQUENCE/PIECE/{fl_rgb,fl_ir_aligned,fl_rgb_labels}/..._STAMP.png, no labels at night
test/{day,night}/{ImagesRGB,ImagesIR}/STAMP_{rgb,ir}.png, SegmentationClass/STAMP_rgb.npy

The files have the irregularities of the archives: thermal images are counts of 16 bits that end in
slanted black margins, because the thermal camera sees less than the RGB camera; labels of one
sequence have another size than its frames; test folders are spelt in two ways, and stamps there
end in another 0 or not; test labels are arrays.
"""

from __future__ import annotations

from typing import Annotated, Literal

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.data.freiburg import CLASSES, THERMAL_RANGE, CountRange, Crop, Freiburg
from rgbt.data.synth.camera import Floats
from rgbt.data.synth.factors import NumScenes, SceneFactors, with_factors
from rgbt.data.synth.materials import class_table, ids_in
from rgbt.data.synth.scene import Scene
from rgbt.data.synth.writer import VERSION, Images, Layout, Plan, Shot, bgr
from rgbt.ranges import Names, Seed, Text

VAL_SEQUENCE = "seq_04_day"
_SEQUENCES = {"train_day": 4, "train_night": 3}
_PIECES = 2
"""Of each sequence."""

_LARGE_LABELS = "train/seq_01_day/"
"""The sequence whose labels are twice the size of its frames."""

BLACK, WHITE = 21800, 23700
"""Counts of the grey levels 0 and 1, which some pixels lie beyond."""

_MARGINS = ((0.151, 0.0), (0.172, 1.0), (0.826, 1.0), (0.845, 0.0))
"""Corners (share of the width, of the height) of what the thermal camera sees, which leaves a few
pixels of the crop without."""

BY_LABEL = ("car", "person", "bicycle", "curb", "background", "fence", "background", "road")
"""Class of MFNet's labels 1 to 8."""

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

TABLE = class_table(CLASSES, BY_LABEL, OF_SCENERY)


@with_factors("night_share", height=98, width=288, field_of_view_deg=96.0)
def synth_freiburg(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: Text | None = None,
    num_classes: Literal[14] = 14,
    unscored: Names = ("background", "ignore"),
    crop: Crop | None = (1, 97, 48, 240),
    thermal_range: CountRange = THERMAL_RANGE,
    ignored_test: Names = ("ignore",),
    seed: Seed = 0,
    num_train_day: NumScenes = 300,
    num_train_night: NumScenes = 300,
    num_val: NumScenes = 40,
    num_test: Annotated[int, Interval(ge=2, le=30_000)] = 60,
    factors: SceneFactors,
) -> Freiburg:
    """The data set with these factors, generated on first use.

    Labels are exact, those for training too, which in the real data set a network has predicted.
    "ignore" is in test labels alone: what the thermal camera does not see.

    Args and errors as of `rgbt.data.synth.dataset.synth`, without a second frame and without
    `night_share`; settings of `rgbt.data.freiburg.Freiburg` are as there. `num_train_day` scenes
    are labelled, `num_train_night` others are not, `num_val` are labelled, by day and of a sequence
    of their own, and `num_test` are labelled, half by day and half at night.
    """
    numbers = {
        "num_train_day": num_train_day,
        "num_train_night": num_train_night,
        "num_val": num_val,
        "num_test": num_test,
    }
    return Freiburg(
        str(LAYOUT.cached(Plan(seed=seed, numbers=numbers, factors=factors), cache_dir)),
        name="synth_freiburg",
        num_classes=num_classes,
        unscored=unscored,
        crop=crop,
        thermal_range=thermal_range,
        ignored_test=ignored_test,
        val_sequences=(VAL_SEQUENCE,),
    )


def _shots(plan: Plan) -> list[Shot]:
    shots = []
    for split, scenes in plan.splits:
        for number, scene in enumerate(scenes):
            night = split == "train_night"
            if split == "val":
                folder = f"train/{VAL_SEQUENCE}/00"
            elif split == "test":
                night = number >= len(scenes) - len(scenes) // 2
                folder = f"test/{'night' if night else 'day'}"
            else:
                pieces = _SEQUENCES[split] * _PIECES
                sequence, piece = divmod(number * pieces // len(scenes), _PIECES)
                folder = f"train/seq_{sequence:02d}_{split.removeprefix('train_')}/{piece:02d}"
            # Seconds and nanoseconds, which end in the number of the frame in its burst: 0.
            stamp = f"{1_570_000_000 + 3 * scene}_{scene * 618_033_989 % 10**9:09d}0"
            shots.append(Shot(scene, split, night, stamp, folder))
    return shots


def _images(scene: Scene, shot: Shot) -> Images:
    folder, stamp = shot.folder, shot.name
    ids = freiburg_ids(scene)
    seen = seen_in_thermal(*ids.shape)
    counts = np.where(seen, counts_of(scene.grey), np.uint16(0))
    if shot.split == "test":
        rgb, thermal = ("ImagesRgb", "ImagesIr") if shot.night else ("ImagesRGB", "ImagesIR")
        of_thermal = stamp if shot.night else stamp.removesuffix("0")
        # By hand only that is labelled which both cameras see.
        label = np.where(counts > 0, ids, np.uint8(CLASSES.index("ignore")))
        return {
            f"{folder}/{rgb}/{stamp}_rgb.png": bgr(scene),
            f"{folder}/{thermal}/{of_thermal}_ir.png": counts,
            f"{folder}/SegmentationClass/{stamp}_rgb.npy": label,
        }
    images: Images = {
        f"{folder}/fl_rgb/fl_rgb_{stamp}.png": bgr(scene),
        f"{folder}/fl_ir_aligned/fl_ir_aligned_{stamp}.png": counts,
    }
    if not shot.night:
        larger = ids.repeat(2, axis=0).repeat(2, axis=1)
        label = larger if folder.startswith(_LARGE_LABELS) else ids
        images[f"{folder}/fl_rgb_labels/fl_rgb_labels_{stamp}.png"] = label
    return images


def freiburg_ids(scene: Scene) -> NDArray[np.uint8]:
    """Class ids of Freiburg Thermal, (H, W) uint8, 0 to 12."""
    return ids_in(TABLE, scene.label, scene.material)


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


LAYOUT = Layout(
    name="synth_freiburg",
    versions={"scenes": VERSION, "files": 1},
    shots=_shots,
    images=_images,
    named={},
)
