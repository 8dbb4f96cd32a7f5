"""Parts of an image that are hidden: dirt or water on the lens, blocks lost in transmission."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, check_range
from rgbt.corruptions.corruption import (
    IMAGES,
    NAMES,
    REFERENCE_HEIGHT,
    Images,
    RngOf,
    Severities,
    at_height,
    check_ladder,
    nearest_whole,
)
from rgbt.types import Sample


class Occluded:
    """A share of the square blocks of the image is black (0, see `Removed`).

    The blocks lie on a grid from the top left; those at the right and at the bottom may be cut.
    Exactly the nearest whole number to ``share x blocks`` is hidden, drawn without replacement.
    With ``image: both`` the same blocks are hidden in RGB and in thermal: nothing is left to see
    there.

    Args:
        image: where blocks are hidden.
        block: side of a block in pixels at 480 rows (`REFERENCE_HEIGHT`); at least 1 pixel.
        severities: shares, 0..1.

    Raises:
        InputError: a block or a severity out of range.
    """

    unit = "share of blocks"

    def __init__(
        self,
        *,
        image: Images,
        block: Annotated[int, Interval(ge=1, le=REFERENCE_HEIGHT)],
        severities: Severities,
    ) -> None:
        self.image: Images = image
        self.block = block
        self.severities = severities
        self.title = f"occluded, {NAMES[image]}"
        check_ladder(self)

    def check(self, severity: float) -> None:
        """A share, above 0 and up to 1."""
        check_range("severity (share of blocks)", severity, 0, 1)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """See `OfPixels`."""
        hidden = self.hidden(sample.thermal.shape, severity, rng_of("occluded"))
        changed: dict[str, Any] = {}
        for image in IMAGES[self.image]:
            pixels = getattr(sample, image).copy()
            pixels[hidden] = 0
            changed[image] = pixels
        return replace(sample, **changed)

    def hidden(
        self, image_hw: tuple[int, ...], share: float, rng: np.random.Generator
    ) -> NDArray[np.bool_]:
        """(H, W): which pixels are hidden; those of a smaller share and more.

        Raises:
            InputError: the share is less than half a block.
        """
        height, width = image_hw
        side = max(1, nearest_whole(at_height(self.block, height)))
        rows, columns = -(-height // side), -(-width // side)
        number = nearest_whole(share * rows * columns)
        if number == 0:
            raise InputError(
                f"a share of {share:g} of {rows} x {columns} blocks is none; give a severity of at "
                f"least {0.5 / (rows * columns):.2g}, or a smaller corruption.block."
            )
        blocks = np.zeros(rows * columns, bool)
        blocks[rng.permutation(rows * columns)[:number]] = True
        grid = blocks.reshape(rows, columns).repeat(side, 0).repeat(side, 1)
        return np.asarray(grid[:height, :width])
