"""The network RGB-T Mask2Former: two Swin branches with Mask2Former's head."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor, nn

from rgbt.models.inputs import Inputs
from rgbt.models.mask2former.head import HeadShape
from rgbt.models.mask2former.network import (
    RECORD,
    Fusion,
    FusionKind,
    HiddenDim,
    Maps,
    MaskNetwork,
    NumQueries,
)
from rgbt.models.parts import check_heads
from rgbt.models.swin import PATCH, Stage, Swin, SwinShape
from rgbt.ranges import Blocks, Channels, Depths, MlpRatio, NumClasses, ShareBelowOne, Widths


class RgbtBackbone(nn.Module):
    """Computes maps of both images by a Swin branch each; the fusion is here too.

    Stages from `share_start` on (0..4) are the RGB branch's own in both branches; embedding and
    output normalisations never are.   Source: CRM, Sec. III-B.
    """

    token_px = PATCH

    def __init__(
        self,
        shape: SwinShape,
        *,
        share_start: int,
        fusion: FusionKind,
        mask_token: str,
        thermal_channels: int,
    ) -> None:
        super().__init__()
        self.RGB_branch = Swin(3, shape=shape, shared={})
        shared: dict[int, Stage] = {}
        for index, stage in enumerate(self.RGB_branch.layers):
            assert isinstance(stage, Stage), "a branch has stages alone"
            if index >= share_start:
                shared[index] = stage
        self.THR_branch = Swin(thermal_channels, shape=shape, shared=shared)
        if mask_token == "shared":
            self.THR_branch.mask_token = self.RGB_branch.mask_token
        self.norm_layers = Fusion(shape.widths, fusion)

    def maps(
        self, modality: str, image: Tensor, hidden: Tensor | None, generator: torch.Generator | None
    ) -> Maps:
        """Return maps of (N, c, H, W), sides multiples of 32, hidden tokens (N, H / 4, W / 4)."""
        branch = self.RGB_branch if modality == "rgb" else self.THR_branch
        return branch(image, hidden, generator)


class Mask2Former(MaskNetwork):
    """Predicts from both images by the two-branch Mask2Former of CRM and SpatialSeg.

    Parameter names are those of the released checkpoints without their leading `network.`.

    Source: CRM, Sec. III; SpatialSeg, Sec. III-A.   Released: UkcheolShin/CRM_RGBTSeg,
    lab-sun/SpatialSeg (the same network).

    The arguments are the keys of ``conf/model/mask2former.yaml``.
    """

    record = replace(
        RECORD,
        pretrained_parts=("backbone.",),
        recomputed=("backbone.*_branch.layers.*.blocks.*", *RECORD.recomputed),
    )

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        embed_dim: Channels,
        depths: Depths,
        num_heads: Widths,
        window_size: Annotated[int, Interval(ge=1, le=1024)],
        mlp_ratio: MlpRatio,
        drop_path_rate: ShareBelowOne,
        share_start: Annotated[int, Interval(ge=0, le=4)],
        fusion: FusionKind,
        hidden_dim: HiddenDim,
        num_queries: NumQueries,
        encoder_layers: Blocks,
        encoder_ffn_dim: Channels,
        decoder_layers: Blocks,
        decoder_ffn_dim: Channels,
        attention_heads: Channels,
        pixel_decoder_fp32: bool,
        inputs: Inputs,
        mask_token: Literal["branch", "shared"] = "branch",
    ) -> None:
        shape = SwinShape(embed_dim, depths, num_heads, window_size, mlp_ratio, drop_path_rate)
        check_heads("model.num_heads", num_heads, shape.widths)
        backbone = RgbtBackbone(
            shape,
            share_start=share_start,
            fusion=fusion,
            mask_token=mask_token,
            thermal_channels=inputs.thermal_channels,
        )
        head = HeadShape(
            num_classes=num_classes,
            hidden_dim=hidden_dim,
            num_queries=num_queries,
            encoder_layers=encoder_layers,
            encoder_ffn_dim=encoder_ffn_dim,
            decoder_layers=decoder_layers,
            decoder_ffn_dim=decoder_ffn_dim,
            attention_heads=attention_heads,
            pixel_decoder_fp32=pixel_decoder_fp32,
        )
        super().__init__(backbone, head, inputs)
