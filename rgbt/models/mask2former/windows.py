"""Index tables of shifted-window attention; they depend on sizes only and are kept per size."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

BLOCKED = -100.0


def relative_index(window: int) -> Tensor:
    """Row of the bias table for each (query, key) pair of a window.

        index = (dy + window - 1) * (2 window - 1) + (dx + window - 1)

    Source: Swin Transformer, Sec. 3.2, "Relative position bias".

    Args:
        window: side of a window in tokens, >= 1.

    Returns:
        (window^2, window^2) int64; dy, dx = query minus key position.
    """
    axis = torch.arange(window)
    yx = torch.stack(torch.meshgrid(axis, axis, indexing="ij")).flatten(1)
    dy, dx = yx[:, :, None] - yx[:, None, :] + window - 1
    index: Tensor = dy * (2 * window - 1) + dx
    return index


@lru_cache(maxsize=64)
def shift_mask(hw: tuple[int, int], window: int, shift: int, device: torch.device) -> Tensor:
    """What is added to attention scores so that tokens brought together by the roll stay apart.

    Source: Swin Transformer, Sec. 3.2, "Efficient batch computation for shifted configuration".

    Args:
        hw: rows and columns of the map, both multiples of `window`.
        window: side of a window in tokens.
        shift: tokens the map was rolled by, 0 < shift < window.
        device: where the mask lives.

    Returns:
        (windows, 1, window^2, window^2) float32: 0 within a region, -100 across regions.
    """
    with torch.inference_mode(False):
        rows, columns = (_band(side, window, shift) for side in hw)
        region = 3 * rows[:, None] + columns[None, :]
        grid = region.view(hw[0] // window, window, hw[1] // window, window)
        flat = grid.transpose(1, 2).reshape(-1, window * window)
        apart = flat[:, :, None] != flat[:, None, :]
        return (apart[:, None] * BLOCKED).to(device)


def _band(side: int, window: int, shift: int) -> Tensor:
    """0 before the last window, 1 in it, 2 in the tokens that the roll brought from the front."""
    position = torch.arange(side)
    return (position >= side - window).long() + (position >= side - shift).long()
