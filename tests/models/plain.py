"""A second, plain computation of residual networks from their weights, to compare with."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.inputs import Inputs

HALF = (127.5, 127.5, 127.5)


def half(thermal_channels: int) -> Inputs:
    """0..1 to -1..1."""
    values = HALF[:thermal_channels]
    return Inputs(
        rgb_order="rgb",
        rgb_mean=HALF,
        rgb_std=HALF,
        thermal_mean=values,
        thermal_std=values,
        thermal_scale="fixed",
    )


def images(count: int, height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, height, width, generator=g), torch.rand(
        count, 1, height, width, generator=g
    )


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def randomise(net: nn.Module) -> dict[str, Tensor]:
    """Every weight, bias and statistic drawn, so that none can be forgotten; the state dict."""
    g = generator(7)
    for name, value in net.state_dict().items():
        drawn = torch.randn(value.shape, generator=g) if value.is_floating_point() else None
        if drawn is None:
            continue
        if value.dim() > 1:
            drawn = drawn / math.sqrt(value[0].numel())
        elif name.endswith("running_var"):
            drawn = 1 + 0.1 * drawn.abs()
        else:
            drawn = name.endswith("weight") + 0.1 * drawn
        value.copy_(drawn)
    return net.state_dict()


class Plain:
    """Layers of a network in evaluation mode by the names of their weights."""

    def __init__(self, state: dict[str, Tensor]) -> None:
        self.state = state

    def conv(self, name: str, x: Tensor, *, stride: int = 1, dilation: int = 1) -> Tensor:
        """ "Same" padding for odd kernels."""
        weight = self.state[f"{name}.weight"]
        padding = dilation * (weight.shape[-1] // 2)
        bias = self.state.get(f"{name}.bias")
        return F.conv2d(x, weight, bias, stride, padding, dilation)

    def norm(self, name: str, x: Tensor) -> Tensor:
        weight, bias, mean, var = (
            self.state[f"{name}.{part}"].view(-1, 1, 1)
            for part in ("weight", "bias", "running_mean", "running_var")
        )
        return (x - mean) / torch.sqrt(var + 1e-5) * weight + bias

    def stage(
        self,
        name: str,
        x: Tensor,
        *,
        strides: tuple[int, int] = (1, 1),
        dilations: tuple[int, int] = (1, 1),
    ) -> Tensor:
        """Bottlenecks `name`.0, .1, ...

        strides: of the first block's 1x1 and 3x3 convolution; its shortcut takes both.
        dilations: of the first block and of the others.
        """
        block = 0
        while f"{name}.{block}.conv1.weight" in self.state:
            at = f"{name}.{block}"
            first, second = strides if block == 0 else (1, 1)
            y = self.norm(f"{at}.bn1", self.conv(f"{at}.conv1", x, stride=first)).clamp(min=0)
            y = self.conv(f"{at}.conv2", y, stride=second, dilation=dilations[min(block, 1)])
            y = self.norm(f"{at}.bn2", y).clamp(min=0)
            y = self.norm(f"{at}.bn3", self.conv(f"{at}.conv3", y))
            if f"{at}.downsample.0.weight" in self.state:
                x = self.conv(f"{at}.downsample.0", x, stride=first * second)
                x = self.norm(f"{at}.downsample.1", x)
            x = (x + y).clamp(min=0)
            block += 1
        return x

    def up(self, name: str, x: Tensor, *, align_corners: bool) -> Tensor:
        """Twice the size, convolution, normalisation, one slope for what is negative."""
        size = (2 * x.shape[2], 2 * x.shape[3])
        x = F.interpolate(x, size=size, mode="bilinear", align_corners=align_corners)
        x = self.norm(f"{name}.conv.1", self.conv(f"{name}.conv.0", x))
        return torch.where(x > 0, x, self.state[f"{name}.conv.2.weight"] * x)
