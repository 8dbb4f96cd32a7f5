"""Everything of a sample that moves together, and what moves it: crop, flip, resize, pad.

Every transform has `train(sample, rng)`, for which all draws come from `rng`, and `test(sample)`;
of a sample without a label, all pixels are ignored. Colours are in
`rgbt.transforms.crm`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from rgbt.types import IGNORE, Example, Sample

Indices = NDArray[np.int64]
Change = Callable[[NDArray[Any]], NDArray[Any]]


class Window(NamedTuple):
    """A rectangle of an image: its first row and column, and how many it has."""

    top: int
    left: int
    height: int
    width: int


@dataclass(frozen=True)
class Maps:
    """The maps of one sample, all of one size, and the place in the file of each of their pixels.

    As in `rgbt.types.Example`; the label is 255 where the sample has none. `rows` (H,) and
    `columns` (W,) are those of the file, whose size is `source_hw`.
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
        """The whole sample as it is in its files."""
        height, width = hw = sample.thermal.shape
        label = np.full(hw, IGNORE, np.uint8) if sample.label is None else sample.label
        place = (np.arange(height), np.arange(width), (height, width))
        return cls(sample.rgb, sample.thermal, label, sample.confidence, *place, sample.name)

    @property
    def hw(self) -> tuple[int, int]:
        """Height and width."""
        return len(self.rows), len(self.columns)

    def each(self, image: Change, exact: Change) -> Maps:
        """Images changed by one function, label and confidence by another."""
        return replace(
            self,
            rgb=image(self.rgb),
            thermal=image(self.thermal),
            label=exact(self.label),
            confidence=None if self.confidence is None else exact(self.confidence),
        )

    def crop(self, window: Window) -> Maps:
        """The part within `window`."""
        top, left, height, width = window
        rows, columns = slice(top, top + height), slice(left, left + width)

        def cut(each: NDArray[Any]) -> NDArray[Any]:
            return each[rows, columns]

        return replace(self.each(cut, cut), rows=self.rows[rows], columns=self.columns[columns])

    def flip(self, flipped: bool) -> Maps:
        """All of it mirrored left to right, if `flipped`."""
        if not flipped:
            return self

        def turned(each: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(cv2.flip(each, 1))

        return replace(self.each(turned, turned), columns=self.columns[::-1])

    def resize(
        self,
        hw: tuple[int, int],
        window: Window | None = None,
        *,
        dtype: DTypeLike = np.uint8,
        area: bool = False,
    ) -> Maps:
        """Images bilinear with half-pixel centres and without antialiasing, the rest nearest.

        Args:
            hw: size of all of it after resizing.
            window: part of the resized maps that is returned; only its pixels are computed.
            dtype: of the images, uint8 (rounded) or float32.
            area: where no side grows, a pixel of an image is the mean of what it covers.
        """
        top, left, height, width = window or Window(0, 0, *hw)
        rows = _block(self.hw[0], hw[0], slice(top, top + height))
        columns = _block(self.hw[1], hw[1], slice(left, left + width))
        # "Exact": whole-number arithmetic for uint8, so that block and whole image round alike and
        # every machine gives the same bits. For float32 it is the ordinary bilinear.
        shrinks = area and hw[0] <= self.hw[0] and hw[1] <= self.hw[1]
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR_EXACT

        def image(pixels: NDArray[Any]) -> NDArray[Any]:
            block = pixels[rows.source, columns.source].astype(dtype, copy=False)
            if hw != self.hw:
                block = cv2.resize(block, (columns.size, rows.size), interpolation=how)
            return np.asarray(block[rows.window, columns.window])

        at_rows = nearest_source(self.hw[0], hw[0])[top : top + height]
        at_columns = nearest_source(self.hw[1], hw[1])[left : left + width]
        resized = self.each(image, lambda each: each.take(at_rows, 0).take(at_columns, 1))
        return replace(resized, rows=self.rows[at_rows], columns=self.columns[at_columns])

    def pad(
        self,
        hw: tuple[int, int],
        rgb: ArrayLike,
        thermal: ArrayLike,
        corner_yx: tuple[int, int] | None = None,
    ) -> Maps:
        """All of it in a frame of `hw` pixels, 255 in the label and 0 in its confidence.

        Args:
            hw: size of the result; no side is shorter than now.
            rgb: (3,) or () colour of the frame, grey levels.
            thermal: () grey level of the frame.
            corner_yx: where the maps begin; None: in the middle, of odd margins the larger one is
                below and right.
        """
        if hw == self.hw:
            return self
        height, width = self.hw
        top, left = corner_yx or ((hw[0] - height) // 2, (hw[1] - width) // 2)

        def framed(values: NDArray[Any], fill: ArrayLike) -> NDArray[Any]:
            canvas = np.empty((*hw, *values.shape[2:]), values.dtype)
            canvas[:] = fill
            canvas[top : top + height, left : left + width] = values
            return canvas

        return replace(
            self,
            rgb=framed(self.rgb, rgb),
            thermal=framed(self.thermal, thermal),
            label=framed(self.label, IGNORE),
            confidence=None if self.confidence is None else framed(self.confidence, 0.0),
            rows=np.pad(self.rows, (top, hw[0] - height - top), mode="edge"),
            columns=np.pad(self.columns, (left, hw[1] - width - left), mode="edge"),
        )

    def example(self, track_position: bool) -> Example:
        """The example; `track_position`: with the map of places in the file.

        Its centre is the pixel nearest to the centre of the file, the first in row-major order.
        Source: the centre that GRBM follows through the crop, in the SpatialSeg release (MFNet data
        set). The squared distance is a row term plus a column term, so each is minimised alone.
        """
        places, sides = (self.rows, self.columns), self.source_hw
        row, column = (
            int(np.abs(place - side // 2).argmin())
            for place, side in zip(places, sides, strict=True)
        )
        position = None
        if track_position:
            position = np.empty((2, *self.hw), np.float32)
            position[0], position[1] = self.rows[:, None], self.columns
        whole = self.each(np.ascontiguousarray, np.ascontiguousarray)
        return Example(
            rgb=whole.rgb,
            thermal=whole.thermal,
            label=whole.label,
            centre_yx=(row, column),
            position=position,
            original_hw=self.source_hw,
            name=self.name,
            confidence=whole.confidence,
        )


def evaluated(  # noqa: PLR0913 - as of `Maps.resize`
    sample: Sample,
    short_edge: int | None,
    *,
    track_position: bool,
    max_size: int | None = None,
    dtype: DTypeLike = np.uint8,
    area: bool = False,
) -> Example:
    """The whole images of a sample, resized to `short_edge` if that is set; the label as it is.

    See `short_edge_hw` for `max_size` and `Maps` for the others.
    """
    maps = Maps.of(sample)
    hw = maps.hw if short_edge is None else short_edge_hw(maps.hw, short_edge, max_size)
    example = maps.resize(hw, dtype=dtype, area=area).example(track_position)
    return replace(example, label=maps.label, confidence=maps.confidence)


def drawn_window(hw: tuple[int, int], crop_hw: tuple[int, int], rng: np.random.Generator) -> Window:
    """A crop at a uniformly drawn place; a side longer than the image is clipped to it.

    Source: augmentation step 2 of the CRM release.
    """
    height, width = min(crop_hw[0], hw[0]), min(crop_hw[1], hw[1])
    top = int(rng.integers(hw[0] - height + 1))
    return Window(top, int(rng.integers(hw[1] - width + 1)), height, width)


def short_edge_hw(
    source_hw: tuple[int, int], short_edge: int, max_size: int | None
) -> tuple[int, int]:
    """Size with a given short edge and the same aspect, unless the long edge would pass a limit.

        f = min(short_edge / min(H, W), max_size / max(H, W))
        size = (floor(f H + 1/2), floor(f W + 1/2))

    Source: augmentation step 1 of the CRM release. Lengths in pixels; `max_size` None: no limit.

    Example:
        >>> short_edge_hw((720, 1280), 1440, 1920)
        (1080, 1920)
    """
    factor = short_edge / min(source_hw)
    if max_size is not None:
        factor = min(factor, max_size / max(source_hw))
    height, width = source_hw
    return int(factor * height + 0.5), int(factor * width + 0.5)


def nearest_source(source: int, resized: int) -> Indices:
    """(resized,) index on an axis of length `source`, as torch's "nearest" picks it.

    floor(i * source / resized), in float32
    """
    factor = np.float32(source) / np.float32(resized)
    index = np.floor(np.arange(resized, dtype=np.float32) * factor).astype(np.int64)
    clipped: Indices = np.minimum(index, source - 1)
    return clipped


def nearest(label: NDArray[Any], hw: tuple[int, int]) -> NDArray[Any]:
    """A label (H, W) at another size, nearest as `nearest_source`."""
    rows, columns = (nearest_source(*each) for each in zip(label.shape, hw, strict=True))
    return label.take(rows, 0).take(columns, 1)


def bilinear(image: NDArray[np.uint8], hw: tuple[int, int]) -> NDArray[np.uint8]:
    """An image (H, W) at another size, as `Maps.resize`."""
    return np.asarray(cv2.resize(image, hw[::-1], interpolation=cv2.INTER_LINEAR_EXACT), np.uint8)


def mixed(label: NDArray[np.uint8], hw: tuple[int, int]) -> NDArray[np.uint8]:
    """A label (H, W) at another size whose numbers are interpolated as if they were brightness.

    Pixels that an ignored one takes part in are ignored.
    """
    ignored = (label == IGNORE).astype(np.float32)
    touched = cv2.resize(ignored, hw[::-1], interpolation=cv2.INTER_LINEAR_EXACT) > 0
    return np.where(touched, np.uint8(IGNORE), bilinear(label, hw))


class _Block(NamedTuple):
    """Part of one axis that can be resized alone: source pixels, resized length, window in it."""

    source: slice
    size: int
    window: slice


def _block(source: int, resized: int, span: slice) -> _Block:
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
    window = slice(offset, offset + span.stop - span.start)
    return _Block(slice(first * p, last * p), (last - first) * q, window)
