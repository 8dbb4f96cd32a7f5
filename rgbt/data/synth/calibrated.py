"""The data set `synth_calibrated`: scenes whose statistics are close to those of real pairs.

It has the layout of `synth`, further factors, and for each test image the depth and the object of
every pixel: scene/NAME.png, 16 bits, channels depth in centimetres and number of the object.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.data.synth.dataset import ego_motion, images, shots, split_lists
from rgbt.data.synth.factors import (
    ForwardMetres,
    NumScenes,
    SceneFactors,
    YawDegrees,
    with_factors,
)
from rgbt.data.synth.scene import Scene
from rgbt.data.synth.shapes import UNLABELED
from rgbt.data.synth.writer import VERSION, Images, Layout, Plan, Shot
from rgbt.ranges import Seed, Text
from rgbt.types import SceneMaps

SKY = 65535
"""Depth of the sky in a file, and of anything farther than 655 m."""


class SceneDataset(MFNet):
    """Rendered scenes in MFNet's layout, with depth and objects of the test images."""

    def scene_maps(self, name: str) -> SceneMaps:
        """Depth and objects of an image of the test split.

        Raises:
            InputError: an image without such a file.
        """
        path = self.root / "scene" / f"{name}.png"
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if stored is None or stored.dtype != np.uint16 or stored.ndim != 3:
            raise InputError(
                f"{path}: expected depth and objects of a rendered scene (16 bits, three "
                "channels). They exist for the test split; if the file is damaged, remove the "
                "folder of the data set."
            )
        # OpenCV reads the first channel of the file last.
        centimetres, number = stored[..., 2], stored[..., 1]
        depth = centimetres.astype(np.float32) / 100
        depth[centimetres == SKY] = np.inf
        return SceneMaps(depth, number.astype(np.int32))


@with_factors(calibrated=True)
def synth_calibrated(  # noqa: PLR0913 - each is a key of the configuration
    *,
    cache_dir: Text | None = None,
    num_classes: Literal[9] = 9,
    seed: Seed = 0,
    num_train: NumScenes = 600,
    num_val: NumScenes = 100,
    num_test: NumScenes = 100,
    factors: SceneFactors,
    ego_forward_m: ForwardMetres | None = None,
    ego_yaw_deg: YawDegrees = 0.0,
) -> MFNet:
    """The calibrated data set with these factors, generated on first use.

    Args:
        cache_dir: folder that holds written data sets, see `synth`.
        num_classes: MFNet's nine.
        seed: of the data set.
        num_train: scenes of the training split.
        num_val: scenes of the validation split.
        num_test: scenes of the test split.
        factors: given as keywords, from `height` to `whole_shadows`; see `SceneFactors`.
        ego_forward_m: motion to a second frame, see `synth`.
        ego_yaw_deg: turn of that motion.

    Returns:
        the reader of the written folder.

    Raises:
        InputError: a factor out of range, a turn without a motion, a cache that cannot be written.
    """
    motion = ego_motion(ego_forward_m, ego_yaw_deg)
    numbers = {"num_train": num_train, "num_val": num_val, "num_test": num_test}
    plan = Plan(seed=seed, numbers=numbers, factors=factors, motion=motion)
    folder = LAYOUT.cached(plan, cache_dir)
    return SceneDataset(str(folder), name="synth_calibrated", num_classes=num_classes)


def _images(scene: Scene, shot: Shot) -> Images:
    written = images(scene, shot)
    if shot.split == "test":
        written[f"scene/{shot.name}.png"] = _maps(scene)
    return written


def _maps(scene: Scene) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    """(H, W, 3) uint16 in OpenCV's order: 0, object, depth."""
    centimetres = np.minimum(np.rint(scene.depth * 100), SKY).astype(np.uint16)
    # Buildings and trees are objects of the drawing, but not of a class.
    labelled = (scene.owner >= 0) & (scene.label != UNLABELED)
    number = np.where(labelled, scene.owner + 1, 0).astype(np.uint16)
    return np.dstack([np.zeros_like(number), number, centimetres])


LAYOUT = Layout(
    name="synth_calibrated",
    versions={"version": VERSION, "calibrated": 1},
    shots=shots,
    images=_images,
    lists=split_lists,
)
