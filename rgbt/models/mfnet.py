"""The network MFNet: two small convolutional encoders and a decoder that adds their features.

Parameter names are those of the authors' PyTorch release; "inf" (infrared) is the thermal encoder.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Annotated

import torch
from annotated_types import MultipleOf
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.inputs import Images, Inputs, Network
from rgbt.ranges import Channels, NumClasses
from rgbt.requirements import NetworkRecord
from rgbt.types import Output, View

Widths = tuple[Channels, Channels, Channels, Annotated[Channels, MultipleOf(2)]]


def conv_unit(
    in_channels: int, out_channels: int, *, dilation: int = 1, activation: bool = True
) -> nn.Sequential:
    """Make a 3x3 convolution (dilated, padded alike), batch normalisation and a leaky ReLU.

    (N, in, H, W) -> (N, out, H, W); the last unit of a network may have no `activation`.
    """
    conv = nn.Conv2d(in_channels, out_channels, 3, padding=dilation, dilation=dilation)
    layers: OrderedDict[str, nn.Module] = OrderedDict(conv=conv, bn=nn.BatchNorm2d(out_channels))
    if activation:
        layers["act"] = nn.LeakyReLU(0.2)
    return nn.Sequential(layers)


class MiniInception(nn.Module):
    """Joins a plain and a dilated unit of half the channels, three times."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        for level, channels in enumerate((in_channels, out_channels, out_channels), start=1):
            for side, dilation in (("left", 1), ("right", 2)):
                unit = conv_unit(channels, out_channels // 2, dilation=dilation)
                self.add_module(f"conv{level}_{side}", unit)

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, out, H, W)."""
        left1, right1, left2, right2, left3, right3 = self.children()
        for left, right in ((left1, right1), (left2, right2), (left3, right3)):
            x = torch.cat((left(x), right(x)), 1)
        return x


class MFNet(Network):
    """Adds the features of two small encoders in its decoder, as Ha et al. do.

    Source: MFNet (Ha et al., IROS 2017).   Released: haqishen/MFNet-pytorch.

    The arguments are the keys of ``conf/model/mfnet.yaml``. Stride 16 has the channels of stride 8,
    since the decoder adds the two. `final_activation` does not change the class of any pixel.
    """

    multiple = 16  # four halvings, which the decoder undoes exactly
    record = NetworkRecord(views=("rgbt",), recomputed=("conv*", "decode*"))

    def __init__(
        self,
        *,
        num_classes: NumClasses,
        rgb_widths: Widths,
        thermal_widths: Widths,
        decoder_width: Channels,
        final_activation: bool,
        inputs: Inputs,
    ) -> None:
        super().__init__()
        self.num_classes = num_classes
        self._add_encoder("rgb", 3, rgb_widths)
        self._add_encoder("inf", inputs.thermal_channels, thermal_widths)
        pairs = zip(rgb_widths, thermal_widths, strict=True)
        _, half, quarter, eighth = (sum(pair) for pair in pairs)
        self.decode4 = conv_unit(eighth, quarter)
        self.decode3 = conv_unit(quarter, half)
        self.decode2 = conv_unit(half, decoder_width)
        self.decode1 = conv_unit(decoder_width, num_classes, activation=final_activation)
        self.inputs = inputs

    def predict(self, images: Images, view: View, generator: torch.Generator | None) -> Output:  # noqa: ARG002
        """Predict class scores from both images; `aux` is empty."""
        encoded = (self._encode("rgb", images.rgb), self._encode("inf", images.thermal))
        half, quarter, eighth, x = (torch.cat(pair, 1) for pair in zip(*encoded, strict=True))
        x = self.decode4(doubled(x) + eighth)
        x = self.decode3(doubled(x) + quarter)
        x = self.decode2(doubled(x) + half)
        return Output(self.decode1(doubled(x)), {})

    def _add_encoder(self, suffix: str, channels: int, widths: tuple[int, int, int, int]) -> None:
        full, half, quarter, eighth = widths
        self.add_module(f"conv1_{suffix}", conv_unit(channels, full))
        self.add_module(f"conv2_1_{suffix}", conv_unit(full, half))
        self.add_module(f"conv2_2_{suffix}", conv_unit(half, half))
        self.add_module(f"conv3_1_{suffix}", conv_unit(half, quarter))
        self.add_module(f"conv3_2_{suffix}", conv_unit(quarter, quarter))
        self.add_module(f"conv4_{suffix}", MiniInception(quarter, eighth))
        self.add_module(f"conv5_{suffix}", MiniInception(eighth, eighth))

    def _encode(self, suffix: str, x: Tensor) -> list[Tensor]:
        """Return features at strides 2, 4, 8 (before they are pooled) and 16."""
        found: list[Tensor] = []
        for level in (("1",), ("2_1", "2_2"), ("3_1", "3_2"), ("4",), ("5",)):
            x = F.max_pool2d(x, 2) if found else x
            for name in level:
                x = self.get_submodule(f"conv{name}_{suffix}")(x)
            found.append(x)
        return found[1:]


def doubled(x: Tensor) -> Tensor:
    """Repeat every pixel twice along both sides: (N, C, H, W) -> (N, C, 2 H, 2 W)."""
    return F.interpolate(x, scale_factor=2.0, mode="nearest")
