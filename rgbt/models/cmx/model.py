"""The network CMX, and what it shares with CMNeXt: two streams that meet after every stage.

Parameter names are those of the releases.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Annotated, Literal, NamedTuple

import torch
from annotated_types import Interval
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.cmx.parts import (
    NORM_EPS,
    Rectification,
    StreamFusion,
    initialise,
    mit_blocks,
    mit_patch_embed,
)
from rgbt.models.inputs import Images, Inputs, Network
from rgbt.models.parts import Keep, check_heads, drop_channels, stochastic_depth
from rgbt.ranges import Channels, Depths, Epsilon, MlpRatio, NumClasses, ShareBelowOne, Widths
from rgbt.requirements import NetworkRecord
from rgbt.types import Output, View

STREAMS = ("", "extra_")  # before the names of the modules: RGB, and the other modality


class Stream(NamedTuple):
    """Says what one stream is made of."""

    in_channels: int  # channels of the image
    block: Callable[[int], nn.Module]  # makes a block of stage 0..3
    embed_eps: float  # epsilon of the normalisations in patch embeddings
    norm_eps: float  # epsilon of the normalisations after a stage


class CmxEncoder(nn.Module):
    """Computes maps of two streams with weights of their own, which meet after every stage.

    The next stage continues with what the rectification returns; the decoder reads what the fusion
    returns.   Source: CMX, Sec. III-A.
    """

    def __init__(
        self,
        streams: tuple[Stream, Stream],
        embed_dims: Widths,
        depths: Depths,
        num_heads: Widths,
        *,
        drop_rates: Tensor | None,
    ) -> None:
        super().__init__()
        check_heads("model.num_heads", num_heads, embed_dims)
        self.depths = depths
        self.drop_rates = drop_rates
        for prefix, stream in zip(STREAMS, streams, strict=True):
            before = stream.in_channels
            for stage, (dim, depth) in enumerate(zip(embed_dims, depths, strict=True)):
                kernel, stride = (3, 2) if stage else (7, 4)
                embed = mit_patch_embed(before, dim, kernel, stride, norm_eps=stream.embed_eps)
                blocks = nn.ModuleList(stream.block(stage) for _ in range(depth))
                self.add_module(f"{prefix}patch_embed{stage + 1}", embed)
                self.add_module(f"{prefix}block{stage + 1}", blocks)
                self.add_module(f"{prefix}norm{stage + 1}", nn.LayerNorm(dim, eps=stream.norm_eps))
                before = dim
        self.FRMs = nn.ModuleList(Rectification(dim) for dim in embed_dims)
        self.FFMs = nn.ModuleList(
            StreamFusion(dim, heads) for dim, heads in zip(embed_dims, num_heads, strict=True)
        )

    def forward(self, images: Images, generator: torch.Generator | None) -> list[Tensor]:
        """Return fused maps of four stages, (N, h, w, C_s): H and W over 4 to 32, rounded up."""
        rgb, thermal = (image.permute(0, 2, 3, 1).contiguous() for image in images)
        rates = self.drop_rates if self.training else None
        keeps = stochastic_depth(rates, 2 * self.depths, rgb, generator)
        fused = []
        for stage, (rectify, fuse) in enumerate(zip(self.FRMs, self.FFMs, strict=True)):
            rgb = self._stage(STREAMS[0], stage, rgb, keeps[stage])
            thermal = self._stage(STREAMS[1], stage, thermal, keeps[4 + stage])
            rgb, thermal = rectify(rgb, thermal)
            fused.append(fuse(rgb, thermal))
        return fused

    def _stage(self, prefix: str, stage: int, x: Tensor, keeps: Sequence[Keep]) -> Tensor:
        x = self.get_submodule(f"{prefix}patch_embed{stage + 1}")(x)
        blocks = self.get_submodule(f"{prefix}block{stage + 1}").children()
        for block, keep in zip(blocks, keeps, strict=True):
            x = block(x, keep)
        return self.get_submodule(f"{prefix}norm{stage + 1}")(x)


class MlpDecoder(nn.Module):
    """Projects every map to E channels, enlarges them, joins and mixes them, and predicts classes.

        ReLU(BatchNorm(conv1x1([c4, c3, c2, c1]))),  c_i = enlarge(linear_i(x_i))

    Enlarging is linear and its weights sum to 1, so that it may follow the convolution: each map is
    multiplied by its own columns of the weight at its own size, and by both matrices at once. The
    numbers are the same to rounding, at a fraction of the operations and without a map of 4 E
    channels.

    Source: SegFormer, Sec. 3.2, Eq. (4); CMX, Sec. III-A.

    `widths` are channels of the four maps, the largest first; `dim` is E; `norm_eps` is that of
    training and of evaluation; `mix_bias` is that of the convolution over the joined maps.
    """

    def __init__(
        self,
        widths: tuple[int, int, int, int],
        num_classes: int,
        *,
        dim: int,
        dropout: float,
        norm_eps: tuple[float, float],
        mix_bias: bool = True,
    ) -> None:
        super().__init__()
        self.dropout = dropout
        self.norm_eps = norm_eps
        self.linear_c1, self.linear_c2, self.linear_c3, self.linear_c4 = (
            nn.Sequential(OrderedDict(proj=nn.Linear(width, dim))) for width in widths
        )
        fuse = nn.Conv2d(4 * dim, dim, 1, bias=mix_bias)
        self.linear_fuse = nn.Sequential(fuse, nn.BatchNorm2d(dim, eps=norm_eps[0]), nn.ReLU())
        self.linear_pred = nn.Conv2d(dim, num_classes, 1)
        for convolution in (fuse, self.linear_pred):
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")

    def train(self, mode: bool = True) -> MlpDecoder:
        """Set the mode, and the eps that belongs to it."""
        self.linear_fuse[1].eps = self.norm_eps[0 if mode else 1]  # type: ignore[assignment]
        return super().train(mode)

    def forward(
        self, maps: list[Tensor], image_hw: Sequence[int], generator: torch.Generator | None = None
    ) -> Tensor:
        """Predict class scores (N, K, H, W) float32 from four (N, H_i, W_i, C_i), largest first.

        They are computed at the size of the first map, a quarter of the image, and enlarged.
        """
        # The release joins the maps in the order c4, c3, c2, c1.
        fuse = dict(self.linear_fuse[0].named_parameters())
        parts = fuse["weight"].flatten(1).chunk(4, 1)[::-1]
        projections = (self.linear_c1, self.linear_c2, self.linear_c3, self.linear_c4)
        mixed: Tensor | None = None
        for projection, x, part in zip(projections, maps, parts, strict=True):
            offset = part @ projection.get_parameter("proj.bias")
            if mixed is None and "bias" in fuse:
                offset = offset + fuse["bias"]
            weight = part @ projection.get_parameter("proj.weight")
            small = F.linear(x, weight, offset).permute(0, 3, 1, 2)
            mixed = small if mixed is None else mixed + _resized(small, mixed.shape[2:])
        mixed = self.linear_fuse[1:](mixed)
        mixed = drop_channels(mixed, self.dropout if self.training else 0.0, generator)
        return _resized(self.linear_pred(mixed).float(), image_hw)


def _resized(x: Tensor, hw: Sequence[int]) -> Tensor:
    return F.interpolate(x, size=tuple(hw), mode="bilinear", align_corners=False)


class CmxNetwork(Network):
    """Predicts by two streams and the decoder; CMX and CMNeXt differ in what these are made of."""

    record = NetworkRecord(
        views=("rgbt",),
        pretrained_parts=("backbone.",),
        recomputed=("backbone.*block*.*", "backbone.FRMs.*", "backbone.FFMs.*"),
    )

    def __init__(self, backbone: CmxEncoder, decode_head: MlpDecoder, inputs: Inputs) -> None:
        super().__init__()
        self.num_classes = decode_head.linear_pred.out_channels
        self.backbone = backbone
        self.decode_head = decode_head
        self.inputs = inputs

    def predict(self, images: Images, view: View, generator: torch.Generator | None) -> Output:  # noqa: ARG002
        """Predict class scores of every pixel, float32; `aux` is empty.

        Sides may have any length from 29 (with the released `sr_ratios`). Stochastic depth is drawn
        per sample, block and stream, then the decoder's dropped channels.
        """
        maps = self.backbone(images, generator)
        return Output(self.decode_head(maps, images.rgb.shape[2:], generator), {})


BLOCK_NORM_EPS = 1e-6  # in front of attention and feed-forward and after a stage

Reduction = Annotated[int, Interval(ge=1, le=64)]
Reductions = tuple[Reduction, Reduction, Reduction, Reduction]
Stage2 = Literal["ramp", "released"]


class CMX(CmxNetwork):
    """Predicts from both images by CMX with MiT streams.

    Source: J. Zhang et al., CMX: Cross-Modal Fusion for RGB-X Semantic Segmentation With
    Transformers, T-ITS 2023; the network of the temporal paper, too.   Released:
    huaaaliu/RGBX_Semantic_Segmentation; lab-sun/Temporal-Consistent-RGBT-Segmentation (the same
    network, other inputs, and an unused layer `voting`).

    The arguments are the keys of ``conf/model/cmx.yaml``. The release trains with a
    `decoder_norm_eps` of 1e-3, and evaluates with 1e-5, without the set-up of weights.
    """

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        embed_dims: Widths,
        depths: Depths,
        num_heads: Widths,
        sr_ratios: Reductions,
        mlp_ratio: MlpRatio,
        decoder_dim: Channels,
        drop_path_rate: ShareBelowOne,
        drop_path_stage2: Stage2,
        decoder_dropout: ShareBelowOne,
        decoder_norm_eps: Epsilon,
        decoder_norm_eps_eval: Epsilon | None,
        inputs: Inputs,
    ) -> None:
        block = mit_blocks(embed_dims, num_heads, sr_ratios, mlp_ratio, norm_eps=BLOCK_NORM_EPS)
        streams = (
            Stream(3, block, NORM_EPS, BLOCK_NORM_EPS),
            Stream(inputs.thermal_channels, block, NORM_EPS, BLOCK_NORM_EPS),
        )
        rates = drop_rates(depths, drop_path_rate, drop_path_stage2)
        backbone = CmxEncoder(streams, embed_dims, depths, num_heads, drop_rates=rates)
        backbone.apply(initialise)
        decode_head = MlpDecoder(
            embed_dims,
            num_classes,
            dim=decoder_dim,
            dropout=decoder_dropout,
            norm_eps=(decoder_norm_eps, decoder_norm_eps_eval or decoder_norm_eps),
        )
        super().__init__(backbone, decode_head, inputs)


def drop_rates(depths: Depths, last: float, stage2: Stage2 = "ramp") -> Tensor | None:
    """Return stochastic depth of every block of the two streams, (2, blocks): RGB's, thermal's.

    Rates rise evenly from 0 to `last`. `stage2` "released": stage 2 has one rate per stream, that
    of its first block for RGB and the next one on the ramp for thermal.
    """
    if last == 0:
        return None
    rates = torch.linspace(0, last, sum(depths)).repeat(2, 1)
    if stage2 == "released":
        start = depths[0]
        rates[:, start : start + depths[1]] = rates[0, start : start + 2, None].clone()
    return rates
