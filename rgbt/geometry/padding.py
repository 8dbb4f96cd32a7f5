"""Sizes and padding that several components share."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as F

# Networks here see images whose sides are multiples of this (SpatialSeg and CRM releases).
STRIDE = 32


def padded_hw(image_hw: tuple[int, int], multiple: int = STRIDE) -> tuple[int, int]:
    """Round height and width up to multiples of `multiple`."""
    height, width = image_hw
    return -(-height // multiple) * multiple, -(-width // multiple) * multiple


def pad_to(tensor: Tensor, hw: tuple[int, int], value: float = 0.0) -> Tensor:
    """Pad `tensor` (..., H, W) with `value` at the bottom and right to `hw`."""
    height, width = tensor.shape[-2:]
    if isinstance(height, int) and (height, width) == hw:  # not of a graph for any size
        return tensor
    return F.pad(tensor, (0, hw[1] - width, 0, hw[0] - height), value=value)
