"""Residual stages with torchvision's parameter names and optional dilation.

Published networks differ in the position of a block's stride and dilation; every such choice is an
argument.
"""

from __future__ import annotations

from typing import Literal

from torch import Tensor, nn
from torch.nn import functional as F

StrideAt = Literal["1x1", "3x3"]


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut (ResNet-18 and -34).

    Source: He et al., Deep Residual Learning, Fig. 5 left.
    """

    def __init__(self, in_channels: int, width: int, *, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, width, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = shortcut(in_channels, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, width, H / stride, W / stride)."""
        y = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(y)) + self.downsample(x))


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolution and a shortcut (ResNet-50 and deeper).

    Source: He et al., Deep Residual Learning, Fig. 5 right.

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
        self.downsample = shortcut(in_channels, 4 * width, stride)

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, 4 width, H / stride, W / stride)."""
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        return F.relu(self.bn3(self.conv3(y)) + self.downsample(x))


def shortcut(in_channels: int, out_channels: int, stride: int) -> nn.Module:
    """Identity where shapes allow it, else a strided 1x1 convolution with normalisation."""
    if stride == 1 and in_channels == out_channels:
        return nn.Identity()
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 1, stride=stride, bias=False),
        nn.BatchNorm2d(out_channels),
    )


def bottleneck_stage(
    in_channels: int,
    width: int,
    blocks: int,
    *,
    stride: int = 1,
    dilations: tuple[int, int] = (1, 1),
    stride_at: StrideAt = "3x3",
) -> nn.Sequential:
    """Bottlenecks of one width, the first strided; 4 * width channels leave the stage.

    `dilations` are those of the first block and of the others.
    """
    first, others = dilations
    made = [Bottleneck(in_channels, width, stride=stride, dilation=first, stride_at=stride_at)]
    for _ in range(blocks - 1):
        made.append(Bottleneck(4 * width, width, dilation=others, stride_at=stride_at))
    return nn.Sequential(*made)


def basic_stage(in_channels: int, width: int, blocks: int, *, stride: int = 1) -> nn.Sequential:
    """Basic blocks of one width, the first strided."""
    first = BasicBlock(in_channels, width, stride=stride)
    return nn.Sequential(first, *(BasicBlock(width, width) for _ in range(blocks - 1)))
