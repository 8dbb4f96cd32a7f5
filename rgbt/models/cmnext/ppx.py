"""Parallel pooling mixer (PPX): the stages of CMNeXt's thermal stream, without attention.

Maps are (N, H, W, C) between the blocks, as in `rgbt.models.cmx.mit`, and (N, C, H, W) inside.
"""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.cmx.mit import MitShape, patch_embed
from rgbt.models.parts import add_residual

MAP_NORM_EPS = 1e-6
"""Of the layer normalisations in patch embeddings and after a stage; the RGB stream's are 1e-5."""


class PoolingGate(nn.Module):
    """Gate of a map from its means over windows of several sizes.

        sigmoid(conv1x1(c + sum_k mean_k(c))) x + x,   c = depthwise 7x7 of x

    Source: CMNeXt release.
    """

    def __init__(self, dim: int, windows: tuple[int, ...]) -> None:
        super().__init__()
        self.windows = windows
        self.conv0 = nn.Conv2d(dim, dim, 7, padding=3, groups=dim)
        self.conv4 = nn.Conv2d(dim, dim, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> the same."""
        context = self.conv0(x)
        mixed = context
        for window in self.windows:
            mixed = mixed + window_mean(context, window)
        return torch.addcmul(x, self.conv4(mixed).sigmoid(), x)


def window_mean(x: Tensor, window: int) -> Tensor:
    """Mean over the window around every position, of the positions inside the map alone.

    It is the mean over columns of means over rows, because every row has as many positions: 2 k
    additions instead of k^2.

    `x` is (N, C, H, W); `window` is odd.
    """
    for kernel, padding in (((window, 1), (window // 2, 0)), ((1, window), (0, window // 2))):
        x = F.avg_pool2d(x, kernel, 1, padding, count_include_pad=False)
    return x


class ConvFfn(nn.Module):
    """1x1 convolution, depthwise 3x3 convolution, exact GELU, 1x1 convolution."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Conv2d(dim, hidden, 1)
        depthwise = nn.Conv2d(hidden, hidden, 3, padding=1, groups=hidden)
        self.dwconv = nn.Sequential(OrderedDict(dwconv=depthwise))  # the released name
        self.fc2 = nn.Conv2d(hidden, dim, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> the same."""
        out: Tensor = self.fc2(F.gelu(self.dwconv(self.fc1(x))))
        return out


class PpxBlock(nn.Module):
    """Gated pooling and a feed-forward network; the channels of what passes by are weighted.

        y = x + l1 gate(norm(x))        w = sigmoid(conv over channels of the means of y)
        w y + l2 ffn(norm(y))           l1, l2: a learned factor per channel

    Source: CMNeXt release.
    """

    def __init__(
        self, dim: int, hidden: int, *, windows: tuple[int, ...], layer_scale: float
    ) -> None:
        super().__init__()
        self.norm1 = nn.BatchNorm2d(dim)
        self.attn = PoolingGate(dim, windows)
        self.norm2 = nn.BatchNorm2d(dim)
        self.mlp = ConvFfn(dim, hidden)
        self.layer_scale_1 = nn.Parameter(torch.full((dim,), layer_scale))
        self.layer_scale_2 = nn.Parameter(torch.full((dim,), layer_scale))
        self.c_nets = nn.Sequential(nn.Conv1d(1, 1, 3, padding=1, bias=False), nn.Sigmoid())

    def forward(self, x: Tensor, keep: Tensor | None = None) -> Tensor:
        """(N, H, W, C) -> the same; `keep`: (2, N, 1, 1, 1) factors of both residuals, or None."""
        first, second = (None, None) if keep is None else keep.unbind()
        x = x.permute(0, 3, 1, 2)
        y = add_residual(x, self.layer_scale_1[:, None, None] * self.attn(self.norm1(x)), first)
        weights = self.c_nets(y.mean((2, 3))[:, None]).view(*y.shape[:2], 1, 1)
        residual = self.layer_scale_2[:, None, None] * self.mlp(self.norm2(y))
        return add_residual(weights * y, residual, second).permute(0, 2, 3, 1)


def stage_modules(
    shape: MitShape,
    stage: int,
    *,
    in_channels: int,
    mlp_ratios: tuple[float, float, float, float],
    windows: tuple[int, ...],
    layer_scale: float,
) -> dict[str, nn.Module]:
    """As `rgbt.models.cmx.mit.stage_modules`; the other settings as in `CMNeXt`."""
    dim = shape.embed_dims[stage]
    hidden = int(dim * mlp_ratios[stage])
    return {
        "patch_embed": patch_embed(shape, stage, in_channels, norm_eps=MAP_NORM_EPS),
        "block": nn.ModuleList(
            PpxBlock(dim, hidden, windows=windows, layer_scale=layer_scale)
            for _ in range(shape.depths[stage])
        ),
        "norm": nn.LayerNorm(dim, eps=MAP_NORM_EPS),
    }
