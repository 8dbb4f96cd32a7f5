"""Read pairs of RGB and thermal images without a label, as a data set reads them.

A data set declares the paths of its images (`PairPattern`) and how they are decoded (`PairReader`),
so that new images of any folder are read like the training images.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.files import channels, decode, read_array, read_packed, read_rgb
from rgbt.types import Sample

Array = NDArray[np.uint8]
Pixel = TypeVar("Pixel", bound=np.generic)
Level = Annotated[float, Interval(ge=-1e6, le=1e6)]
Range = tuple[Level, Level]


class PairPattern(NamedTuple):
    """Patterns of the files of a pair (`rgbt.data.patterns`), relative to a root.

    Attributes:
        rgb: of the RGB images.
        thermal: of the thermal images; equal to `rgb` where thermal is the fourth channel.
    """

    rgb: str
    thermal: str

    def __str__(self) -> str:
        if self.rgb == self.thermal:
            return f"{self.rgb} of four channels"
        return f"RGB {self.rgb} with thermal {self.thermal}"


@runtime_checkable
class ReadsPairs(Protocol):
    """A data set that also reads images without a label.

    Attributes:
        images: how the images of any folder are read.
    """

    images: PairReader

    def pair(self, name: str) -> Sample:
        """The images of a sample, without its label; InputError as in `PairReader.read`."""
        ...


@dataclass(frozen=True, kw_only=True)
class PairReader:
    """RGB of 8 bits, and thermal values that become grey levels.

    Attributes:
        layouts: path patterns of the images of the data set.
        thermal_range: (low, high) thermal values that become black and white; None: 8 bit.
        counts: whether thermal images must have 16 bits and one channel.
        most_tint: grey levels by which the three channels of a thermal image may differ at a pixel;
            grey is their mean, floor((c1 + c2 + c3) / 3 + 1/2).
        crop: first row, row after the last, first column, column after the last of the part that
            is used; None: whole images.
        advice: end of the message about images of other channels or bits.
    """

    layouts: tuple[PairPattern, ...]
    thermal_range: Range | None = None
    counts: bool = False
    most_tint: int = 0
    crop: tuple[int, int, int, int] | None = None
    advice: str = "use the original file"

    def read(self, name: str, rgb: Path, thermal: Path) -> Sample:
        """The pair, read like a training sample, without a label.

        Args:
            name: of the sample.
            rgb: file of the RGB image.
            thermal: file of the thermal image; the same file where it is the fourth channel.
                Of a data set of separate images, a packed file holds grey levels as the network
                sees them.

        Raises:
            InputError: a file is missing or damaged, has other channels or bits than those of the
                data set, sizes differ, or are smaller than the crop.
        """
        if rgb == thermal and not any(layout.rgb == layout.thermal for layout in self.layouts):
            pixels, levels = read_packed(rgb, "give separate images")
            return Sample(rgb=pixels, thermal=levels, label=None, name=name)
        return self.sample(name, *self.whole(name, rgb, thermal), thermal)

    def whole(self, name: str, rgb: Path, thermal: Path) -> tuple[Array, NDArray[Any]]:
        """RGB (H, W, 3) and thermal values (H, W) of whole images; errors as of `read`."""
        if rgb == thermal:
            return read_packed(rgb, "give separate images of RGB and thermal")
        pixels, values = read_rgb(rgb, self.advice), self.values(thermal)
        check_size(pixels, "thermal", values, name, thermal)
        return pixels, values

    def sample(self, name: str, pixels: Array, values: NDArray[Any], path: Path) -> Sample:
        """The sample of whole images: cut, and thermal as grey levels; errors as of `read`."""
        levels = grey(self.cut(values, name), self.thermal_range, path)
        cut = np.ascontiguousarray(self.cut(pixels, name))
        return Sample(rgb=cut, thermal=np.ascontiguousarray(levels), label=None, name=name)

    def values(self, path: Path) -> NDArray[Any]:
        """Values of a thermal image or `.npy` file, (H, W) at their own depth, not cut.

        Raises:
            InputError: it cannot be read, has channels that differ, other bits, or NaN.
        """
        is_array = path.suffix.lower() == ".npy"
        return self.check_values(read_array(path, "numbers") if is_array else decode(path), path)

    def check_values(self, values: NDArray[Any], path: Path) -> NDArray[Any]:
        """Thermal values as (H, W); errors as of `values`, in messages with the name `path`."""
        of_counts = values.dtype == np.uint16 and values.ndim == 2
        if self.counts:
            wanted, fits = "a thermal image of 16 bits (counts) and one channel", of_counts
        elif self.thermal_range is None:
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
        return values if values.ndim == 2 else self._mean(values, path)

    def cut(self, image: NDArray[Pixel], name: str) -> NDArray[Pixel]:
        """The part of a whole image (H, W, ...) that is read; InputError if the crop is larger."""
        if self.crop is None:
            return image
        top, bottom, left, right = self.crop
        if bottom > image.shape[0] or right > image.shape[1]:
            raise InputError(
                f"dataset.crop={list(self.crop)} reaches to row {bottom} and column {right}, but "
                f"'{name}' has {image.shape[0]}x{image.shape[1]} pixels."
            )
        return image[top:bottom, left:right]

    def _mean(self, values: NDArray[Any], path: Path) -> NDArray[Any]:
        """(H, W) of (H, W, 3) with channels that are equal, or almost."""
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
                f"{self.most_tint} levels), got {channels(values)} channels that differ by up to "
                f"{tint}; {self.advice}."
            )
        # A third is never one half, so that halves need no rule: 1/3 goes down, 2/3 up.
        return np.asarray((values.sum(axis=-1, dtype=np.uint16) + 1) // 3, np.uint8)


def check_size(rgb: Array, what: str, image: NDArray[Any], name: str, path: Path | None) -> None:
    """Refuse an image (H', W') of `path` that is not of the size of `rgb` (H, W, 3)."""
    if image.shape != rgb.shape[:2]:
        raise InputError(
            f"'{name}': RGB is {rgb.shape[0]}x{rgb.shape[1]} pixels but {what} is "
            f"{image.shape[0]}x{image.shape[1]}; both must show the same pixels. Align them "
            f"first: {path}."
        )


def grey(values: NDArray[Any], limits: Range | None, path: Path) -> Array:
    """Grey levels of thermal values: round(255 (min(max(v, low), high) - low) / (high - low)).

    Halves go upwards. Without `limits`, (low, high), the values are grey levels of 8 bits.

    Raises:
        InputError: values of 8 bits with limits that these cannot reach; the message names `path`.
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
