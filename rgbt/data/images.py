"""Read pairs of RGB and thermal images without a label, as a data set reads them.

A data set declares the paths of its images and how they are decoded (`PairReader`), so that new
images of any folder are read like the training images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.files import read_packed, read_rgb
from rgbt.data.patterns import Patterns
from rgbt.data.thermal import Range, Unit, check_unit, maker_of, read_thermal
from rgbt.types import Sample

Array = NDArray[np.uint8]


@runtime_checkable
class ReadsPairs(Protocol):
    """Is a data set that also reads images without a label; `images`: those of any folder."""

    images: PairReader

    def pair(self, name: str) -> Sample:
        """Read the images of a sample, without its label; InputError as in `PairReader.read`."""


@dataclass(frozen=True, kw_only=True)
class PairReader:
    """Reads RGB of 8 bits, and thermal values, which become grey levels.

    Attributes:
        layouts: path patterns of the images of the data set, without labels.
        thermal_range: (low, high) that become black and white, in degrees Celsius where there is a
            unit, else stored values; None: 8 bit.
        unit: of the stored values.
        find_range: computes `thermal_range` at its first use, where the setting is "auto".
        most_tint: grey levels by which the three channels of a thermal image may differ at a pixel;
            grey is their mean, floor((c1 + c2 + c3) / 3 + 1/2).
        crop: first row, row after the last, first column, column after the last of the part that
            is used; None: whole images.
        advice: end of the message about images of other channels or bits.
    """

    layouts: tuple[Patterns, ...]
    thermal_range: Range | None = None
    unit: Unit | None = None
    find_range: Callable[[], Range] | None = None
    most_tint: int = 0
    crop: tuple[int, int, int, int] | None = None
    advice: str = "use the original file"

    @cached_property
    def chosen_range(self) -> Range | None:
        """`thermal_range`, or the one that `auto` finds."""
        return self.thermal_range if self.find_range is None else self.find_range()

    @cached_property
    def limits(self) -> Range | None:
        """Stored values that become black and white."""
        found = self.chosen_range
        return found if found is None or self.unit is None else self.unit.stored(found)

    def read(self, name: str, rgb: Path, thermal: Path) -> Sample:
        """Read the pair `name` from two files like a training sample, without a label.

        Both are one file where thermal is the fourth channel; of a data set of separate images, it
        holds grey levels as the network sees them.

        Raises:
            InputError: a file is missing or damaged, has other channels or bits than those of the
                data set, sizes differ, or are smaller than the crop.
        """
        if rgb == thermal and not any(layout.packed for layout in self.layouts):
            pixels, levels = read_packed(rgb, "give separate images")
            return Sample(rgb=pixels, thermal=levels, label=None, name=name)
        return self.sample(name, *self.whole(name, rgb, thermal), thermal)

    def whole(
        self, name: str, rgb: Path, thermal: Path, label_hw: tuple[int, ...] | None = None
    ) -> tuple[Array, NDArray[Any]]:
        """Read RGB (H, W, 3) and thermal values (H, W) of whole images; errors as of `read`.

        Of two sizes, that of the label, `label_hw`, is taken for the right one.
        """
        pixels, values = self.unaligned(rgb, thermal)
        other = rgb if label_hw == values.shape else thermal
        check_size(pixels.shape[:2], "thermal", values, name, other)
        return pixels, values

    def unaligned(self, rgb: Path, thermal: Path) -> tuple[Array, NDArray[Any]]:
        """Read RGB (H, W, 3) and thermal values (H', W') of any two sizes; errors as of `read`."""
        if rgb == thermal:
            if maker_of(rgb) is not None:
                raise InputError(
                    f"{rgb} is a radiometric JPEG, whose photo shows other pixels than its "
                    "measurement; write both with rgbt.data.thermal.unpack_flir, and align them."
                )
            return read_packed(rgb, "give separate images of RGB and thermal")
        pixels = read_rgb(rgb, self.advice)
        return pixels, self.values(thermal)

    def values(self, path: Path) -> NDArray[Any]:
        """Read the stored thermal values (H, W) of a whole image; errors as of `read`."""
        return self.check_values(read_thermal(path, self.unit), path)

    def sample(self, name: str, pixels: Array, values: NDArray[Any], path: Path) -> Sample:
        """Make the sample of whole images: cut, thermal as grey levels; errors as of `read`."""
        levels = grey(self.cut(values, name), self.limits, path)
        cut = np.ascontiguousarray(self.cut(pixels, name))
        return Sample(rgb=cut, thermal=np.ascontiguousarray(levels), label=None, name=name)

    def check_values(self, values: NDArray[Any], path: Path) -> NDArray[Any]:
        """Return thermal values (H, W), of (H, W) or (H, W, 3) with almost equal channels.

        InputError, in a message with the name `path`: channels that differ, other bits, or NaN.
        """
        if self.thermal_range is None and self.find_range is None:
            wanted, fits = "thermal values of 8 bits per pixel", values.dtype == np.uint8
        else:
            wanted, fits = "thermal values", values.dtype.kind in "iuf"
        if not fits or values.ndim not in (2, 3):
            raise InputError(
                f"{path}: expected {wanted} of shape (rows, columns), got {values.dtype} of shape "
                f"{values.shape}; {self.advice}."
            )
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            wrong = np.count_nonzero(~np.isfinite(values))
            raise InputError(f"{path}: {wrong} thermal values are NaN or infinite; replace them.")
        check_unit(values, self.unit, path)
        if values.ndim == 2:
            return values
        # Whole channels are compared: comparing their interleaved pixels takes five times as long.
        first, *others = map(np.asarray, cv2.split(values))
        is_three = values.shape[2] == 3
        if is_three and all(np.array_equal(first, other) for other in others):
            return first
        tint = 256
        if is_three and values.dtype == np.uint8:
            lowest = np.minimum(np.minimum(first, others[0]), others[1])
            tint = int((np.maximum(np.maximum(first, others[0]), others[1]) - lowest).max())
        if tint > self.most_tint:
            raise InputError(
                f"{path}: expected a thermal image of one channel or three equal ones (within "
                f"{self.most_tint} levels), got {values.shape[2]} channels that differ by up to "
                f"{tint}; {self.advice}."
            )
        # A third is never one half, so that halves need no rule: 1/3 goes down, 2/3 up.
        return np.asarray((values.sum(axis=-1, dtype=np.uint16) + 1) // 3, np.uint8)

    def cut(self, image: NDArray[Any], name: str) -> NDArray[Any]:
        """Cut a whole image (H, W, ...) to the part that is read; InputError if it is smaller."""
        if self.crop is None:
            return image
        top, bottom, left, right = self.crop
        if bottom > image.shape[0] or right > image.shape[1]:
            raise InputError(
                f"dataset.crop={list(self.crop)} reaches to row {bottom} and column {right}, but "
                f"'{name}' has {image.shape[0]}x{image.shape[1]} pixels."
            )
        return image[top:bottom, left:right]


def check_size(
    hw: tuple[int, ...], what: str, image: NDArray[Any], name: str, path: Path | None
) -> None:
    """Refuse an image (H', W') that is not of the size (H, W) of RGB; `path`: the file to mend."""
    if image.shape != hw:
        remedy = f"both must show the same pixels. Align them first, with rgbt align: {path}."
        if image.shape == hw[::-1]:
            remedy = f"{path} is turned by a quarter; turn it as the others are."
        raise InputError(
            f"'{name}': RGB is {hw[0]}x{hw[1]} pixels but {what} is "
            f"{image.shape[0]}x{image.shape[1]}; {remedy}"
        )


def grey(values: NDArray[Any], limits: Range | None, path: Path) -> Array:
    """Convert thermal values v to round(255 (min(max(v, low), high) - low) / (high - low)).

    Halves go upwards. Without `limits`, (low, high), the values are grey levels of 8 bits.
    InputError for values of 8 bits with limits that these cannot reach.
    """
    if limits is None:
        return np.asarray(values, np.uint8)
    if values.dtype == np.uint8 and limits[0] >= 255:
        raise InputError(
            f"{path}: expected camera values in dataset.thermal_range={list(limits)}, got 8 bits; "
            "use the original file, or set dataset.thermal_range=null for grey levels."
        )
    if values.dtype == np.uint16:
        return np.take(_levels_of_16_bits(*limits), values)
    return _stretched(values, *limits)


@lru_cache(maxsize=4)
def _levels_of_16_bits(low: float, high: float) -> Array:
    return _stretched(np.arange(np.iinfo(np.uint16).max + 1), low, high)


def _stretched(values: NDArray[Any], low: float, high: float) -> Array:
    above = np.clip(values.astype(np.float64), low, high) - low
    span = high - low
    return np.floor_divide(2 * 255 * above + span, 2 * span).astype(np.uint8)
