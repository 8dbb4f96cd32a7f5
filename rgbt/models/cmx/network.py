"""What CMX and CMNeXt share: two streams that meet after every stage, and the decoder.

Parameter names are those of the releases.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.cmx.fusion import Fusion, Rectification
from rgbt.models.cmx.mit import MitPatchEmbed
from rgbt.models.inputs import Images, Inputs, only_view
from rgbt.models.parts import Keep, check_heads, drop_channels, stochastic_depth
from rgbt.ranges import Depths, Widths
from rgbt.requirements import Record
from rgbt.types import MaskPair, Output, View

STREAMS = ("", "extra_")
"""Beginnings of the names of the streams' modules: RGB, and the other modality."""


@dataclass(frozen=True)
class Stream:
    """What one stream is made of.

    Attributes:
        in_channels: of the image.
        block: makes a block of stage 0..3.
        embed_eps: of the normalisations in patch embeddings.
        norm_eps: of the normalisations after a stage.
    """

    in_channels: int
    block: Callable[[int], nn.Module]
    embed_eps: float
    norm_eps: float


class CmxEncoder(nn.Module):
    """Two streams with weights of their own that meet after every stage.

    The next stage continues with what the rectification returns; the decoder reads what the fusion
    returns.   Source: CMX, Sec. III-A.

    `drop_rates` (2, blocks) are probabilities of stochastic depth, RGB's and thermal's; None: none;
    the other arguments: see `CMX`.
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
                embed = MitPatchEmbed(before, dim, kernel, stride, norm_eps=stream.embed_eps)
                blocks = nn.ModuleList(stream.block(stage) for _ in range(depth))
                self.add_module(f"{prefix}patch_embed{stage + 1}", embed)
                self.add_module(f"{prefix}block{stage + 1}", blocks)
                self.add_module(f"{prefix}norm{stage + 1}", nn.LayerNorm(dim, eps=stream.norm_eps))
                before = dim
        self.FRMs = nn.ModuleList(Rectification(dim) for dim in embed_dims)
        self.FFMs = nn.ModuleList(
            Fusion(dim, heads) for dim, heads in zip(embed_dims, num_heads, strict=True)
        )

    def forward(self, images: Images, generator: torch.Generator | None) -> list[Tensor]:
        """Fused maps of the four stages, (N, h, w, C_s): H and W over 4, 8, 16, 32, rounded up.

        `images` are (N, 3, H, W) and (N, c, H, W), normalised; `generator` draws stochastic depth,
        in training mode with rates alone.
        """
        rgb, thermal = (image.permute(0, 2, 3, 1).contiguous() for image in images)
        rates = None
        if self.training and self.drop_rates is not None:
            rates = self.drop_rates.flatten()
        keeps = stochastic_depth(rates, 2 * self.depths, rgb, generator)
        fused = []
        for stage, (rectify, fuse) in enumerate(zip(self.FRMs, self.FFMs, strict=True)):
            rgb = self._stage(STREAMS[0], stage, rgb, keeps[stage])
            thermal = self._stage(STREAMS[1], stage, thermal, keeps[4 + stage])
            rgb, thermal = rectify(rgb, thermal)
            fused.append(fuse(rgb, thermal))
        return fused

    def _stage(self, prefix: str, stage: int, x: Tensor, keeps: Sequence[Keep]) -> Tensor:
        embed, blocks, norm = (
            self.get_submodule(f"{prefix}{name}{stage + 1}")
            for name in ("patch_embed", "block", "norm")
        )
        x = embed(x)
        for block, keep in zip(blocks.children(), keeps, strict=True):
            x = block(x, keep)
        normed: Tensor = norm(x)
        return normed


class MlpDecoder(nn.Module):
    """Every map to E channels, enlarged to the first one's size, joined, mixed and classified.

        ReLU(BatchNorm(conv1x1([c4, c3, c2, c1]))),  c_i = enlarge(linear_i(x_i))

    Enlarging is linear and its weights sum to 1, so that it may follow the convolution instead:
    each map meets its own part of the convolution at its own size, and the two linear maps are
    one whose matrix is their product. The same numbers to rounding, at a fraction of the
    operations and without the map of 4 E channels.

    Source: SegFormer, Sec. 3.2, Eq. (4); CMX, Sec. III-A.

    `widths` are channels of the four maps, the largest first; `dim` is E; `norm_eps` is that of the
    normalisation in training and in evaluation; `mix_bias`: whether the convolution over the joined
    maps has a bias, as in CMX.
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
        """Also chooses the eps of the normalisation, of any class that normalises a batch."""
        self.linear_fuse[1].eps = self.norm_eps[0 if mode else 1]  # type: ignore[assignment]
        return super().train(mode)

    def forward(
        self, maps: list[Tensor], image_hw: Sequence[int], generator: torch.Generator | None = None
    ) -> Tensor:
        """Class scores (N, K, H, W) float32 of four (N, H_i, W_i, C_i), the largest first.

        They are computed at the size of the first map, a quarter of the image, and enlarged.
        `generator` draws the dropped channels, in training mode with a rate above 0 alone.
        """
        # The convolution over the four projected and enlarged maps, (N, E, H_1, W_1). The release
        # joins the maps in the order c4, c3, c2, c1.
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


class CmxNetwork(nn.Module):
    """Two streams and the decoder; CMX and CMNeXt differ in what these are made of."""

    record = Record(
        views=("rgbt",),
        pretrained_parts=("backbone.",),
        recomputed=("backbone.*block*.*", "backbone.FRMs.*", "backbone.FFMs.*"),
    )

    def __init__(
        self, backbone: CmxEncoder, decode_head: MlpDecoder, inputs: Inputs, sr_ratios: Widths
    ) -> None:
        super().__init__()
        self.num_classes = decode_head.linear_pred.out_channels
        self.backbone = backbone
        self.decode_head = decode_head
        self.inputs = inputs
        # The smallest image whose every map is at least as large as the kernel that shrinks it.
        reduced = zip((4, 8, 16, 32), sr_ratios, strict=True)
        self.shortest_side = max(stride * (ratio - 1) + 1 for stride, ratio in reduced)

    def forward(
        self,
        rgb: Tensor,
        thermal: Tensor,
        masks: MaskPair | None = None,
        *,
        views: tuple[View, ...] = (),
        generator: torch.Generator | None = None,
    ) -> Output:
        """Class scores of every pixel, as `rgbt.models` says; float32, `aux` is empty.

        Sides may have any length from 29 (with the released `sr_ratios`). Stochastic depth is drawn
        per sample, block and stream, then the decoder's dropped channels.

        Raises:
            InputError: images smaller than the deepest reduction of attention takes.
        """
        only_view(views, self.record.views, type(self).__name__)
        images = self.inputs(rgb, thermal, masks)
        if min(rgb.shape[2:]) < self.shortest_side:
            least, got = self.shortest_side, " x ".join(map(str, rgb.shape[2:]))
            raise InputError(f"model.sr_ratios: sides must be {least} pixels or more, got {got}.")
        maps = self.backbone(images, generator)
        return Output(self.decode_head(maps, rgb.shape[2:], generator), {})
