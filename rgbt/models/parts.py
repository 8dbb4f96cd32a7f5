"""Parts that networks share: random drops from a given generator, transformer and residual blocks.

Published residual networks differ in the position of a block's stride and dilation; every such
choice is an argument. Their parameters have torchvision's names.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.fusion import fused
from rgbt.processes import num_processes, own
from rgbt.ranges import ShareBelowOne

# Channel dropout before the first block, and after every block.
DropRates = tuple[ShareBelowOne, ShareBelowOne]

# Factors of the two residuals of a block, (2, N, 1, 1, 1); None where nothing is dropped.
Keep = Tensor | tuple[None, None]

ALL_KEPT = (None, None)
StrideAt = Literal["1x1", "3x3"]


def keep_factors(
    rates: Tensor,
    shape: tuple[int, ...],
    generator: torch.Generator | None,
    device: torch.device,
    *,
    dim: int = 0,
) -> Tensor:
    """Draw a factor for everything that may be dropped: 0, or 1 / (1 - rate) where kept.

    Source: Deep Networks with Stochastic Depth, Eq. (4), rescaled while training.

    `rates` are (n,) probabilities of being dropped, in [0, 1); `shape` is that of the draws for
    each of them, such as (samples,), and `dim` the dimension of the samples in it. Returns
    (n, *shape) float32 on `device`. Each process draws for the samples of all processes.
    """
    if generator is None:
        raise ValueError("training with random drops requires `generator`, got None.")
    probability = 1 - rates.view(-1, *(1 for _ in shape)).to(generator.device)
    sizes = [*shape]
    sizes[dim] *= num_processes()
    draw = torch.rand(len(rates), *sizes, generator=generator, device=generator.device)
    draw = own(draw, dim + 1)
    return ((draw < probability) / probability).to(device, non_blocking=True)


def stochastic_depth(
    rates: Tensor | None, depths: Sequence[int], x: Tensor, generator: torch.Generator | None
) -> list[Sequence[Keep]]:
    """Draw a `Keep` for every block of stages with `depths` blocks, for a batch x (N, ...).

    `rates` are those of all blocks in order; None: nothing is dropped, nothing drawn.
    """
    if rates is None:
        return [[ALL_KEPT] * depth for depth in depths]
    drawn = keep_factors(rates.flatten(), (2, len(x), 1, 1, 1), generator, x.device, dim=1)
    return [stage.unbind() for stage in torch.split(drawn, list(depths))]


def add_residual(x: Tensor, residual: Tensor, factor: Tensor | None) -> Tensor:
    """Return ``x + factor * residual``; the factor None, where nothing is dropped, is 1."""
    return x + residual if factor is None else torch.addcmul(x, residual, factor)


@fused
def add_and_normalise(
    x: Tensor, residual: Tensor, factor: Tensor | None, norm: tuple[Tensor, Tensor, float]
) -> tuple[Tensor, Tensor]:
    """Return `add_residual`, (N, T, C), and its layer normalisation by weight, bias, epsilon."""
    weight, bias, eps = norm
    x = add_residual(x, residual, factor)
    return x, F.layer_norm(x, x.shape[-1:], weight, bias, eps)


def parameters_of(norm: nn.LayerNorm) -> tuple[Tensor, Tensor, float]:
    """Return weight, bias and epsilon of a layer normalisation."""
    return norm.weight, norm.bias, norm.eps


def drop_channels(x: Tensor, rate: float, generator: torch.Generator | None) -> Tensor:
    """Set whole channels of (N, C, H, W) to 0 with probability `rate`, and rescale the others.

    Source: Tompson et al., Efficient Object Localization (spatial dropout; torch's Dropout2d).
    """
    if rate == 0:
        return x
    n, channels = x.shape[:2]
    factor = keep_factors(torch.tensor([rate]), (n, channels, 1, 1), generator, x.device)
    return x * factor[0].to(x.dtype)


def feed_forward(dim: int, hidden: int) -> nn.Sequential:
    """Make a linear layer, an exact GELU and a linear layer: (..., C) -> (..., C)."""
    layers = OrderedDict(fc1=nn.Linear(dim, hidden), act=nn.GELU(), fc2=nn.Linear(hidden, dim))
    return nn.Sequential(layers)


class ChannelNorm(nn.LayerNorm):
    """Normalises the channels of every pixel of maps."""

    def forward(self, input: Tensor) -> Tensor:
        """(N, C, h, w) -> (N, C, h, w)."""
        return super().forward(input.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class ResidualBlock(nn.Module):
    """Adds to its input attention, then a feed-forward network, each of the normalised input."""

    def __init__(
        self, dim: int, attn: nn.Module, mlp: nn.Module, *, norm_eps: float = 1e-5
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=norm_eps)
        self.attn = attn
        self.norm2 = nn.LayerNorm(dim, eps=norm_eps)
        self.mlp = mlp

    def forward(self, x: Tensor, keep: Keep = ALL_KEPT) -> Tensor:
        """(N, H, W, C) -> the same."""
        first, second = (None if part is None else part.flatten(1, 2) for part in keep)
        # Tokens in one dimension: a map of any size has the same compiled function.
        read = self.attn(self.norm1(x)).flatten(1, 2)
        norm = parameters_of(self.norm2)
        tokens, normed = add_and_normalise(x.flatten(1, 2), read, first, norm)
        changed = self.mlp(normed.view(x.shape)).flatten(1, 2)
        return add_residual(tokens, changed, second).view(x.shape)


def check_heads(key: str, heads: Sequence[int], widths: Sequence[int]) -> None:
    """Refuse (InputError) heads of a stage, a setting of `key`, that do not divide its channels."""
    if any(width % number for width, number in zip(widths, heads, strict=True)):
        raise InputError(f"{key}: {list(heads)} must divide the channels {list(widths)}.")


def up_block(in_channels: int, out_channels: int, *, align_corners: bool) -> nn.Sequential:
    """Make a block that doubles the size: (N, in, H, W) -> (N, out, 2 H, 2 W).

    A 3x3 convolution, normalisation and a PReLU with one slope follow (HeatNet; thesis).
    """
    larger = nn.Upsample(scale_factor=2, mode="bilinear", align_corners=align_corners)
    conv = nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 3, padding=1),
        nn.BatchNorm2d(out_channels),
        nn.PReLU(),
    )
    return nn.Sequential(OrderedDict(larger=larger, conv=conv))


def enlarge(
    x: Tensor, blocks: Iterable[nn.Module], rates: DropRates, generator: torch.Generator | None
) -> Tensor:
    """Pass `x` (N, C, H, W) through blocks; channels are dropped before the first and after all."""
    first, later = rates
    x = drop_channels(x, first, generator)
    for block in blocks:
        x = drop_channels(block(x), later, generator)
    return x


class BasicBlock(nn.Module):
    """Adds two 3x3 convolutions to a shortcut (ResNet-18 and -34; He et al., Fig. 5 left)."""

    def __init__(self, in_channels: int, width: int, *, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, width, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = _shortcut(in_channels, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, width, H / stride, W / stride)."""
        y = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(y)) + self.downsample(x))


