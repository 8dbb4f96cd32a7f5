"""The network CMX: two MiT streams, the modules between them, and the decoder."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from rgbt.models.cmx.mit import NORM_EPS, initialise, mit_blocks
from rgbt.models.cmx.network import CmxEncoder, CmxNetwork, MlpDecoder, Stream
from rgbt.models.inputs import Inputs
from rgbt.ranges import Channels, Depths, Epsilon, MlpRatio, NumClasses, ShareBelowOne, Widths

BLOCK_NORM_EPS = 1e-6
"""Of the normalisations in front of attention and feed-forward and after a stage."""

Reduction = Annotated[int, Interval(ge=1, le=64)]
Reductions = tuple[Reduction, Reduction, Reduction, Reduction]
Stage2 = Literal["ramp", "released"]


class CMX(CmxNetwork):
    """CMX with MiT streams for RGB and thermal.

    Source: J. Zhang et al., CMX: Cross-Modal Fusion for RGB-X Semantic Segmentation With
    Transformers, T-ITS 2023; the network of the temporal paper, too.   Released:
    huaaaliu/RGBX_Semantic_Segmentation; lab-sun/Temporal-Consistent-RGBT-Segmentation (the same
    network, other inputs, and an unused layer `voting`).

    The arguments are the keys of ``conf/model/cmx_b2.yaml``. The release trains with a
    `decoder_norm_eps` of 1e-3 and, as its evaluation skips the set-up of weights, evaluates with
    1e-5.
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
        rates = drop_rates(depths, drop_path_rate, drop_path_stage2) if drop_path_rate else None
        backbone = CmxEncoder(streams, embed_dims, depths, num_heads, drop_rates=rates)
        backbone.apply(initialise)
        decode_head = MlpDecoder(
            embed_dims,
            num_classes,
            dim=decoder_dim,
            dropout=decoder_dropout,
            norm_eps=(decoder_norm_eps, decoder_norm_eps_eval or decoder_norm_eps),
        )
        super().__init__(backbone, decode_head, inputs, sr_ratios)


def drop_rates(depths: Depths, last: float, stage2: Stage2 = "ramp") -> Tensor:
    """Stochastic depth of every block of the two streams, (2, blocks): RGB's, thermal's.

    Rates rise evenly from 0 to `last`. `stage2` "released": stage 2 has one rate per stream, that
    of its first block for RGB and the next one on the ramp for thermal; "ramp": no exception.
    """
    rates = torch.linspace(0, last, sum(depths)).repeat(2, 1)
    if stage2 == "released":
        start = depths[0]
        rates[:, start : start + depths[1]] = rates[0, start : start + 2, None].clone()
    return rates
