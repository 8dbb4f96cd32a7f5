"""Enlarging a feature map step by step: the decoder that HeatNet and the modified DeepLab share."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.stochastic import drop_channels
from rgbt.ranges import ShareBelowOne

DropRates = tuple[ShareBelowOne, ShareBelowOne]
"""Channel dropout before the first block, and after every block; each in [0, 1)."""


class UpBlock(nn.Module):
    """Twice the size (bilinear), 3x3 convolution, normalisation, PReLU with one slope.

    Source: HeatNet release, PSPNet decoder; thesis, Fig. 5.
    """

    def __init__(self, in_channels: int, out_channels: int, *, align_corners: bool) -> None:
        super().__init__()
        self.align_corners = align_corners
        self.conv = nn.Sequential(
            nn.Conv2d(in_channels, out_channels, 3, padding=1),
            nn.BatchNorm2d(out_channels),
            nn.PReLU(),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, out, 2 H, 2 W)."""
        larger = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=self.align_corners)
        result: Tensor = self.conv(larger)
        return result


def enlarge(
    x: Tensor, blocks: Iterable[nn.Module], rates: DropRates, generator: torch.Generator | None
) -> Tensor:
    """`x` through the blocks, with channels dropped before the first and after every one.

    Args:
        x: (N, C, H, W).
        blocks: each takes and returns a map.
        rates: see `DropRates`; (0, 0) drops nothing and needs no generator, as in evaluation.
        generator: draws the channels.

    Raises:
        ValueError: a rate above 0 without a generator.
    """
    first, later = rates
    x = drop_channels(x, first, generator)
    for block in blocks:
        x = drop_channels(block(x), later, generator)
    return x
