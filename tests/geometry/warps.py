"""Pairs whose thermal image is warped by a known homography, and the error of an estimate."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.geometry.alignment import grid_of, moved

Image = NDArray[Any]
Matrix = NDArray[np.float64]

MARGIN = 0.06  # share of both sides that is cut, so that warps show nothing invented


def inner(image: Image) -> Image:
    rows, columns = (int(side * MARGIN) for side in image.shape)
    return np.ascontiguousarray(image[rows : len(image) - rows, columns : image.shape[1] - columns])


def drawn_warp(generator: np.random.Generator, image: Image) -> Matrix:
    """A shift up to 2.5 % of the width, and of each corner up to 1 % further."""
    height, width = inner(image).shape
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]])
    shifts = generator.uniform(-0.025, 0.025, (1, 2)) + generator.uniform(-0.01, 0.01, (4, 2))
    ends = (corners + width * shifts).astype(np.float32)
    return np.asarray(cv2.getPerspectiveTransform(corners.astype(np.float32), ends), np.float64)


def warped(image: Image, matrix: Matrix) -> Image:
    """`inner` of an image whose point `matrix` p shows what p showed."""
    rows, columns = (int(side * MARGIN) for side in image.shape)
    cut = np.array([[1, 0, columns], [0, 1, rows], [0, 0, 1.0]])
    whole = cut @ matrix @ np.linalg.inv(cut)
    return inner(np.asarray(cv2.warpPerspective(image, whole, image.shape[::-1])))


def mean_error(found: Matrix, true: Matrix, image: Image) -> float:
    """Mean distance in pixels of where two homographies move the points of `inner`."""
    points = grid_of(inner(image).shape)
    return float(np.linalg.norm(moved(found, points) - moved(true, points), axis=1).mean())
