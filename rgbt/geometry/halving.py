"""Maps of half the height and width: a pixel of these covers two by two pixels of a frame.

At odd sizes, the last row or column is repeated, so that a half pixel there covers what exists.
`rgbt.geometry.warp.Warp.halved` is the warp of such maps.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from rgbt.types import IGNORE


def halved_mean(values: Tensor) -> Tensor:
    """(B, C, H, W) float -> (B, C, ceil(H / 2), ceil(W / 2)), the means of 2x2 pixels.

    It can be differentiated once.
    """
    return cast(Tensor, _Mean.apply(_even(values)))  # type: ignore[no-untyped-call]


def halved_all(mask: Tensor) -> Tensor:
    """(B, H, W) bool -> (B, ceil(H / 2), ceil(W / 2)), whether all of 2x2 pixels are true."""
    a, b, c, d = _corners(mask)
    return a & b & c & d


def halved_label(label: Tensor) -> Tensor:
    """(B, H, W) int64 -> (B, ceil(H / 2), ceil(W / 2)): the class of 2x2 pixels if they agree.

    255 = ignore elsewhere.
    """
    a, b, c, d = _corners(label)
    return a.where((a == b) & (a == c) & (a == d), IGNORE)


def _even(values: Tensor) -> Tensor:
    """(..., H, W) with the last row and column twice where their number is odd."""
    if values.shape[-2] % 2:
        values = torch.cat([values, values[..., -1:, :]], -2)
    if values.shape[-1] % 2:
        values = torch.cat([values, values[..., -1:]], -1)
    return values


def _corners(values: Tensor) -> list[Tensor]:
    """The four pixels of each half pixel: (..., ceil(H / 2), ceil(W / 2)) each."""
    even = _even(values)
    return [even[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]


class _Mean(torch.autograd.Function):
    """Means of 2x2 pixels at even sizes.

    `avg_pool2d` takes three times the CPU time: 12.5 ms instead of 3.7 for nine classes of
    480x640, forward and backward.
    """

    @staticmethod
    def forward(_: Any, values: Tensor) -> Tensor:
        rows = values[..., ::2, :] + values[..., 1::2, :]
        return (rows[..., ::2] + rows[..., 1::2]).mul_(0.25)

    @staticmethod
    @once_differentiable
    def backward(_: Any, gradient: Tensor) -> Tensor:
        return F.interpolate(gradient * 0.25, scale_factor=2, mode="nearest")
