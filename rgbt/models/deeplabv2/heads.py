"""From features to class scores: the atrous spatial pyramid, alone or before three up blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Interval, Len
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.models.parts import DropRates, UpBlock, enlarge

Decoder = Literal["basic", "modified_heatnet", "modified_thesis"]

Rates = Annotated[tuple[Annotated[int, Interval(ge=1, le=1024)], ...], Len(1, 64)]
"""Dilations."""


@dataclass(frozen=True)
class HeadShape:
    """The settings that all heads of a network share.

    Attributes:
        in_channels: of the features.
        num_classes: K.
        decoder: "basic": the pyramid's K maps; "modified_heatnet": 1024, 256, 64, 64 and K maps
            at base width 64, the widths of HeatNet's decoder; "modified_thesis": K maps throughout.
        rates: dilations of the pyramid.
        summed_rates: those that count.
        dropout: of channels in the modified decoders.
        align_corners: of the up blocks.
    """

    in_channels: int
    num_classes: int
    decoder: Decoder
    rates: Rates
    summed_rates: Rates
    dropout: DropRates
    align_corners: bool

    def __post_init__(self) -> None:
        summed = set(self.summed_rates)
        if len(set(self.rates)) < len(self.rates):
            raise InputError(f"model.rates must be different dilations, got {self.rates}.")
        if not summed <= set(self.rates) or len(summed) < len(self.summed_rates):
            raise InputError(
                f"model.summed_rates must be some of model.rates {self.rates}, each once, got "
                f"{self.summed_rates}."
            )
        if self.decoder == "basic" and any(self.dropout):
            raise InputError(
                "model.dropout requires a modified decoder; with model.decoder=basic it must be "
                f"[0.0, 0.0], got {self.dropout}."
            )

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels after the pyramid and after each up block."""
        k, c = self.num_classes, self.in_channels
        widths: dict[str, tuple[int, ...]] = {
            "basic": (k,),
            "modified_heatnet": (c // 2, c // 8, c // 32, c // 32),
            "modified_thesis": (k, k, k, k),
        }
        return widths[self.decoder]


class AtrousPyramid(nn.Module):
    """Sum of parallel dilated 3x3 convolutions, nothing else (ASPP).

    Source: DeepLab v2, Sec. 3.2 and Fig. 7: all four count.   Released: AdaptSegNet,
    MaxSquareLoss and the thesis leave their loop early, so that only the first two (`summed_rates`)
    count, while the others still belong to the parameters; ADVENT sums all.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        rates: tuple[int, ...],
        summed_rates: tuple[int, ...],
    ) -> None:
        super().__init__()
        self.conv2d_list = nn.ModuleList(
            nn.Conv2d(in_channels, out_channels, 3, padding=rate, dilation=rate) for rate in rates
        )
        self.summed = [rates.index(rate) for rate in summed_rates]

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, h, w) -> (N, out, h, w)."""
        first, *others = self.summed
        result: Tensor = self.conv2d_list[first](x)
        for index in others:
            result = result + self.conv2d_list[index](x)
        return result


class DeepLabHead(nn.Module):
    """A pyramid, and in the modified decoders three up blocks.

    Source: thesis, Sec. III-B and Fig. 5: a modified decoder keeps the number of channels.
    Released: the training scripts import the network without up blocks. A file that no script
    imports has a modified decoder of HeatNet's widths, which ends with a 1x1 convolution.
    """

    def __init__(self, shape: HeadShape) -> None:
        super().__init__()
        self.dropout = shape.dropout
        widths = shape.widths
        self.aspp = AtrousPyramid(shape.in_channels, widths[0], shape.rates, shape.summed_rates)
        self.ups = nn.ModuleList(
            UpBlock(before, after, align_corners=shape.align_corners)
            for before, after in zip(widths, widths[1:], strict=False)
        )
        self.final = (
            nn.Conv2d(widths[-1], shape.num_classes, 1)
            if shape.decoder == "modified_heatnet"
            else nn.Identity()
        )

    def forward(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """(N, in, h, w) -> (N, K, h, w), or (N, K, 8 h, 8 w) from a modified decoder.

        Raises:
            ValueError: no generator in training with dropout.
        """
        rates = self.dropout if self.training else (0.0, 0.0)
        result: Tensor = self.final(enlarge(self.aspp(x), self.ups, rates, generator))
        return result
