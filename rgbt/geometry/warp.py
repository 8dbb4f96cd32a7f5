"""Warp images, labels and scores of a frame to a view of it; maps of half the size.

A pixel of the second frame shows a point of the canvas (the view before it is cut), by the
rectangle, and this a point of the first frame, by the inverse homography. Points outside the
first frame give 0, "no label" or the value that the caller chooses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from rgbt.checks import check_shape
from rgbt.geometry.padding import pad_to
from rgbt.types import IGNORE

# How often a value is interpolated: "once", along the composed map, where the border pixels of the
# first frame reach to its outline; "twice", as in the release of Temporal: onto the canvas, where
# borders fade into zeros, and from the cut rectangle to the full size.
Resampling = Literal["once", "twice"]

# A coordinate in pixels that is outside every frame.
NOWHERE = -1e6


def powers_of_two(image_hw: tuple[int, int]) -> tuple[int, int]:
    """Return (height, width) of the padded frame in which points are normalised.

    `grid_sample` finds whole pixels exactly at such sizes alone: (x + 0.5) / W is not rounded.
    """
    height, width = (1 << (side - 1).bit_length() for side in image_hw)
    return height, width


def normalised(x: Tensor, y: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """Normalise points (B, H, W): -1 and 1 are the edges of the padded frame; (B, H, W, 2)."""
    sides = reversed(powers_of_two(image_hw))
    # A product with a power of two is exact, so that one rounding is left.
    parts = [
        torch.add(at.new_tensor(1 / side - 1), at, alpha=2 / side)
        for at, side in zip((x, y), sides, strict=True)
    ]
    return torch.stack(parts, -1)


@dataclass(frozen=True, eq=False)
class Warp:
    """Says where every pixel of the second frame comes from, and warps what belongs to it.

    Attributes:
        homography: (B, 3, 3) float64, pixels of the first frame to pixels of the canvas, w > 0 in
            front of the camera.
        rectangle: (B, 4) float64, (left, top, right, bottom) of what is cut from the canvas and
            resized to the whole frame, in pixel edges; NaN: the frame shows nothing.
        image_hw: height and width of both frames.
    """

    homography: Tensor
    rectangle: Tensor
    image_hw: tuple[int, int]
    resampling: Resampling

    def __post_init__(self) -> None:
        check_shape("rectangle", self.rectangle, "B S", B=len(self.homography), S=4)

    def resized(self, image_hw: tuple[int, int]) -> Warp:
        """Return the same view for the same frames at another size, (height, width)."""
        if image_hw == self.image_hw:
            return self
        sy, sx = (new / old for new, old in zip(image_hw, self.image_hw, strict=True))
        resize = [[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1]]
        back = [[1 / sx, 0, 0.5 / sx - 0.5], [0, 1 / sy, 0.5 / sy - 0.5], [0, 0, 1]]
        new = self.homography.new_tensor
        return replace(
            self,
            homography=new(resize) @ self.homography @ new(back),
            rectangle=(self.rectangle + 0.5) * new([sx, sy, sx, sy]) - 0.5,
            image_hw=image_hw,
        )

    def halved(self) -> Warp:
        """Return the same view for frames whose pixels cover 2x2 pixels of these, as `halved_mean`.

        At odd sizes, both frames end one row or column later, so that pixels keep their places.
        """
        height, width = self.image_hw
        rows, columns = height + height % 2, width + width % 2
        first, last = self.rectangle[:, :2], self.rectangle[:, 2:]
        grown = first + (last - first) * last.new_tensor([columns / width, rows / height])
        even = replace(self, rectangle=torch.cat([first, grown], 1), image_hw=(rows, columns))
        return even.resized((rows // 2, columns // 2))

    def bilinear(self, values: Tensor, levels: int | None = None) -> Tensor:
        """Interpolate `values` (B, C, H, W) float, 0 outside; differentiable in `values`.

        Where a point falls on a pixel, that pixel's value comes back bit by bit. `levels` 255
        rounds to 8-bit levels after each interpolation, without a gradient.
        """
        self._check(values, "B C H W")
        sampled = values.to(torch.promote_types(values.dtype, torch.float32))
        for grid in self._grids:
            padded = pad_to(sampled, powers_of_two(self.image_hw))
            sampled = F.grid_sample(padded, grid.to(padded.dtype), align_corners=False)
            sampled = sampled if levels is None else (sampled * levels).round() / levels
        return sampled.to(values.dtype)

    def nearest(self, values: Tensor, outside: float) -> Tensor:
        """Take the nearest of `values` (B, H, W) or (B, C, H, W), any dtype; `outside` if none."""
        self._check(values, "B H W" if values.dim() == 3 else "B C H W")
        index, inside = self._pixels
        flat = values.reshape(len(values), -1, index.shape[-1])
        picked = flat.gather(2, index[:, None].expand_as(flat))
        return picked.masked_fill_(~inside[:, None], outside).view(values.shape)

    def inside(self) -> Tensor:
        """Say whether a pixel shows a point within the outline of the first frame; (B, H, W)."""
        return self._pixels[1].view(-1, *self.image_hw)

    def moved(self, points_yx: Tensor) -> Tensor:
        """Return the pixel (row, column) of the second frame nearest to each point; (B, 2)."""
        row, column = points_yx.to(self.homography.device, torch.float64).unbind(1)
        points = torch.stack([column, row, torch.ones_like(row)], 1)
        x, y, w = (self.homography @ points[..., None])[..., 0].unbind(1)
        left, top, right, bottom = self.rectangle.unbind(1)
        height, width = self.image_hw
        rows = (y / w - top) * height / (bottom - top) - 0.5
        columns = (x / w - left) * width / (right - left) - 0.5
        limit = torch.tensor([height - 1, width - 1], device=row.device)
        return torch.stack([rows, columns], 1).round().long().clamp(min=0).minimum(limit)

    def _check(self, values: Tensor, letters: str) -> None:
        height, width = self.image_hw
        check_shape("values", values, letters, B=len(self.homography), H=height, W=width)

    @cached_property
    def _cut(self) -> tuple[Tensor, Tensor]:
        """Return canvas columns (B, W) and rows (B, H) of the second frame's pixels, float64."""
        left, top, right, bottom = self.rectangle[..., None].unbind(1)
        columns, rows = (at + 0.5 for at in self._whole())
        height, width = self.image_hw
        return left + columns * ((right - left) / width), top + rows * ((bottom - top) / height)

    def _whole(self) -> list[Tensor]:
        """Return columns (1, W) and rows (1, H), float64."""
        device = self.rectangle.device
        sides = reversed(self.image_hw)
        return [torch.arange(side, dtype=torch.float64, device=device)[None] for side in sides]

    def _source(self, columns: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return x, y (B, H, W) in the first frame of canvas points; NaN behind the camera."""
        m = torch.linalg.inv_ex(self.homography).inverse.float()[..., None, None]
        columns, rows = columns.float()[:, None, :], rows.float()[:, :, None]
        x, y, w = (m[:, k, 0] * columns + (m[:, k, 1] * rows + m[:, k, 2]) for k in range(3))
        scale = w.reciprocal().masked_fill_(w <= 0, torch.nan)
        return x.mul_(scale), y.mul_(scale)

    @cached_property
    def _composed(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return x, y (B, H, W) in the first frame of the second's pixels, and whether inside."""
        points = self._cut
        if self.resampling == "twice":  # what OpenCV's nearest resize takes from the rectangle
            left, top, right, bottom = self.rectangle[..., None].unbind(1)
            columns, rows = self._whole()
            points = _nearest_resize(columns, left, right), _nearest_resize(rows, top, bottom)
        x, y = self._source(*points)
        height, width = self.image_hw
        inside = x >= -0.5
        inside &= x <= width - 0.5
        inside &= y >= -0.5
        inside &= y <= height - 0.5
        return x, y, inside

    @cached_property
    def _pixels(self) -> tuple[Tensor, Tensor]:
        """Return the flat index of the nearest pixel, and whether there is one; (B, H W) each."""
        x, y, inside = self._composed
        height, width = self.image_hw
        column, row = (
            (at + 0.5).floor_().clamp_(0, side - 1).nan_to_num_(0).int()
            for at, side in ((x, width), (y, height))
        )
        return row.mul_(width).add_(column).long().flatten(1), inside.flatten(1)

    @cached_property
    def _grids(self) -> list[Tensor]:
        """Return grids to sample one after the other: (B, H, W, 2) float32, see `normalised`."""
        height, width = self.image_hw
        if self.resampling == "once":
            x, y, inside = self._composed
            x = x.clamp(0, width - 1).masked_fill_(~inside, NOWHERE)
            y = y.clamp(0, height - 1).masked_fill_(~inside, NOWHERE)
            return [normalised(x, y, self.image_hw)]
        left, top, right, bottom = self.rectangle[..., None].unbind(1)
        columns, rows = self._cut
        x = columns.clamp(left + 0.5, right - 0.5).float()[:, None, :].expand(-1, height, -1)
        y = rows.clamp(top + 0.5, bottom - 0.5).float()[:, :, None].expand(-1, -1, width)
        return [
            normalised(across.nan_to_num(NOWHERE), down.nan_to_num(NOWHERE), self.image_hw)
            for across, down in (self._source(*self._whole()), (x, y))
        ]


def _nearest_resize(pixels: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return first pixel + floor(i * cut / size), with OpenCV's rounding.

    The rounding matters where the product is whole, as at 576 of 640 pixels.
    """
    step = 1 / (pixels.shape[-1] / (high - low))
    first = low + 0.5
    return first.floor() + (first.frac() + pixels * step).floor()


def halved_mean(values: Tensor) -> Tensor:
    """Average 2x2 pixels of what exists: (B, C, H, W) float -> (B, C, ceil(H / 2), ceil(W / 2)).

    It can be differentiated once. `avg_pool2d` takes three times the CPU time.
    """
    return cast(Tensor, _Mean.apply(_even(values)))  # type: ignore[no-untyped-call]


class _Mean(torch.autograd.Function):
    """Averages 2x2 pixels of (..., H, W), H and W even."""

    @staticmethod
    def forward(_: Any, values: Tensor) -> Tensor:
        rows = values[..., ::2, :] + values[..., 1::2, :]
        return (rows[..., ::2] + rows[..., 1::2]).mul_(0.25)

    @staticmethod
    @once_differentiable
    def backward(_: Any, gradient: Tensor) -> Tensor:
        return F.interpolate(gradient * 0.25, scale_factor=2, mode="nearest")


def halved_all(mask: Tensor) -> Tensor:
    """Say whether all of 2x2 pixels are true: (B, H, W) bool -> (B, ceil(H / 2), ceil(W / 2))."""
    a, b, c, d = _corners(mask)
    return a & b & c & d


def halved_label(label: Tensor) -> Tensor:
    """Return the class of 2x2 pixels, 255 of several: (B, ceil(H / 2), ceil(W / 2))."""
    a, b, c, d = _corners(label)
    return a.where((a == b) & (a == c) & (a == d), IGNORE)


def _corners(values: Tensor) -> list[Tensor]:
    """Return the four pixels of each half pixel: (..., ceil(H / 2), ceil(W / 2)) each."""
    even = _even(values)
    return [even[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]


def _even(values: Tensor) -> Tensor:
    """Repeat the last row and the last column of (..., H, W) where their number is odd."""
    if values.shape[-2] % 2:
        values = torch.cat([values, values[..., -1:, :]], -2)
    if values.shape[-1] % 2:
        values = torch.cat([values, values[..., -1:]], -1)
    return values
