"""Read pairs of RGB and thermal images without a label, as a data set reads them.

A data set declares the paths of its images (`PairPattern`) and how they are decoded (`PairReader`),
so that new images of any folder are read like the training images.
"""

from __future__ import annotations

import math
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
from rgbt.data.named_files import check_size
from rgbt.types import Sample

Array = NDArray[np.uint8]
Pixel = TypeVar("Pixel", bound=np.generic)
Level = Annotated[float, Interval(ge=-1e6, le=1e6)]
Range = tuple[Level, Level]


class PairPattern(NamedTuple):
    """Patterns of the files of a pair (`rgbt.data.folder.pattern`), relative to a root.

    Attributes:
        rgb: of the RGB images.
        thermal: of the thermal images; equal to `rgb` where thermal is the fourth channel.
        label: of the labels, which are not read as images; None if they lie elsewhere.
    """

    rgb: str
    thermal: str
    label: str | None = None

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
        advice: end of the message about a thermal image of other channels or bits.
        packed_advice: end of the message about a packed file that has not four channels.
        rgb_advice: end of the message about an RGB image that has not three channels.
    """

    layouts: tuple[PairPattern, ...]
    thermal_range: Range | None = None
    counts: bool = False
    most_tint: int = 0
    crop: tuple[int, int, int, int] | None = None
    advice: str = "use the original file"
    packed_advice: str = "give separate images as rgb=FILE thermal=FILE, or in two folders"
    rgb_advice: str = "use the original file"

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
            pixels, levels = read_packed(rgb, self.packed_advice)
            return Sample(rgb=pixels, thermal=levels, label=None, name=name)
        return self.sample(name, *self.whole(name, rgb, thermal), thermal)

    def whole(self, name: str, rgb: Path, thermal: Path) -> tuple[Array, NDArray[Any]]:
        """RGB (H, W, 3) and thermal values (H, W) of whole images; errors as of `read`."""
        if rgb == thermal:
            return read_packed(rgb, self.packed_advice)
        pixels, values = read_rgb(rgb, self.rgb_advice), self.values(thermal)
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
        if path.suffix.lower() == ".npy":
            values = read_array(path, "thermal values of shape (rows, columns)")
        else:
            values = decode(path)
        return self.check_values(values, path)

    def check_values(self, values: NDArray[Any], path: Path) -> NDArray[Any]:
        """Thermal values as (H, W); errors as of `values`, in messages with the name `path`."""
        if values.dtype.kind not in "iuf" or values.ndim not in (2, 3):
            raise InputError(
                f"{path}: expected thermal values of shape (rows, columns), got {values.shape} "
                f"{values.dtype}; save integers or floats."
            )
        if self.counts and (values.dtype != np.uint16 or values.ndim != 2):
            raise InputError(
                f"{path}: expected a thermal image of 16 bits (counts of the camera) and one "
                f"channel, got {values.dtype} and {channels(values)}; {self.advice}."
            )
        if self.thermal_range is None and values.dtype != np.uint8:
            raise InputError(
                f"{path}: expected 8 bits per pixel, got {values.dtype}; {self.advice}."
            )
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            wrong = np.count_nonzero(~np.isfinite(values))
            raise InputError(
                f"{path}: {wrong} thermal values are NaN or infinite; replace them with a "
                "temperature (of a neighbour, or outside dataset.thermal_range)."
            )
        return values if values.ndim == 2 else self._mean(values, path)

    def cut(self, image: NDArray[Pixel], name: str) -> NDArray[Pixel]:
        """The part of a whole image (H, W, ...) that is read; InputError if the crop is larger."""
        if self.crop is None:
            return image
        top, bottom, left, right = self.crop
        if bottom > image.shape[0] or right > image.shape[1]:
            raise InputError(
                f"'{name}': the frame is {image.shape[0]}x{image.shape[1]} pixels but "
                f"dataset.crop={list(self.crop)} reaches to row {bottom} and column {right}. Give "
                "a crop inside the frame, or dataset.crop=null for whole frames."
            )
        return image[top:bottom, left:right]

    def _mean(self, values: NDArray[Any], path: Path) -> NDArray[Any]:
        """(H, W) of (H, W, 3) with channels that are equal, or almost."""
        # Whole channels are compared: comparing their interleaved pixels takes five times as long.
        first, *others = map(np.asarray, cv2.split(values))
        equal = all(np.array_equal(first, other) for other in others)
        if values.shape[2] == 3 and equal:
            return first
        tint = None
        if values.shape[2] == 3 and values.dtype == np.uint8:
            lowest = np.minimum(np.minimum(first, others[0]), others[1])
            tint = int((np.maximum(np.maximum(first, others[0]), others[1]) - lowest).max())
        if tint is None or tint > self.most_tint:
            apart = f" that differ by up to {tint} levels" if tint else " that differ" * (not equal)
            within = f" to within {self.most_tint} levels" if self.most_tint else ""
            raise InputError(
                f"{path}: expected a thermal image of one channel or three equal ones{within}, got "
                f"{channels(values)} channels{apart}; {self.advice}."
            )
        # A third is never one half, so that halves need no rule: 1/3 goes down, 2/3 up.
        return np.asarray((values.sum(axis=-1, dtype=np.uint16) + 1) // 3, np.uint8)


def reader_of_patterns(layout: PairPattern, thermal_range: Range | None) -> PairReader:
    """The reader of a user's own files, whose messages name the settings of their data set."""
    return PairReader(
        layouts=(layout,),
        thermal_range=thermal_range,
        advice="grey levels must have 8 bits in one channel or in three equal channels; "
        "other values require dataset.thermal_range=[low, high], the values that "
        "become black and white",
        packed_advice="give dataset.thermal a separate pattern",
        rgb_advice="dataset.thermal with the same pattern reads a fourth channel as thermal",
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
            f"{path}: expected camera values in dataset.thermal_range={plain(limits)}, got 8 "
            "bits; use the original file, or set dataset.thermal_range=null for grey levels."
        )
    if values.dtype == np.uint16:
        return np.take(_levels_of_16_bits(*limits), values)
    return _stretched(values, *limits)


def check_limits(limits: Range | None) -> None:
    """Refuse limits that are not a range."""
    if limits is not None and not -math.inf < limits[0] < limits[1] < math.inf:
        raise InputError(
            "dataset.thermal_range: expected [low, high] with low < high, the thermal values that "
            f"become black and white, got {plain(limits)}."
        )


def plain(limits: Range) -> str:
    """The two numbers as they are typed: 21800 and not 21800.0."""
    return f"[{limits[0]:g}, {limits[1]:g}]" if max(map(abs, limits)) < 1e5 else str(list(limits))


@lru_cache(maxsize=4)
def _levels_of_16_bits(low: float, high: float) -> Array:
    return _stretched(np.arange(np.iinfo(np.uint16).max + 1), low, high)


def _stretched(values: NDArray[Any], low: float, high: float) -> Array:
    above = np.clip(values.astype(np.float64), low, high) - low
    span = high - low
    return np.floor_divide(2 * 255 * above + span, 2 * span).astype(np.uint8)
