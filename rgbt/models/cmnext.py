"""CMNeXt for RGB and thermal: a MiT stream for RGB, a pooling stream for thermal.

The rest is CMX's: what lies between the streams, and the decoder. Not here: the self-query hub,
which exists from three modalities on. Maps are (N, H, W, C) between the blocks, as in
`rgbt.models.cmx.parts`, and (N, C, H, W) inside those of the parallel pooling mixer (PPX).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Annotated

import torch
from annotated_types import Interval, Len, Predicate, doc
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.cmx.model import (
    CmxEncoder,
    CmxNetwork,
    MlpDecoder,
    Reductions,
    Stream,
    drop_rates,
)
from rgbt.models.cmx.parts import NORM_EPS, initialise, mit_blocks, mix_ffn
from rgbt.models.inputs import Inputs
from rgbt.models.parts import ALL_KEPT, Keep, add_residual
from rgbt.ranges import Channels, Depths, Epsilon, MlpRatio, NumClasses, ShareBelowOne, Widths

MAP_NORM_EPS = 1e-6  # thermal patch embeddings and after its stages; RGB stream: 1e-5


class PoolingGate(nn.Module):
    """Gates a map by its means over windows of several sizes (CMNeXt release).

    sigmoid(conv1x1(c + sum_k mean_k(c))) x + x,   c = depthwise 7x7 of x
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
    """Average (N, C, H, W) over the odd window around every position, inside the map alone."""
    # The mean over columns of means over rows: every row has as many positions.
    for kernel, padding in (((window, 1), (window // 2, 0)), ((1, window), (0, window // 2))):
        x = F.avg_pool2d(x, kernel, 1, padding, count_include_pad=False)
    return x


class PpxBlock(nn.Module):
    """Adds gated pooling and a feed-forward network to a map whose channels are weighted.

    y = x + l1 gate(norm(x))        w = sigmoid(conv over channels of the means of y)
    w y + l2 ffn(norm(y))           l1, l2: a learned factor per channel
    """

    def __init__(
        self, dim: int, hidden: int, *, windows: tuple[int, ...], layer_scale: float
    ) -> None:
        super().__init__()
        self.norm1 = nn.BatchNorm2d(dim)
        self.attn = PoolingGate(dim, windows)
        self.norm2 = nn.BatchNorm2d(dim)
        self.mlp = mix_ffn(
            nn.Conv2d(dim, hidden, 1),
            nn.Conv2d(hidden, hidden, 3, padding=1, groups=hidden),
            nn.Conv2d(hidden, dim, 1),
        )
        self.layer_scale_1 = nn.Parameter(torch.full((dim,), layer_scale))
        self.layer_scale_2 = nn.Parameter(torch.full((dim,), layer_scale))
        self.c_nets = nn.Sequential(nn.Conv1d(1, 1, 3, padding=1, bias=False), nn.Sigmoid())

    def forward(self, x: Tensor, keep: Keep = ALL_KEPT) -> Tensor:
        """(N, H, W, C) -> the same."""
        first, second = keep
        x = x.permute(0, 3, 1, 2)
        y = add_residual(x, self.layer_scale_1[:, None, None] * self.attn(self.norm1(x)), first)
        weights = self.c_nets(y.mean((2, 3))[:, None]).view(*y.shape[:2], 1, 1)
        residual = self.layer_scale_2[:, None, None] * self.mlp(self.norm2(y))
        return add_residual(weights * y, residual, second).permute(0, 2, 3, 1)


Window = Annotated[int, Interval(ge=1, le=99), Predicate(lambda n: n % 2), doc("positions, odd")]


class CMNeXt(CmxNetwork):
    """Predicts from both images by CMNeXt, whose further modality is thermal.

    Source: J. Zhang et al., Delivering Arbitrary-Modal Semantic Segmentation, CVPR 2023.
    Released: jamycheung/DELIVER. With two modalities its self-query hub does not exist.

    The arguments are the keys of ``conf/model/cmnext.yaml``.
    """

    # ImageNet's file covers the RGB stream alone.
    record = replace(
        CmxNetwork.record,
        pretrained_parts=("backbone.patch_embed", "backbone.block", "backbone.norm"),
    )

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        embed_dims: Widths,
        depths: Depths,
        num_heads: Widths,
        sr_ratios: Reductions,
        mlp_ratio: MlpRatio,
        thermal_mlp_ratios: tuple[MlpRatio, MlpRatio, MlpRatio, MlpRatio],
        pool_windows: Annotated[tuple[Window, ...], Len(0, 10)],
        layer_scale: Annotated[float, Interval(gt=0, le=1)],
        decoder_dim: Channels,
        drop_path_rate: ShareBelowOne,
        decoder_dropout: ShareBelowOne,
        decoder_norm_eps: Epsilon,
        inputs: Inputs,
    ) -> None:
        def thermal(stage: int) -> nn.Module:
            dim, ratio = embed_dims[stage], thermal_mlp_ratios[stage]
            return PpxBlock(dim, int(dim * ratio), windows=pool_windows, layer_scale=layer_scale)

        rgb = mit_blocks(embed_dims, num_heads, sr_ratios, mlp_ratio, norm_eps=NORM_EPS)
        streams = (
            Stream(3, rgb, NORM_EPS, NORM_EPS),
            Stream(inputs.thermal_channels, thermal, MAP_NORM_EPS, MAP_NORM_EPS),
        )
        rates = drop_rates(depths, drop_path_rate)
        backbone = CmxEncoder(streams, embed_dims, depths, num_heads, drop_rates=rates)
        decode_head = MlpDecoder(
            embed_dims,
            num_classes,
            dim=decoder_dim,
            dropout=decoder_dropout,
            norm_eps=(decoder_norm_eps, decoder_norm_eps),
            mix_bias=False,
        )
        super().__init__(backbone, decode_head, inputs)
        self.apply(partial(initialise, divide_groups=False))
