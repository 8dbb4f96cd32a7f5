"""What a transform returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Example:
    """A sample after the transform, not padded.

    Attributes:
        rgb: (H, W, 3), uint8 or float32, 0..255, RGB order.
        thermal: (H, W), dtype and range of `rgb`.
        label: (H', W') uint8, class index or 255 = ignore. H' = H and W' = W after `train`; after
            `test` the size of the file, which the images may have left.
        centre_yx: pixel of the example that is nearest to pixel (rows // 2, columns // 2) of the
            original image; the first in row-major order on a tie.
        position: (2, H, W) float32, (row, column) in the original image of every pixel; None
            where it is not tracked.
        original_hw: size of the original image.
        name: name in the split list.
    """

    rgb: NDArray[Any]
    thermal: NDArray[Any]
    label: NDArray[np.uint8]
    centre_yx: tuple[int, int]
    position: NDArray[np.float32] | None
    original_hw: tuple[int, int]
    name: str
