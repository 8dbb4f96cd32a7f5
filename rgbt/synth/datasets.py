"""The embedded data sets: one world in the layouts of four real data sets.

Each is written on first use and read by the ordinary reader of its layout. A further file of
``conf/dataset/`` with other factors is a preset: ``synth_calibrated`` is one of `synth`.
"""

from __future__ import annotations

from typing import Annotated, Literal

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data import freiburg, kp, pst900
from rgbt.data.freiburg import CountRange, Crop, Freiburg
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import PST900, Bags
from rgbt.ranges import Names, Seed, Text
from rgbt.synth.camera import Floats
from rgbt.synth.export import Images, Layout, ScenePlan, Shot, exported
from rgbt.synth.factors import (
    EgoMotion,
    ForwardMetres,
    NumScenes,
    SceneFactors,
    YawDegrees,
    with_factors,
)
from rgbt.synth.scene import Scene
from rgbt.synth.street import BUMP, CAR_STOP, COLOR_CONE, PERSON, UNLABELED, Table, class_table
from rgbt.types import SceneMaps


def _bgr(scene: Scene) -> NDArray[np.uint8]:
    """Return RGB in the order in which OpenCV stores channels."""
    return np.ascontiguousarray(scene.rgb[..., ::-1])


def _ids(table: Table, scene: Scene) -> NDArray[np.uint8]:
    ids = table[scene.label, scene.material]
    assert (ids != 255).all(), "every material of the scenery has a class"
    return ids


# Depth of the sky in a file, and of anything farther than 655 m.
SKY = 65535


class SceneDataset(MFNet):
    """Reads rendered scenes in MFNet's layout, with depth and objects of the test images."""

    def scene_maps(self, name: str) -> SceneMaps:
        """Read depth and objects of an image of the test split; InputError without such a file."""
        path = self.root / "scene" / f"{name}.png"
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if stored is None or stored.dtype != np.uint16 or stored.ndim != 3:
            raise InputError(f"{path}: no depth and objects of a rendered scene (test split).")
        # OpenCV reads the first channel of the file last.
        centimetres, number = stored[..., 2], stored[..., 1]
        depth = centimetres.astype(np.float32) / 100
        depth[centimetres == SKY] = np.inf
        return SceneMaps(depth, number.astype(np.int32))


@with_factors()
def synth(  # noqa: PLR0913 - each is a key of the configuration
    *,
    name: Text = "synth",
    cache_dir: Text | None = None,
    num_classes: Literal[9] = 9,
    seed: Seed = 0,
    num_train: NumScenes = 600,
    num_val: NumScenes = 100,
    num_test: NumScenes = 100,
    factors: SceneFactors,
    ego_forward_m: ForwardMetres | None = None,
    ego_yaw_deg: YawDegrees = 0.0,
) -> SceneDataset:
    """Return streets in MFNet's layout, generated on first use.

    images/00012D.png   four channels R, G, B, thermal       labels/00012D.png   class ids
    train.txt val.txt test.txt test_day.txt test_night.txt   one name per line
    scene/00012D.png    of test images: 16 bits, channels depth in centimetres, number of the object
    next/               the same names after the ego-motion, with flow/NAME.npy, if requested

    ``conf/dataset/synth.yaml`` says what each argument is; `factors` are given as keywords, see
    `SceneFactors`. InputError for a turn without a motion and a cache that cannot be written.
    """
    if ego_forward_m is None and ego_yaw_deg != 0:
        raise InputError("dataset.ego_yaw_deg requires dataset.ego_forward_m (0: on the spot).")
    motion = None if ego_forward_m is None else EgoMotion(ego_forward_m, ego_yaw_deg)
    numbers = {"train": num_train, "val": num_val, "test": num_test}
    plan = ScenePlan(name=name, seed=seed, numbers=numbers, factors=factors, motion=motion)
    folder = exported(MFNET_LAYOUT, plan, cache_dir)
    return SceneDataset(str(folder), name=name, num_classes=num_classes)


def _mfnet_named(shots: list[Shot]) -> list[Shot]:
    """Name shots by five digits and D (day) or N (night), as in MFNet."""
    return [s._replace(name=f"{s.scene:05d}{'N' if s.night else 'D'}") for s in shots]


