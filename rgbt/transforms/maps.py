"""Everything of a sample that moves together, and what moves it: crop, flip, resize, pad."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from rgbt.types import IGNORE, Example, Sample

Indices = NDArray[np.int64]
# Change of a map with its number: RGB (0), thermal (1), label (2), confidence (3).
Change = Callable[[NDArray[Any], int], NDArray[Any]]

# Values of the pixels beyond a sample in these four maps.
Fill = tuple[ArrayLike, ArrayLike, int, float]

# Rows and columns of a part, each with its first pixel and its end.
Window = tuple[slice, slice]


@dataclass(frozen=True)
class Maps:
    """Holds the maps of one sample, as in `rgbt.types.Example`, but all of one size.

    `rows` (H,) and `columns` (W,) are those of the file, whose size is `source_hw`.
    """

    rgb: NDArray[Any]
    thermal: NDArray[Any]
    label: NDArray[np.uint8]
    confidence: NDArray[np.float32] | None
    rows: Indices
    columns: Indices
    source_hw: tuple[int, int]
    name: str

    @classmethod
    def of(cls, sample: Sample) -> Maps:
        """Take the whole sample of its files; all pixels are ignored where it has no label."""
        height, width = hw = sample.thermal.shape
        label = np.full(hw, IGNORE, np.uint8) if sample.label is None else sample.label
        place = (np.arange(height), np.arange(width), (height, width))
        return cls(sample.rgb, sample.thermal, label, sample.confidence, *place, sample.name)

    @property
    def hw(self) -> tuple[int, int]:
        """Return height and width."""
        return len(self.rows), len(self.columns)

    def changed(self, change: Change) -> Maps:
        """Change every map by one function of it and of its number."""
        return replace(
            self,
            rgb=change(self.rgb, 0),
            thermal=change(self.thermal, 1),
            label=change(self.label, 2),
            confidence=None if self.confidence is None else change(self.confidence, 3),
        )

    def crop(self, window: Window) -> Maps:
        """Return the part within `window`."""
        rows, columns = window
        cropped = self.changed(lambda values, _: values[window])
        return replace(cropped, rows=self.rows[rows], columns=self.columns[columns])

    def flip(self, flipped: bool) -> Maps:
        """Mirror all of it left to right, if `flipped`."""
        if not flipped:
            return self
        turned = self.changed(lambda values, _: np.asarray(cv2.flip(values, 1)))
        return replace(turned, columns=self.columns[::-1])

    def resize(
        self,
        hw: tuple[int, int],
        window: Window | None = None,
        *,
        dtype: DTypeLike = np.uint8,
        area: bool = False,
    ) -> Maps:
        """Resize images bilinear, with half-pixel centres, not antialiased; the rest nearest.

        Returned, and computed, is the part of all `hw` pixels within `window`. Images become
        `dtype`, uint8 (rounded) or float32. `area`: where no side grows, a pixel of an image is the
        mean of what it covers.
        """
        window = window or (slice(0, hw[0]), slice(0, hw[1]))
        rows = _axis(self.hw[0], hw[0], window[0])
        columns = _axis(self.hw[1], hw[1], window[1])
        # "Exact": whole-number arithmetic for uint8, so that block and whole image round alike and
        # every machine gives the same bits. For float32 it is the ordinary bilinear.
        shrinks = area and hw[0] <= self.hw[0] and hw[1] <= self.hw[1]
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR_EXACT

        def resized(values: NDArray[Any], number: int) -> NDArray[Any]:
            if number > 1:
                return values.take(rows.nearest, 0).take(columns.nearest, 1)
            block = values[rows.source, columns.source].astype(dtype, copy=False)
            if hw != self.hw:
                block = cv2.resize(block, (columns.size, rows.size), interpolation=how)
            return np.asarray(block[rows.window, columns.window])

        maps = self.changed(resized)
        return replace(maps, rows=self.rows[rows.nearest], columns=self.columns[columns.nearest])

    def pad(
        self, hw: tuple[int, int], fill: Fill, corner_yx: tuple[int, int] | None = None
    ) -> Maps:
        """Put all of it into a larger frame, from `corner_yx` on.

        None: in the middle; odd margins are larger below and right.
        """
        if hw == self.hw:
            return self
        height, width = self.hw
        top, left = corner_yx or ((hw[0] - height) // 2, (hw[1] - width) // 2)

        def framed(values: NDArray[Any], number: int) -> NDArray[Any]:
            canvas = np.empty((*hw, *values.shape[2:]), values.dtype)
            canvas[:] = fill[number]
            canvas[top : top + height, left : left + width] = values
            return canvas

        return replace(
            self.changed(framed),
            rows=np.pad(self.rows, (top, hw[0] - height - top), mode="edge"),
            columns=np.pad(self.columns, (left, hw[1] - width - left), mode="edge"),
        )

    def rotate(self, angle: float, middle_xy: tuple[float, float], fill: Fill) -> Maps:
        """Rotate counter-clockwise about a point, by degrees; places are counted `around` anew."""
        matrix = np.asarray(cv2.getRotationMatrix2D(middle_xy, angle, 1.0))

        def warped(values: NDArray[Any], number: int) -> NDArray[Any]:
            how = cv2.INTER_LINEAR if number < 2 else cv2.INTER_NEAREST
            size, border = self.hw[::-1], cv2.BORDER_CONSTANT
            return np.asarray(cv2.warpAffine(values, matrix, size, None, how, border, fill[number]))

        column, row = np.rint(matrix @ [*self.centre_yx[::-1], 1.0])
        rotated = self.changed(warped)
        return rotated.around(int(row.clip(0, self.hw[0] - 1)), int(column.clip(0, self.hw[1] - 1)))

    def around(self, row: int, column: int) -> Maps:
        """Count places from the pixel that shows the file's centre."""
        height, width = self.source_hw
        rows, columns = (np.arange(side) for side in self.hw)
        return replace(self, rows=rows - row + height // 2, columns=columns - column + width // 2)

    def blur(self, kernel: int) -> Maps:
        """Blur images by OpenCV's Gaussian kernel of a side in pixels."""
        side = (kernel, kernel)

        def blurred(values: NDArray[Any], number: int) -> NDArray[Any]:
            return np.asarray(cv2.GaussianBlur(values, side, 0)) if number < 2 else values

        return self.changed(blurred)

    @property
    def centre_yx(self) -> tuple[int, int]:
        """Return the pixel nearest to the centre of the file, the first in row-major order.

        GRBM follows it through the crop, in the SpatialSeg release (MFNet data set). The squared
        distance is a row term plus a column term, so each is minimised alone.
        """
        height, width = self.source_hw
        row = np.abs(self.rows - height // 2).argmin()
        return int(row), int(np.abs(self.columns - width // 2).argmin())

    def example(self, track_position: bool) -> Example:
        """Make the example; `track_position`: with the map of places in the file."""
        position = None
        if track_position:
            position = np.empty((2, *self.hw), np.float32)
            position[0], position[1] = self.rows[:, None], self.columns
        whole = self.changed(lambda values, _: np.ascontiguousarray(values))
        return Example(
            rgb=whole.rgb,
            thermal=whole.thermal,
            label=whole.label,
            confidence=whole.confidence,
            centre_yx=self.centre_yx,
            position=position,
            original_hw=self.source_hw,
            name=self.name,
        )


def evaluated(
    sample: Sample,
    short_edge: int | None,
    max_size: int | None = None,
    *,
    track_position: bool,
    **how: Any,
) -> Example:
    """Resize whole images as `short_edge_hw` and `Maps.resize` say; the label stays as it is."""
    maps = Maps.of(sample)
    hw = maps.hw if short_edge is None else short_edge_hw(maps.hw, short_edge, max_size)
    example = maps.resize(hw, **how).example(track_position)
    return replace(example, label=maps.label, confidence=maps.confidence)


def drawn_window(
    hw: tuple[int, int],
    crop_hw: tuple[int, int],
    rng: np.random.Generator,
    release: Literal["crm", "cmx", "cmnext"] = "crm",
) -> Window:
    """Draw a crop at a uniform place; a side longer than the image is clipped to it.

    The first pixel of a side lies in 0..n, n = max(length - crop, 0), in the release of CRM. In
    that of CMX it may lie one too far, so that the crop lacks a pixel, and in that of CMNeXt also
    where the whole side would fit.
    """

    def drawn(length: int, crop: int) -> slice:
        spare = max(length - crop, 0)
        too_far = {"crm": 0, "cmx": int(spare > 0), "cmnext": 1}[release]
        first = min(int(rng.integers(spare + too_far + 1)), length - 1)
        return slice(first, min(first + crop, length))

    rows, columns = map(drawn, hw, crop_hw)
    return rows, columns


def short_edge_hw(
    source_hw: tuple[int, int], short_edge: int, max_size: int | None
) -> tuple[int, int]:
    """Return a size of the same aspect, (floor(f H + 1/2), floor(f W + 1/2)).

    Source: CRM release.

    f = min(short_edge / min(H, W), max_size / max(H, W))
    """
    factor = short_edge / min(source_hw)
    if max_size is not None:
        factor = min(factor, max_size / max(source_hw))
    height, width = source_hw
    return int(factor * height + 0.5), int(factor * width + 0.5)


def nearest_source(source: int, resized: int) -> Indices:
    """Return floor(i * source / resized) in float32, (resized,), as torch's "nearest" picks it."""
    factor = np.float32(source) / np.float32(resized)
    index = np.floor(np.arange(resized, dtype=np.float32) * factor).astype(np.int64)
    return np.asarray(np.minimum(index, source - 1))


def nearest(label: NDArray[Any], hw: tuple[int, int]) -> NDArray[Any]:
    """Resize a label (H, W), nearest as `nearest_source`."""
    rows, columns = nearest_source(label.shape[0], hw[0]), nearest_source(label.shape[1], hw[1])
    return label.take(rows, 0).take(columns, 1)


def bilinear(image: NDArray[Any], hw: tuple[int, int]) -> NDArray[Any]:
    """Resize an image (H, W) as `Maps.resize`."""
    return np.asarray(cv2.resize(image, hw[::-1], interpolation=cv2.INTER_LINEAR_EXACT))


def mixed(label: NDArray[np.uint8], hw: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize a label (H, W) as if it were brightness; a mix with an ignored pixel is ignored."""
    touched = bilinear((label == IGNORE).astype(np.float32), hw) > 0
    return np.where(touched, np.uint8(IGNORE), bilinear(label, hw))


class _Axis(NamedTuple):
    """Says what of an axis is resized alone.

    `source` are pixels of the source, `size` is their number after resizing, `window` the part of
    these that is kept; `nearest` are the pixels of the source without interpolation.
    """

    source: slice
    size: int
    window: slice
    nearest: Indices


def _axis(source: int, resized: int, kept: slice) -> _Axis:
    """Find the smallest block around `kept` whose resizing gives the pixels of the whole axis.

    With source : resized = p : q in lowest terms, resized pixel k q + i samples at p k plus the
    place of pixel i. So whole periods may be resized alone, with one more on either side for the
    neighbours that the kernel reaches for.
    """
    periods = math.gcd(source, resized)
    p, q = source // periods, resized // periods
    first = max(0, kept.start // q - 1)
    last = min(periods, -(-kept.stop // q) + 1)
    window = slice(kept.start - first * q, kept.stop - first * q)
    at = nearest_source(source, resized)[kept]
    return _Axis(slice(first * p, last * p), (last - first) * q, window, at)
