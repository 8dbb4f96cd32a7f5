"""The network CMX: two MiT streams, the modules between them, and the decoder."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor, nn

from rgbt.models.cmx.decoder import MlpDecoder
from rgbt.models.cmx.encoder import CmxEncoder
from rgbt.models.cmx.mit import MitShape, Stage2, drop_rates, initialise, stage_modules
from rgbt.models.inputs import Inputs, only_view
from rgbt.models.parts import check_heads, check_hidden
from rgbt.ranges import Channels, Depths, Epsilon, MlpRatio, NumClasses, ShareBelowOne, Widths
from rgbt.requirements import Record
from rgbt.types import MaskPair, Output, View

BLOCK_NORM_EPS = 1e-6
"""Of the normalisations in front of attention and feed-forward and after a stage."""

Reduction = Annotated[int, Interval(ge=1, le=64)]


class CMX(nn.Module):
    """CMX with MiT streams for RGB and thermal.

    Source: J. Zhang et al., CMX: Cross-Modal Fusion for RGB-X Semantic Segmentation With
    Transformers, T-ITS 2023; the network of the temporal paper, too.   Released:
    huaaaliu/RGBX_Semantic_Segmentation; lab-sun/Temporal-Consistent-RGBT-Segmentation (the same
    network, other inputs).

    Args:
        num_classes: K.
        embed_dims: channels per stage.
        depths: blocks per stage.
        num_heads: heads per stage, of attention and of fusion.
        sr_ratios: how many times smaller per side the map is that a stage attends to.
        mlp_ratio: width of a block's feed-forward network divided by the width of the block.
        decoder_dim: E, channels of the decoder.
        drop_path_rate: stochastic depth of the last block, 0 at the first, in [0, 1).
        drop_path_stage2: "ramp": rates rise from block to block, as in MiT.   Released:
            "released": all RGB blocks of stage 2 have the rate of its first block, all thermal
            ones that of its second.
        decoder_dropout: share of channels dropped in front of the classifier, in [0, 1).
        decoder_norm_eps: of the decoder's batch normalisation, > 0.
        decoder_norm_eps_eval: of the same in evaluation; None: the same.   Released: CMX trains
            with 1e-3 and, as its evaluation skips the set-up of weights, evaluates with 1e-5.
        inputs: normalisation of the images.
    """

    record = Record(
        views=("rgbt",),
        pretrained_parts=("backbone.",),
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
        decoder_dim: Channels,
        drop_path_rate: ShareBelowOne,
        drop_path_stage2: Stage2,
        decoder_dropout: ShareBelowOne,
        decoder_norm_eps: Epsilon,
        decoder_norm_eps_eval: Epsilon | None,
        inputs: Inputs,
    ) -> None:
        super().__init__()
        shape = MitShape(embed_dims, depths, num_heads, sr_ratios, mlp_ratio)
        check_hidden("model.mlp_ratio", [mlp_ratio] * 4, embed_dims)
        check_heads(embed_dims, num_heads)
        self.num_classes = num_classes
        rates = drop_rates(depths, drop_path_rate, drop_path_stage2)
        rgb, thermal = (
            partial(stage_modules, shape, in_channels=channels, norm_eps=BLOCK_NORM_EPS)
            for channels in (3, inputs.thermal_channels)
        )
        self.backbone = CmxEncoder(
            shape, (rgb, thermal), drop_rates=rates if drop_path_rate > 0 else None
        )
        self.backbone.apply(initialise)
        self.decode_head = MlpDecoder(
            embed_dims,
            num_classes,
            dim=decoder_dim,
            dropout=decoder_dropout,
            norm_eps=(decoder_norm_eps, decoder_norm_eps_eval or decoder_norm_eps),
        )
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
        only_view(views, self.record.views, "CMX")
        maps = self.backbone(images, generator)
        return Output(self.decode_head(maps, rgb.shape[2:], generator), {})