def _mfnet_images(scene: Scene, shot: Shot) -> Images:
    written: Images = {
        # The fourth channel, alpha, is thermal.
        f"images/{shot.name}.png": np.dstack([_bgr(scene), scene.thermal]),
        f"labels/{shot.name}.png": scene.label,
    }
    if shot.split == "test":
        centimetres = np.minimum(np.rint(scene.depth * 100), SKY).astype(np.uint16)
        # Buildings and trees are objects of the drawing, but not of a class.
        labelled = (scene.owner >= 0) & (scene.label != UNLABELED)
        number = np.where(labelled, scene.owner + 1, 0).astype(np.uint16)
        maps = np.dstack([np.zeros_like(number), number, centimetres])
        written[f"scene/{shot.name}.png"] = maps
    return written


def _mfnet_lists(shot: Shot) -> dict[str, str]:
    """Return the list of its split, and that of the test split by day or at night."""
    time = "night" if shot.night else "day"
    lines = {f"{shot.split}.txt": shot.name}
    if shot.split == "test":
        lines[f"test_{time}.txt"] = shot.name
    return lines


MFNET_LAYOUT = Layout(_mfnet_named, _mfnet_images, _mfnet_lists)


_FRAMES_PER_VIDEO = 40
# (split, night) -> recordings that the CRM release gives to it.
_SETS = {
    ("train", False): (0, 1, 2),
    ("train", True): (3, 4, 5),
    ("val", False): (6,),
    ("val", True): (10,),
    ("test", False): (7, 8),
    ("test", True): (9, 11),
}

# Id of pixels without a class, after the last class; training and scores ignore it.
VOID = "void"

# Class of MFNet's labels 1 to 8; a person on a bicycle is a "rider".
_KP_LABELS = ("car", "person", "bicycle", "sidewalk", VOID, "fence", VOID, "road")

KP_TABLE = class_table([*kp.CLASSES, VOID], _KP_LABELS, "kp")


@with_factors(night_share=0.48)
def synth_kp(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: Text | None = None,
    num_classes: Literal[19] = 19,
    seed: Seed = 0,
    num_train: NumScenes = 400,
    num_val: NumScenes = 60,
    num_test: NumScenes = 80,
    factors: SceneFactors,
) -> KP:
    """Return streets in the layout of KP in the CRM release; arguments and errors as of `synth`.

    images/setXX/VYYY/{visible,lwir}/IZZZZZ.jpg   three channels each, those of lwir equal
    labels/setXX_VYYY_IZZZZZ.png                  class ids, 19 for void
    {train,val,test}{,_day,_night}.txt            one label file per line

    Where absent classes count as 0, no network scores more than 14 / 19 = 73.7 % (`kp_ids`).
    """
    numbers = {"train": num_train, "val": num_val, "test": num_test}
    plan = ScenePlan(name="synth_kp", seed=seed, numbers=numbers, factors=factors)
    return KP(str(exported(KP_LAYOUT, plan, cache_dir)), name=plan.name, num_classes=num_classes)


