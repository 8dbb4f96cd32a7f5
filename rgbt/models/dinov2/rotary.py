"""Rotary positions: queries and keys are rotated by angles that follow from their patch."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

Rotation = tuple[Tensor, Tensor]
"""Cosine and sine, (T, D) each, D channels of a head."""


class RotaryPositions(nn.Module):
    """Angles of the channels of a head for every token.

        2 pi y / period and 2 pi x / period,  period = base ** (j / (D / 4)),  j = 0 .. D / 4 - 1

    y and x are the centre of a patch in [-1, 1], each divided by its own side of the image. The
    first half of the channels has the angles of y, then those of x; the second half repeats them.

    Source: DINOv3 release, `layers/rope_position_encoding.py`, normalize_coords "separate". Its
    random rescaling of the coordinates while training is left out. The published files hold the
    periods rounded to bfloat16, so the periods are an entry of the network.
    """

    periods: Tensor

    def __init__(self, head_dim: int, base: float) -> None:
        super().__init__()
        exponents = 2 * torch.arange(head_dim // 4, dtype=torch.float32) / (head_dim // 2)
        self.register_buffer("periods", base**exponents)

    def forward(self, hw: tuple[int, int], num_first: int) -> Rotation:
        """The rotation of `num_first` tokens without a position, which is none, and of h x w."""
        rows, columns = (self._angles(side) for side in hw)
        rows, columns = rows[:, None].expand(-1, hw[1], -1), columns.expand(hw[0], -1, -1)
        angles = torch.cat([rows, columns], dim=-1).flatten(0, 1).tile(2)
        angles = torch.cat([angles.new_zeros(num_first, angles.shape[1]), angles])
        return angles.cos(), angles.sin()

    def _angles(self, side: int) -> Tensor:
        """(side, D / 4) of the patches along one side of the image."""
        centres = torch.arange(0.5, side, dtype=torch.float32, device=self.periods.device)
        return 2 * math.pi * (2 * (centres / side) - 1)[:, None] / self.periods


def rotated(x: Tensor, rotation: Rotation) -> Tensor:
    """Channels j and j + D / 2 of (N, heads, T, D) rotated as a pair, in single precision."""
    cos, sin = rotation
    first, second = x.chunk(2, dim=-1)
    turned = torch.cat([-second, first], dim=-1)
    return (x * cos + turned * sin).to(x.dtype)
