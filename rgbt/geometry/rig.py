"""Where a point of one camera of a rig lies in the other one, by a homography or a calibration.

Points are (x, y) in pixels, (N, 2) float64; pixel centres lie at whole numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.geometry.alignment import HW, Floats, inverse, moved, resizing

# What a calibration holds: shape of each entry, None: a vector of 4, 5, 8, 12 or 14 numbers.
CALIBRATION: dict[str, tuple[int, ...] | None] = {
    "K_rgb": (3, 3),
    "D_rgb": None,
    "K_thermal": (3, 3),
    "D_thermal": None,
    "R": (3, 3),
    "t": (3,),
    "distance": (1,),
}
DISTORTIONS = (4, 5, 8, 12, 14)  # lengths that OpenCV reads


Move = Callable[[Floats], Floats]
Rig = tuple[Move, Move]  # points of RGB to thermal, and back

# Pixels of an image between neighbouring pixels of another, from which it is averaged first.
COARSER = 1.5


def of_homography(matrix: Floats) -> Rig:
    """Return the rig of a homography (3, 3); InputError if it cannot be inverted."""
    if abs(np.linalg.det(matrix)) < 1e-12 or not np.isfinite(matrix).all():
        raise InputError("matrix: H cannot be inverted.")
    return partial(moved, matrix), partial(moved, inverse(matrix))


def of_calibration(values: Mapping[str, Any]) -> Rig:
    """Return the rig of two calibrated cameras, for what lies in one plane in front of RGB.

        X_thermal = R X_rgb + t,  Z_rgb = distance

    `values` has the entries of `CALIBRATION`; lengths in one unit. InputError: one is missing, has
    another shape, or the plane is behind the camera.
    """
    arrays: dict[str, Floats] = {}
    for key, shape in CALIBRATION.items():
        if key not in values:
            raise InputError(f"matrix: no entry '{key}'; expected H, or {', '.join(CALIBRATION)}.")
        array = np.asarray(values[key], np.float64)
        fits = array.size in DISTORTIONS if shape is None else array.size == np.prod(shape)
        if not fits or not np.isfinite(array).all():
            raise InputError(f"matrix: '{key}' has {array.size} numbers, or one is not finite.")
        arrays[key] = array.reshape(shape or -1)
    if arrays["distance"][0] <= 0:
        raise InputError("matrix: 'distance' is not positive.")
    thermal, rgb = (arrays["K_thermal"], arrays["D_thermal"]), (arrays["K_rgb"], arrays["D_rgb"])
    rotation, shift, distance = arrays["R"], arrays["t"], arrays["distance"][0]

    def to_thermal(points: Floats) -> Floats:
        found = cv2.projectPoints(distance * _rays(points, *rgb), rotation, shift, *thermal)[0]
        return np.asarray(found[:, 0])

    def to_rgb(points: Floats) -> Floats:
        rays, back = _rays(points, *thermal) @ rotation, rotation.T @ shift
        scene = rays * ((distance + back[2]) / rays[:, 2:]) - back
        return np.asarray(cv2.projectPoints(scene, np.eye(3), np.zeros(3), *rgb)[0][:, 0])

    return to_thermal, to_rgb


def _rays(points: Floats, matrix: Floats, distortion: Floats) -> Floats:
    found = cv2.undistortPoints(np.asarray(points, np.float64)[:, None], matrix, distortion)[:, 0]
    return np.hstack([found, np.ones((len(found), 1))])


def maps_of(move: Move, hw: HW, other_hw: HW) -> tuple[Any, Any]:
    """Return where the pixels of an image (H, W) lie in the other one, and which lie inside it.

    The maps for `cv2.remap`, (H, W, 2) float32, and (H, W) bool.
    """
    rows, columns = np.indices(hw, np.float64)
    found = move(np.stack([columns.ravel(), rows.ravel()], 1)).reshape(*hw, 2)
    ends = np.array(other_hw[::-1]) - 0.5
    inside = ((found >= -0.5) & (found <= ends)).all(-1)
    return found.astype(np.float32), inside


def resampled(
    image: NDArray[Any], maps: NDArray[np.float32], *, nearest: bool = False
) -> NDArray[Any]:
    """Take an image (H', W', ...) at `maps` (H, W, 2); its border continues outside.

    An image of many more pixels is averaged to their size first, but for `nearest`: of its values
    none is made.
    """
    how, hw = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR, image.shape[:2]
    step = float(np.median(np.linalg.norm(np.diff(maps, axis=1), axis=2)))
    if step > COARSER and not nearest:
        small_hw = max(round(hw[0] / step), 1), max(round(hw[1] / step), 1)
        image = cv2.resize(image, small_hw[::-1], interpolation=cv2.INTER_AREA)
        maps = cv2.transform(maps, resizing(hw, small_hw)[:2])
    columns, rows = cv2.split(maps)
    return np.asarray(cv2.remap(image, columns, rows, how, borderMode=cv2.BORDER_REPLICATE))