def _kp_named(shots: list[Shot]) -> list[Shot]:
    """Spread the scenes of one time of day over its recordings, in order."""
    named = []
    for night in (False, True):
        same = [shot for shot in shots if shot.night == night]
        for number, shot in enumerate(same):
            sets = _SETS[shot.split, shot.night]
            recording, video = sets[number * len(sets) // len(same)], number // _FRAMES_PER_VIDEO
            named.append(shot._replace(name=f"set{recording:02d}_V{video:03d}_I{shot.scene:05d}"))
    return sorted(named)


def _kp_images(scene: Scene, shot: Shot) -> Images:
    recording, video, frame = shot.name.split("_")
    folder = f"images/{recording}/{video}"
    return {
        f"{folder}/visible/{frame}.jpg": _bgr(scene),
        f"{folder}/lwir/{frame}.jpg": np.repeat(scene.thermal[..., None], 3, axis=2),
        f"labels/{shot.name}.png": kp_ids(scene),
    }


def _kp_lists(shot: Shot) -> dict[str, str]:
    time = "night" if shot.night else "day"
    line = f"{shot.name}.png"
    return {f"{shot.split}.txt": line, f"{shot.split}_{time}.txt": line}


KP_LAYOUT = Layout(_kp_named, _kp_images, _kp_lists)


def kp_ids(scene: Scene) -> NDArray[np.uint8]:
    """Return class ids of KP, those of Cityscapes: (H, W) uint8, 0 to 19.

    Five classes are never there: traffic_light, truck, bus, train, motorcycle; vans are cars as in
    Cityscapes. Guardrails are "fence" so that there is one; Cityscapes gives them no class.
    """
    ids = _ids(KP_TABLE, scene)
    ridden = [n for n, thing in enumerate(scene.placed) if thing.shape.name == "bike_ridden"]
    on_bike = (scene.label == PERSON) & np.isin(scene.owner, ridden)
    return np.where(on_bike, np.uint8(kp.CLASSES.index("rider")), ids)


# The recording of the training part that scenes for validation lie in.
VAL_BAG = 20

# Recordings of each split; those for testing are the real ones.
_BAGS = {"train": range(1, VAL_BAG), "val": (VAL_BAG,), "test": (21, 22, 23, 24, 25)}

_FRAME_STEP = 10
# Which object of a street stands for which of the four; others are background.
_STANDS_FOR = {
    COLOR_CONE: "fire_extinguisher",
    CAR_STOP: "backpack",
    BUMP: "hand_drill",
    PERSON: "survivor",
}

PST900_IDS = np.array(
    [pst900.CLASSES.index(_STANDS_FOR.get(label, "background")) for label in range(9)], np.uint8
)


@with_factors(width=214, field_of_view_deg=80.0)
def synth_pst900(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: Text | None = None,
    num_classes: Literal[5] = 5,
    val_bags: Bags = (VAL_BAG,),
    seed: Seed = 0,
    num_train: NumScenes = 400,
    num_val: NumScenes = 50,
    num_test: NumScenes = 80,
    factors: SceneFactors,
) -> PST900:
    """Return streets in the layout of PST900; arguments and errors as of `synth` and `PST900`.

    {train,test}/{rgb,thermal,labels}/NAME.png, NAME as in 58_bag21_rect_rgb_frame0000000440

    These are streets and not tunnels. They imitate the files and the rarity of the four objects
    (about 1 % of the pixels each). ``val_bags=()`` leaves the scenes for validation in training.
    """
    numbers = {"train": num_train, "val": num_val, "test": num_test}
    plan = ScenePlan(name="synth_pst900", seed=seed, numbers=numbers, factors=factors)
    folder = str(exported(PST900_LAYOUT, plan, cache_dir))
    return PST900(folder, name=plan.name, num_classes=num_classes, val_bags=val_bags)


def _pst900_named(shots: list[Shot]) -> list[Shot]:
    named = []
    for shot in shots:
        bags = _BAGS[shot.split]
        bag, frame = bags[shot.place * len(bags) // shot.total], shot.scene * _FRAME_STEP
        name = f"{shot.scene}_bag{bag:02d}_rect_rgb_frame{frame:010d}"
        named.append(shot._replace(name=name, folder="test" if shot.split == "test" else "train"))
    return named


def _pst900_images(scene: Scene, shot: Shot) -> Images:
    return {
        f"{shot.folder}/rgb/{shot.name}.png": _bgr(scene),
        f"{shot.folder}/thermal/{shot.name}.png": scene.thermal,
        f"{shot.folder}/labels/{shot.name}.png": PST900_IDS[scene.label],
    }


PST900_LAYOUT = Layout(_pst900_named, _pst900_images)


VAL_SEQUENCE = "seq_04_day"
# Sequences of each split, and pieces of each of them.
_SEQUENCES, _PIECES = {"train_day": 4, "train_night": 3}, 2

# The sequence whose labels are twice the size of its frames.
_LARGE_LABELS = "train/seq_01_day/"

# Counts of the grey levels 0 and 1, which some pixels lie beyond.
BLACK, WHITE = 21800, 23700

# Corners (share of the width, of the height) of what the thermal camera sees.
_MARGINS = ((0.151, 0.0), (0.172, 1.0), (0.826, 1.0), (0.845, 0.0))

_FREIBURG_LABELS = ["car", "person", "bicycle", "curb", "background", "fence", "background", "road"]
FREIBURG_TABLE = class_table(freiburg.CLASSES, _FREIBURG_LABELS, "freiburg")


@with_factors("night_share", height=98, width=288, field_of_view_deg=96.0)
def synth_freiburg(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: Text | None = None,
    num_classes: Literal[14] = 14,
    unscored: Names = ("background", "ignore"),
    crop: Crop | None = (1, 97, 48, 240),
    thermal_range: CountRange = freiburg.THERMAL_RANGE,
    ignored_test: Names = ("ignore",),
    seed: Seed = 0,
    num_train_day: NumScenes = 300,
    num_train_night: NumScenes = 300,
    num_val: NumScenes = 40,
    num_test: Annotated[int, Interval(ge=2, le=30_000)] = 60,
    factors: SceneFactors,
) -> Freiburg:
    """Return streets in the layout of Freiburg; arguments and errors as of `synth` and `Freiburg`.

    train/SEQUENCE/PIECE/{fl_rgb,fl_ir_aligned,fl_rgb_labels}/..._STAMP.png, no labels at night
    test/{day,night}/{ImagesRGB,ImagesIR}/STAMP_{rgb,ir}.png, SegmentationClass/STAMP_rgb.npy

    The files have the irregularities of the archives: thermal images are counts of 16 bits that end
    in slanted black margins, because the thermal camera sees less than the RGB camera; labels of
    one sequence have another size than its frames; test folders are spelt in two ways, and stamps
    there end in another 0 or not; test labels are arrays. "ignore" is in test labels alone: what
    the thermal camera does not see.
    """
    numbers = {"train_day": num_train_day, "train_night": num_train_night}
    numbers |= {"val": num_val, "test": num_test}
    plan = ScenePlan(name="synth_freiburg", seed=seed, numbers=numbers, factors=factors)
    return Freiburg(
        str(exported(FREIBURG_LAYOUT, plan, cache_dir)),
        name=plan.name,
        num_classes=num_classes,
        unscored=unscored,
        crop=crop,
        thermal_range=thermal_range,
        ignored_test=ignored_test,
        val_sequences=(VAL_SEQUENCE,),
    )


def _freiburg_named(shots: list[Shot]) -> list[Shot]:
    """Name days, nights for training, and a test split whose second half is at night."""
    named = []
    for shot in shots:
        night, folder = shot.split == "train_night", f"train/{VAL_SEQUENCE}/00"
        if shot.split == "test":
            night = shot.place >= shot.total - shot.total // 2
            folder = f"test/{'night' if night else 'day'}"
        elif shot.split != "val":
            pieces = _SEQUENCES[shot.split] * _PIECES
            sequence, piece = divmod(shot.place * pieces // shot.total, _PIECES)
            time = shot.split.removeprefix("train_")
            folder = f"train/seq_{sequence:02d}_{time}/{piece:02d}"
        # Seconds and nanoseconds, which end in the number of the frame in its burst: 0.
        stamp = f"{1_570_000_000 + 3 * shot.scene}_{shot.scene * 618_033_989 % 10**9:09d}0"
        named.append(shot._replace(night=night, name=stamp, folder=folder))
    return named


def _freiburg_images(scene: Scene, shot: Shot) -> Images:
    folder, stamp = shot.folder, shot.name
    ids = _ids(FREIBURG_TABLE, scene)
    counts = np.where(seen_in_thermal(*ids.shape), counts_of(scene.grey), np.uint16(0))
    if shot.split == "test":
        rgb, thermal = ("ImagesRgb", "ImagesIr") if shot.night else ("ImagesRGB", "ImagesIR")
        of_thermal = stamp if shot.night else stamp.removesuffix("0")
        # People label only what both cameras see.
        label = np.where(counts > 0, ids, np.uint8(freiburg.CLASSES.index("ignore")))
        return {
            f"{folder}/{rgb}/{stamp}_rgb.png": _bgr(scene),
            f"{folder}/{thermal}/{of_thermal}_ir.png": counts,
            f"{folder}/SegmentationClass/{stamp}_rgb.npy": label,
        }
    images: Images = {
        f"{folder}/fl_rgb/fl_rgb_{stamp}.png": _bgr(scene),
        f"{folder}/fl_ir_aligned/fl_ir_aligned_{stamp}.png": counts,
    }
    if not shot.night:
        if folder.startswith(_LARGE_LABELS):
            ids = ids.repeat(2, axis=0).repeat(2, axis=1)
        images[f"{folder}/fl_rgb_labels/fl_rgb_labels_{stamp}.png"] = ids
    return images


FREIBURG_LAYOUT = Layout(_freiburg_named, _freiburg_images)


def counts_of(grey: Floats) -> NDArray[np.uint16]:
    """Convert grey levels to counts (H, W) uint16: `BLACK` is 0 and `WHITE` 1, in a line."""
    return np.rint(BLACK + (WHITE - BLACK) * grey.astype(np.float64)).astype(np.uint16)


def seen_in_thermal(height: int, width: int) -> NDArray[np.bool_]:
    """Say whether the thermal camera, which never moves on its mount, sees a pixel; (H, W)."""
    size = np.array([width - 1, height - 1])
    corners = np.rint(np.array(_MARGINS) * size).astype(np.int32)
    canvas = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(canvas, corners, 1)
    return canvas > 0
