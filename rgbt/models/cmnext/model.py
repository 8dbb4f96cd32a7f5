"""The network CMNeXt: a MiT stream, a pooling stream, CMX's modules between them, the decoder."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import torch
from annotated_types import Interval, Len, Predicate, doc
from torch import Tensor, nn

from rgbt.models.cmnext import ppx
from rgbt.models.cmx import mit
from rgbt.models.cmx.decoder import MlpDecoder
from rgbt.models.cmx.encoder import CmxEncoder
from rgbt.models.cmx.model import Reduction
from rgbt.models.inputs import Inputs, only_view
from rgbt.models.parts import check_heads, check_hidden
from rgbt.ranges import Channels, Depths, Epsilon, MlpRatio, NumClasses, ShareBelowOne, Widths
from rgbt.requirements import Record
from rgbt.types import MaskPair, Output, View


def _is_odd(number: int) -> bool:
    return number % 2 == 1


Window = Annotated[int, Interval(ge=1, le=99), Predicate(_is_odd), doc("positions, odd")]
LayerScale = Annotated[float, Interval(gt=0, le=1)]


class CMNeXt(nn.Module):
    """CMNeXt for RGB and one further modality, thermal.

    Source: J. Zhang et al., Delivering Arbitrary-Modal Semantic Segmentation, CVPR 2023.
    Released: jamycheung/DELIVER. With two modalities its self-query hub does not exist.

    Args:
        num_classes: K.
        embed_dims: channels per stage, of both streams.
        depths: blocks per stage, of both streams.
        num_heads: heads per stage, of the RGB stream's attention and of fusion.
        sr_ratios: how many times smaller per side the map is that an RGB stage attends to.
        mlp_ratio: width of an RGB block's feed-forward network divided by the width of the block.
        thermal_mlp_ratios: the same of the thermal blocks, per stage.
        pool_windows: sides of the windows whose means a thermal block adds up, odd; none: it sees
            its 7x7 convolution alone.
        layer_scale: what both residuals of a thermal block are multiplied by at the start.
        decoder_dim: E, channels of the decoder.
        drop_path_rate: stochastic depth of the last blocks, 0 at the first, in [0, 1).
        decoder_dropout: share of channels dropped in front of the classifier, in [0, 1).
        decoder_norm_eps: of the decoder's batch normalisation, > 0.
        inputs: normalisation of the images.
    """

    record = Record(
        views=("rgbt",),
        # ImageNet's file covers the RGB stream alone.
        pretrained_parts=("backbone.patch_embed", "backbone.block", "backbone.norm"),
        recomputed=("backbone.*block*.*", "backbone.FRMs.*", "backbone.FFMs.*"),
    )

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        embed_dims: Widths,
        depths: Depths,
        num_heads: Widths,
        sr_ratios: tuple[Reduction, Reduction, Reduction, Reduction],
        mlp_ratio: MlpRatio,
        thermal_mlp_ratios: tuple[MlpRatio, MlpRatio, MlpRatio, MlpRatio],
        pool_windows: Annotated[tuple[Window, ...], Len(0, 10)],
        layer_scale: LayerScale,
        decoder_dim: Channels,
        drop_path_rate: ShareBelowOne,
        decoder_dropout: ShareBelowOne,
        decoder_norm_eps: Epsilon,
        inputs: Inputs,
    ) -> None:
        super().__init__()
        shape = mit.MitShape(embed_dims, depths, num_heads, sr_ratios, mlp_ratio)
        check_hidden("model.mlp_ratio", [mlp_ratio] * 4, embed_dims)
        check_hidden("model.thermal_mlp_ratios", thermal_mlp_ratios, embed_dims)
        check_heads(embed_dims, num_heads)
        self.num_classes = num_classes
        rgb = partial(mit.stage_modules, shape, in_channels=3, norm_eps=mit.NORM_EPS)
        thermal = partial(
            ppx.stage_modules,
            shape,
            in_channels=inputs.thermal_channels,
            mlp_ratios=thermal_mlp_ratios,
            windows=pool_windows,
            layer_scale=layer_scale,
        )
        rates = mit.drop_rates(depths, drop_path_rate, "ramp")
        self.backbone = CmxEncoder(
            shape, (rgb, thermal), drop_rates=rates if drop_path_rate > 0 else None
        )
        self.decode_head = MlpDecoder(
            embed_dims,
            num_classes,
            dim=decoder_dim,
            dropout=decoder_dropout,
            norm_eps=(decoder_norm_eps, decoder_norm_eps),
            mix_bias=False,
        )
        self.apply(partial(mit.initialise, divide_groups=False))
        self.inputs = inputs

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
        images = self.inputs(rgb, thermal, masks, multiple=1)
        only_view(views, self.record.views, "CMNeXt")
        maps = self.backbone(images, generator)
        return Output(self.decode_head(maps, rgb.shape[2:], generator), {})
