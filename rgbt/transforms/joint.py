"""Resize, crop and flip as one `View` that is drawn once and applied to every array.

Only the pixels that the view shows are computed. Photometric changes are in
`rgbt.transforms.photometric`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import DTypeLike, NDArray

Indices = NDArray[np.int64]


class Part(NamedTuple):
    """A rectangle of an image: its first row and column, and how many it has."""

    top: int
    left: int
    height: int
    width: int


class Taps(NamedTuple):
    """What is read of one axis, (n,) int64 each.

    ``((256 - weight) * image[first] + weight * image[second]) / 256``
    """

    first: Indices
    second: Indices
    weight: Indices


@dataclass(frozen=True)
class View:
    """A window of the resized image, mirrored or not.

    Attributes:
        source_hw: size of the original image.
        resized_hw: size of the whole image, or of `part`, after resizing.
        corner_yx: top-left pixel of the window in the resized image.
        window_hw: size of the window; corner + size stay within `resized_hw`.
        flipped: whether the window is mirrored left to right.
        part: what is resized, as if the rest of the original were not there; None for all of it.
    """

    source_hw: tuple[int, int]
    resized_hw: tuple[int, int]
    corner_yx: tuple[int, int]
    window_hw: tuple[int, int]
    flipped: bool = False
    part: Part | None = None

    def bilinear(self, image: NDArray[np.uint8], dtype: DTypeLike) -> NDArray[Any]:
        """The view of an image, bilinear with half-pixel centres, without antialiasing.

        Equal to resizing all of the image (or its part) and cutting the window out of that.

        Args:
            image: (H, W) or (H, W, C), uint8.
            dtype: float32, or uint8 for rounded values.

        Returns:
            window_hw and the same channels, of `dtype`.
        """
        top, left, height, width = self._part()
        rows = _aligned_block(height, self.resized_hw[0], self._span(0))
        columns = _aligned_block(width, self.resized_hw[1], self._span(1))
        part = image[top : top + height, left : left + width]
        block = part[rows.source, columns.source].astype(dtype, copy=False)
        if self.resized_hw != (height, width):
            # "Exact": whole-number arithmetic for uint8, so that block and whole image round alike
            # and every machine gives the same bits. For float32 it is the ordinary bilinear.
            size = (columns.size, rows.size)
            block = cv2.resize(block, size, interpolation=cv2.INTER_LINEAR_EXACT)
        window = block[rows.window, columns.window]
        return np.asarray(cv2.flip(window, 1)) if self.flipped else window.copy()

    def nearest(self, label: NDArray[Any]) -> NDArray[Any]:
        """The view of a label (H, W): the source pixels that `rows` and `columns` name."""
        return label.take(self.rows(), axis=0).take(self.columns(), axis=1)

    def rows(self) -> Indices:
        """(h,) original row of every row of the view."""
        part = self._part()
        return part.top + nearest_source(part.height, self.resized_hw[0])[self._span(0)]

    def columns(self) -> Indices:
        """(w,) original column of every column of the view."""
        part = self._part()
        columns = part.left + nearest_source(part.width, self.resized_hw[1])[self._span(1)]
        return columns[::-1] if self.flipped else columns

    def taps(self) -> tuple[Taps, Taps]:
        """What `bilinear` reads of a uint8 image for every row, and every column, of the view."""
        part = self._part()
        rows = bilinear_taps(part.height, self.resized_hw[0], self._span(0))
        columns = bilinear_taps(part.width, self.resized_hw[1], self._span(1))
        if self.flipped:
            columns = Taps(*(each[::-1] for each in columns))
        return (
            Taps(part.top + rows.first, part.top + rows.second, rows.weight),
            Taps(part.left + columns.first, part.left + columns.second, columns.weight),
        )

    def position(self) -> NDArray[np.float32]:
        """(2, h, w) float32: (row, column) in the original image of every pixel of the view.

        ``label[position] == view.nearest(label)`` for every label.
        """
        position = np.empty((2, *self.window_hw), np.float32)
        position[0] = self.rows()[:, None]
        position[1] = self.columns()
        return position

    def centre_yx(self) -> tuple[int, int]:
        """Pixel of the view that is nearest to the centre of the original image.

            argmin over (i, j) of |position(i, j) - (rows // 2, columns // 2)|, the first in
            row-major order

        Source: the centre that GRBM follows through the crop, in the SpatialSeg release (MFNet data
        set). The squared distance is a row term plus a column term, so each is minimised alone.
        """
        row = np.abs(self.rows() - self.source_hw[0] // 2).argmin()
        column = np.abs(self.columns() - self.source_hw[1] // 2).argmin()
        return int(row), int(column)

    def _part(self) -> Part:
        return self.part or Part(0, 0, *self.source_hw)

    def _span(self, axis: int) -> slice:
        start = self.corner_yx[axis]
        return slice(start, start + self.window_hw[axis])


def whole_view(source_hw: tuple[int, int], resized_hw: tuple[int, int]) -> View:
    """The view of the whole resized image."""
    return View(source_hw, resized_hw, (0, 0), resized_hw)


def draw_view(
    source_hw: tuple[int, int],
    resized_hw: tuple[int, int],
    crop_hw: tuple[int, int],
    flip_probability: float,
    rng: np.random.Generator,
) -> View:
    """A crop at a uniformly drawn place, mirrored with a given probability.

    Source: augmentation steps 2 and 4 of the CRM release.

    Args:
        source_hw: size of the original image.
        resized_hw: size of the whole image after resizing.
        crop_hw: size of the crop; a side longer than the resized image is clipped to it.
        flip_probability: in [0, 1].
        rng: every draw comes from here.
    """
    window = (min(crop_hw[0], resized_hw[0]), min(crop_hw[1], resized_hw[1]))
    top = int(rng.integers(resized_hw[0] - window[0] + 1))
    left = int(rng.integers(resized_hw[1] - window[1] + 1))
    flipped = bool(rng.random() < flip_probability)
    return View(source_hw, resized_hw, (top, left), window, flipped)


def short_edge_hw(
    source_hw: tuple[int, int], short_edge: int, max_size: int | None
) -> tuple[int, int]:
    """Size with a given short edge and the same aspect, unless the long edge would pass a limit.

        f = min(short_edge / min(H, W), max_size / max(H, W))
        size = (floor(f H + 1/2), floor(f W + 1/2))

    Source: augmentation step 1 of the CRM release.

    Example:
        >>> short_edge_hw((720, 1280), 1440, 1920)
        (1080, 1920)

    Args:
        source_hw: (H, W) in pixels.
        short_edge: wanted length of the shorter side in pixels.
        max_size: longest side allowed in pixels; None for no limit.
    """
    factor = short_edge / min(source_hw)
    if max_size is not None:
        factor = min(factor, max_size / max(source_hw))
    height, width = source_hw
    return int(factor * height + 0.5), int(factor * width + 0.5)


def nearest_source(source: int, resized: int) -> Indices:
    """Source index of every index of a resized axis, as torch's "nearest" picks it.

        floor(i * source / resized), in float32

    Args:
        source: length of the original axis.
        resized: length of the resized axis.

    Returns:
        (resized,) int64 in 0..source-1.
    """
    factor = np.float32(source) / np.float32(resized)
    index = np.floor(np.arange(resized, dtype=np.float32) * factor).astype(np.int64)
    clipped: Indices = np.minimum(index, source - 1)
    return clipped


def bilinear_taps(source: int, resized: int, span: slice) -> Taps:
    """What "exact" bilinear resizing of uint8 images reads of one axis, with OpenCV's rounding.

    Pixel i samples at s (i + 1/2) - 1/2 with s = source / resized, and never outside of the axis;
    weights are rounded to 1/256.

    Args:
        source: length of the original axis.
        resized: length of the resized axis.
        span: which of its pixels.
    """
    # The reciprocal of a quotient, as OpenCV computes it: rounding decides at ties.
    step = 1.0 / (resized / source)
    place = step * (np.arange(resized, dtype=np.float64)[span] + 0.5) - 0.5
    first = np.floor(place).astype(np.int64)
    weight = np.rint((place - first) * 256).astype(np.int64)
    weight[(first < 0) | (first >= source - 1)] = 0
    first = first.clip(0, source - 1)
    return Taps(first, np.minimum(first + 1, source - 1), weight)


@dataclass(frozen=True)
class _Block:
    """Part of one axis that can be resized alone: source pixels, resized length, window in it."""

    source: slice
    size: int
    window: slice


def _aligned_block(source: int, resized: int, span: slice) -> _Block:
    """The smallest block around `span` whose resizing gives the pixels of the whole axis.

    With source : resized = p : q in lowest terms, resized pixel k q + i samples at p k plus the
    place of pixel i. So any run of whole periods may be resized by itself; one more period on
    either side holds the neighbours that the kernel reaches for.
    """
    periods = math.gcd(source, resized)
    p, q = source // periods, resized // periods
    first = max(0, span.start // q - 1)
    last = min(periods, -(-span.stop // q) + 1)
    offset = span.start - first * q
    return _Block(
        source=slice(first * p, last * p),
        size=(last - first) * q,
        window=slice(offset, offset + span.stop - span.start),
    )
