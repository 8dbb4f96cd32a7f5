"""Conversion between RGB and HSV of 8-bit images on tensors, with OpenCV's bits on every device.

Units are OpenCV's for 8-bit images: hue 0..179 (2 degrees each), saturation and value 0..255.
"""

from __future__ import annotations

import torch
from torch import Tensor

SHIFT = 12
"""Binary digits of the fraction in the whole-number divisions of `to_hsv`."""


def to_hsv(rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Hue, saturation and value, each (...,) int64; the bits of OpenCV's COLOR_RGB2HSV.

    Args:
        rgb: (..., 3) int64, 0..255.
    """
    red, green, blue = rgb.unbind(-1)
    value = rgb.amax(-1)
    spread = value - rgb.amin(-1)
    of_255, of_180 = _divisions(rgb.device)
    half = 1 << (SHIFT - 1)
    saturation = (spread * of_255[value] + half) >> SHIFT
    sixth = torch.where(
        value == red,
        green - blue,
        torch.where(value == green, blue - red + 2 * spread, red - green + 4 * spread),
    )
    hue = (sixth * of_180[spread] + half) >> SHIFT
    return torch.where(hue < 0, hue + 180, hue), saturation, value


def to_rgb(hue: Tensor, saturation: Tensor, value: Tensor) -> Tensor:
    """(..., 3) int64, 0..255: the bits of OpenCV's COLOR_HSV2RGB in its vector code.

    Products are rounded to float32 where OpenCV rounds them, and the last step truncates.

    Args:
        hue: (...,) int64, 0..179.
        saturation: (...,) int64, 0..255.
        value: (...,) int64, 0..255.
    """
    sextant = hue // 30
    turned = hue.float() * _float32(6 / 180)
    fraction = turned - turned.floor()
    grey = saturation.float() * _float32(1 / 255)
    light = value.float() * _float32(1 / 255)
    none = light * (1.0 - grey)
    falling = light * _less_product(grey, fraction)
    rising = light * _less_product(grey, 1.0 - fraction)
    levels = torch.stack([light, none, falling, rising], dim=-1)
    levels = (levels * 255.0).to(torch.int64)
    # Of red, green and blue in each sixth of the circle: which of the four levels it has.
    order = torch.tensor(
        [[0, 3, 1], [2, 0, 1], [1, 0, 3], [1, 2, 0], [3, 1, 0], [0, 1, 2]], device=hue.device
    )
    return levels.gather(-1, order[sextant])


def _less_product(one: Tensor, other: Tensor) -> Tensor:
    """1 - one * other, rounded once: a fused multiply-add, which OpenCV's vector code uses.

    In float64 the product of two float32 is exact.
    """
    return (1.0 - one.double() * other.double()).float()


def _float32(number: float) -> float:
    """The nearest float32: a Python number would be rounded after the product, not before it."""
    return float(torch.tensor(number, dtype=torch.float32))


def _divisions(device: torch.device) -> tuple[Tensor, Tensor]:
    """(256,) int64 each: 255 / i and 180 / (6 i) with `SHIFT` binary digits; 0 at i = 0."""
    index = torch.arange(256, dtype=torch.float64).clamp(min=1)
    tables = [((top << SHIFT) / (by * index)).round().long() for top, by in ((255, 1), (180, 6))]
    for table in tables:
        table[0] = 0
    return tables[0].to(device), tables[1].to(device)
