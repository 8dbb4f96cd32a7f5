"""Reads images of Freiburg Thermal: crops them, and converts counts to grey levels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.files import CountImage, read_counts, read_rgb
from rgbt.data.folder.values import levels_of_16_bits
from rgbt.data.images import PairPattern, read_packed_pair
from rgbt.data.named_files import check_size
from rgbt.types import Sample

Array = NDArray[np.uint8]
Crop = tuple[int, int, int, int]
Pixel = TypeVar("Pixel", np.uint8, np.uint16)


@dataclass(frozen=True)
class FreiburgImages:
    """RGB of 8 bits and counts of the thermal camera, both cropped (see `rgbt.data.freiburg`).

    Attributes:
        crop: see `Freiburg`.
        thermal_range: see there.
    """

    layouts: ClassVar[tuple[PairPattern, ...]] = (
        PairPattern(
            "train/{sequence}/{piece}/fl_rgb/fl_rgb_{stamp}.png",
            "train/{sequence}/{piece}/fl_ir_aligned/fl_ir_aligned_{stamp}.png",
        ),
        PairPattern(
            "{part}/{time}/ImagesRGB/{stamp}_rgb.png", "{part}/{time}/ImagesIR/{stamp}_ir.png"
        ),
        # Of one part of the archive the stamps of RGB end in a 0 more than those of thermal.
        PairPattern(
            "{part}/{time}/ImagesRGB/{stamp}0_rgb.png", "{part}/{time}/ImagesIR/{stamp}_ir.png"
        ),
    )

    crop: Crop | None
    thermal_range: tuple[int, int]

    def read(self, name: str, rgb: Path, thermal: Path) -> Sample:
        """See `rgbt.data.images.PairReader`; a packed file holds grey levels, not counts."""
        if rgb == thermal:
            return read_packed_pair(name, rgb)
        return self.sample(name, *whole_frame(name, rgb, thermal))

    def sample(self, name: str, pixels: Array, counts: CountImage) -> Sample:
        """The sample of a whole frame, RGB (H, W, 3) and counts (H, W); errors as of `cut`."""
        levels = np.take(levels_of_16_bits(*self.thermal_range), self.cut(counts, name))
        cut = np.ascontiguousarray(self.cut(pixels, name))
        return Sample(rgb=cut, thermal=levels, label=None, name=name)

    def cut(self, image: NDArray[Pixel], name: str) -> NDArray[Pixel]:
        """The part of a whole frame that is read; InputError if it is smaller than the crop."""
        if self.crop is None:
            return image
        top, bottom, left, right = self.crop
        if bottom > image.shape[0] or right > image.shape[1]:
            raise InputError(
                f"'{name}': the frame is {image.shape[0]}x{image.shape[1]} pixels but "
                f"dataset.crop={list(self.crop)} reaches to row {bottom} and column {right}; give "
                "a crop inside it, or dataset.crop=null for whole frames."
            )
        return image[top:bottom, left:right]


def whole_frame(name: str, rgb: Path, thermal: Path) -> tuple[Array, CountImage]:
    """RGB (H, W, 3) and counts (H, W) of a whole frame; InputError as of `PairReader.read`."""
    pixels, counts = read_rgb(rgb), read_counts(thermal)
    check_size(pixels, "thermal", counts, name, thermal)
    return pixels, counts