class Bottleneck(nn.Module):
    """Adds a 1x1, a 3x3 and a 1x1 convolution to a shortcut.

    Source: ResNet-50 and deeper (He et al., Fig. 5 right).

    `width` is that of the 3x3 convolution, which is dilated; four times as many channels leave the
    block. Its stride is at the "3x3" as torchvision has it, or the "1x1" as in Caffe (DeepLab v2).
    """

    def __init__(
        self,
        in_channels: int,
        width: int,
        *,
        stride: int = 1,
        dilation: int = 1,
        stride_at: StrideAt = "3x3",
    ) -> None:
        super().__init__()
        first, second = (stride, 1) if stride_at == "1x1" else (1, stride)
        self.conv1 = nn.Conv2d(in_channels, width, 1, stride=first, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(
            width, width, 3, stride=second, padding=dilation, dilation=dilation, bias=False
        )
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * width)
        self.downsample = _shortcut(in_channels, 4 * width, stride)

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, 4 width, H / stride, W / stride)."""
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        return F.relu(self.bn3(self.conv3(y)) + self.downsample(x))


def _shortcut(in_channels: int, out_channels: int, stride: int) -> nn.Module:
    """Make an identity where shapes allow it, else a strided, normalised 1x1 convolution."""
    if stride == 1 and in_channels == out_channels:
        return nn.Identity()
    convolution = nn.Conv2d(in_channels, out_channels, 1, stride=stride, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(out_channels))


def bottleneck_stage(
    in_channels: int,
    width: int,
    blocks: int,
    *,
    stride: int = 1,
    dilations: tuple[int, int] = (1, 1),
    stride_at: StrideAt = "3x3",
) -> nn.Sequential:
    """Make bottlenecks, the first one strided, with the dilations of the first and the others."""
    first, others = dilations
    made = [Bottleneck(in_channels, width, stride=stride, dilation=first, stride_at=stride_at)]
    for _ in range(blocks - 1):
        made.append(Bottleneck(4 * width, width, dilation=others, stride_at=stride_at))
    return nn.Sequential(*made)


def basic_stage(in_channels: int, width: int, blocks: int, *, stride: int = 1) -> nn.Sequential:
    """Make basic blocks of one width, the first one strided."""
    made = [BasicBlock(in_channels, width, stride=stride)]
    for _ in range(blocks - 1):
        made.append(BasicBlock(width, width))
    return nn.Sequential(*made)
