"""Sine position code and sampling grids; they depend on sizes only and are kept per size."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

TEMPERATURE = 10000.0
EPSILON = 1e-6


@lru_cache(maxsize=64)
def sine_code(hw: tuple[int, int], dim: int, device: torch.device) -> Tensor:
    """Position code of every token of a map: first half of the channels y, second half x.

        angle(p, k) = 2 pi p / (P + 1e-6) / 10000^(2 floor(k / 2) / (dim / 2)),  p = 1..P
        code(p, k) = sin(angle) for even k, cos(angle) for odd k

    Source: DETR, supplement A.4; normalised variant as in Mask2Former.

    Args:
        hw: rows and columns.
        dim: channels, a multiple of 4.
        device: where the code lives.

    Returns:
        (rows * columns, dim) float32, row-major.
    """
    with torch.inference_mode(False):
        y, x = (_axis_code(size, dim // 2) for size in hw)
        code = torch.cat([y[:, None].expand(-1, hw[1], -1), x[None].expand(hw[0], -1, -1)], -1)
        return code.flatten(0, 1).to(device)


def _axis_code(size: int, dim: int) -> Tensor:
    """(size, dim) float32 code of positions 1..size."""
    position = torch.arange(1, size + 1, dtype=torch.float32) / (size + EPSILON) * (2 * math.pi)
    pair = torch.arange(dim, dtype=torch.float32).div(2, rounding_mode="floor")
    angle = position[:, None] / TEMPERATURE ** (2 * pair / dim)
    return torch.stack([angle[:, 0::2].sin(), angle[:, 1::2].cos()], dim=-1).flatten(1)


@lru_cache(maxsize=64)
def centre_grid(levels: tuple[tuple[int, int], ...], device: torch.device) -> Tensor:
    """Centre of every token of all levels, in the coordinates of `grid_sample`.

        (x, y) = 2 (column + 1/2) / columns - 1,  2 (row + 1/2) / rows - 1

    Source: Deformable DETR, Sec. 4.1 (reference points).

    Args:
        levels: rows and columns of each map.
        device: where the grid lives.

    Returns:
        (2, tokens of all levels) float32, x first.
    """
    with torch.inference_mode(False):
        return torch.cat([_centres(hw) for hw in levels], dim=1).to(device)


def _centres(hw: tuple[int, int]) -> Tensor:
    y, x = ((2 * torch.arange(size, dtype=torch.float32) + 1) / size - 1 for size in hw)
    return torch.stack([x.repeat(hw[0]), y.repeat_interleave(hw[1])])


@lru_cache(maxsize=64)
def pixel_scale(levels: tuple[tuple[int, int], ...], device: torch.device) -> Tensor:
    """Length of one pixel of each level in the coordinates of `grid_sample`.

    Returns:
        (levels, 1, 2, 1) float32: 2 / columns, 2 / rows.
    """
    with torch.inference_mode(False):
        scale = torch.tensor([[2 / columns, 2 / rows] for rows, columns in levels])
        return scale.view(-1, 1, 2, 1).to(device)
