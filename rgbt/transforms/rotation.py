"""Rotation of images and labels about their centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Rotation:
    """A rotation of everything of one size.

    Attributes:
        image_hw: rows and columns, before and after.
        angle: in degrees, counter-clockwise.
        centre_xy: column and row that do not move, in pixels; pixel centres are whole numbers.
    """

    image_hw: tuple[int, int]
    angle: float
    centre_xy: tuple[float, float]

    def image(self, image: NDArray[Any], fill: ArrayLike) -> NDArray[Any]:
        """Bilinear; (H, W) or (H, W, 3), float32, with `fill` where the image does not reach."""
        return self._warped(image, fill, cv2.INTER_LINEAR)

    def label(self, label: NDArray[Any], fill: float) -> NDArray[Any]:
        """Nearest; (H, W) uint8 or float32, with `fill` where the label does not reach."""
        return self._warped(label, fill, cv2.INTER_NEAREST)

    def point(self, row: float, column: float) -> tuple[int, int]:
        """The pixel nearest to the place where a pixel of the image goes, inside of it."""
        x, y = self._matrix() @ np.array([column, row, 1.0])
        height, width = self.image_hw
        return int(np.rint(y).clip(0, height - 1)), int(np.rint(x).clip(0, width - 1))

    def _matrix(self) -> NDArray[np.float64]:
        return np.asarray(cv2.getRotationMatrix2D(self.centre_xy, self.angle, 1.0))

    def _warped(self, array: NDArray[Any], fill: ArrayLike, interpolation: int) -> NDArray[Any]:
        height, width = self.image_hw
        border = np.asarray(fill, np.float64).ravel().tolist()
        return np.asarray(
            cv2.warpAffine(
                array,
                self._matrix(),
                (width, height),
                flags=interpolation,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=border,
            )
        )
