"""Bilinear values at points between pixels, with a gradient that keeps nothing of the values.

`grid_sample` takes normalised points and keeps its input for the gradient of these points. Here
points have no gradient, so that the backward pass gets a zero in place of the input.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from rgbt.geometry.padding import pad_to

NOWHERE = -1e6
"""A coordinate in pixels that is outside every frame."""


def powers_of_two(image_hw: tuple[int, int]) -> tuple[int, int]:
    """(height, width) of the padded frame in which points are normalised.

    Only for such sizes does `grid_sample` find a whole pixel again exactly: (x + 0.5) / W is then
    a float without rounding. At 640 columns it is off by 1e-5 pixel.
    """
    height, width = (1 << (side - 1).bit_length() for side in image_hw)
    return height, width


def normalised(x: Tensor, y: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """(B, H, W, 2) of points (B, H, W) in pixels: -1 and 1 are the edges of the padded frame.

    float32.
    """
    sides = reversed(powers_of_two(image_hw))
    # A product with a power of two is exact, so that one rounding is left.
    parts = [
        torch.add(at.new_tensor(1 / side - 1), at, alpha=2 / side)
        for at, side in zip((x, y), sides, strict=True)
    ]
    return torch.stack(parts, -1)


def sample(values: Tensor, grid: Tensor) -> Tensor:
    """Interpolated `values` at the points of `grid`, 0 outside; differentiable in `values` once.

    Source: bilinear `grid_sample` with zero padding; values and gradients are its bit by bit.

    Args:
        values: (B, C, H, W) float32 or float64.
        grid: (B, h, w, 2), see `normalised`, for frames of H x W.

    Returns:
        (B, C, h, w) of the type of `values`.
    """
    return cast(Tensor, _Sample.apply(values, grid))  # type: ignore[no-untyped-call]


class _Sample(torch.autograd.Function):
    """`grid_sample` of a padded frame that keeps the grid alone.

    The gradient of the values does not depend on the values. The gradient of the points does, and
    torch computes it too: of one zero that stands for all values, from the cache instead of from
    memory. For nine classes of 480x640, 19 MB per image are not kept.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, grid: Tensor) -> Tensor:
        ctx.save_for_backward(grid)
        ctx.image_hw = values.shape[-2:]
        padded = pad_to(values, powers_of_two(ctx.image_hw))
        return F.grid_sample(padded, grid.to(values.dtype), align_corners=False)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (grid,) = ctx.saved_tensors
        height, width = ctx.image_hw
        padded_hw = powers_of_two(ctx.image_hw)
        anything = gradient.new_zeros(()).expand(*gradient.shape[:2], *padded_hw)
        bilinear, zeros = 0, 0  # torch's numbers of the interpolation and of the padding
        of_values, _ = torch.ops.aten.grid_sampler_2d_backward(
            *(gradient, anything, grid.to(gradient.dtype), bilinear, zeros, False),
            output_mask=[True, False],
        )
        return of_values[..., :height, :width], None
