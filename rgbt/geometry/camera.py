"""The pinhole camera whose views are synthesised, and its matrix for images of a given size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor

from rgbt.checks import InputError
from rgbt.ranges import Pixels, Positive

Coordinate = Annotated[float, Interval(ge=-0.5, le=8192)]


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a pinhole camera for images of `height` x `width` pixels.

    Focal lengths along a row and a column, column and row of the principal point, in pixels, whose
    centres lie at whole numbers. InputError for a principal point outside the image: then these are
    the intrinsics of images of another size.
    """

    fx: Positive
    fy: Positive
    cx: Coordinate
    cy: Coordinate
    height: Pixels
    width: Pixels

    def __post_init__(self) -> None:
        inside = -0.5 <= self.cx <= self.width - 0.5 and -0.5 <= self.cy <= self.height - 0.5
        if not inside:
            raise InputError(
                f"camera: the principal point (cx={self.cx:g}, cy={self.cy:g}) lies outside an "
                f"image of {self.height}x{self.width}; set height and width of the calibration."
            )

    def matrix(self, image_hw: tuple[int, int]) -> Tensor:
        """(3, 3) float64, the calibration matrix K for images of `image_hw` (height, width).

        Images of the same aspect but another size are the same picture resized: focal lengths
        scale by s, and the principal point as pixel centres do, c' = (c + 0.5) s - 0.5. An aspect
        that differs by less than a pixel, as by rounding after resizing, is the same. A crop counts
        as a whole image: as one of a camera with the same field of view.

        Raises:
            InputError: `image_hw` has another aspect than the camera's images.
        """
        height, width = image_hw
        sy, sx = height / self.height, width / self.width
        if abs(sy * self.width - width) >= 1:
            raise InputError(
                f"camera: expected images of {self.height}x{self.width} or of that aspect ratio, "
                f"got {height}x{width}; set the intrinsics of your camera."
            )
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        rows = [[self.fx * sx, 0.0, cx], [0.0, self.fy * sy, cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)
