"""The network RGB-T Mask2Former: two Swin branches, pixel decoder and query decoder."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor, nn

from rgbt.geometry.padding import STRIDE, padded_hw
from rgbt.models.inputs import Inputs, expand_cells
from rgbt.models.mask2former.backbone import RgbtBackbone
from rgbt.models.mask2former.head import HeadShape, MaskHead, dense_logits, requested
from rgbt.models.mask2former.swin import PATCH, SwinShape
from rgbt.models.parts import check_heads
from rgbt.ranges import Blocks, Channels, Depths, MlpRatio, NumClasses, ShareBelowOne, Widths
from rgbt.requirements import Record
from rgbt.types import VIEWS, MaskPair, Output, View


class Mask2Former(nn.Module):
    """Two-branch Mask2Former of CRM and SpatialSeg.

    Source: CRM, Sec. III; SpatialSeg, Sec. III-A.   Released: UkcheolShin/CRM_RGBTSeg,
    lab-sun/SpatialSeg (the same network).

    Args:
        num_classes: K, without the no-object class.
        embed_dim: channels of the first stage; doubles from stage to stage.
        depths: blocks per stage.
        num_heads: attention heads per stage.
        window_size: side of an attention window, in tokens.
        mlp_ratio: width of a block's MLP divided by the width of the block.
        drop_path_rate: stochastic depth of a branch's last block, 0 at the first, in [0, 1).
        share_start: stages from this index on (0..4) are the same in both branches; 4 = none.
        fusion: "max" or "add" of the two branches.
        mask_token: what hidden cells show: a learned token of each branch (CRM, Eq. 1: L_rgb and
            L_thr; both releases), or "shared", the same one in both (SpatialSeg, Eqs. 12 and 13:
            one tau). A token has `embed_dim` values and stands behind the patch embedding.
        hidden_dim: channels of both decoders, a multiple of 32.
        num_queries: Q.
        encoder_layers: deformable layers of the pixel decoder.
        encoder_ffn_dim: width of their feed-forward networks.
        decoder_layers: layers of the query decoder, without the initial prediction.
        decoder_ffn_dim: width of theirs.
        attention_heads: heads of both decoders.
        pixel_decoder_fp32: keep the pixel decoder in single precision under autocast.
        inputs: normalisation of the images.
    """

    record = Record(
        outputs="masks",
        views=VIEWS,
        stacks_passes=True,
        dense_logits=True,
        pretrained_parts=("backbone.",),
        recomputed=(
            "backbone.*_branch.layers.*.blocks.*",
            "sem_seg_head.pixel_decoder.transformer.encoder.layers.*",
            "sem_seg_head.predictor.transformer_*_layers.*",
        ),
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
        fusion: Literal["max", "add"],
        hidden_dim: Channels,
        num_queries: Annotated[int, Interval(ge=1, le=10_000)],
        encoder_layers: Blocks,
        encoder_ffn_dim: Channels,
        decoder_layers: Blocks,
        decoder_ffn_dim: Channels,
        attention_heads: Channels,
        pixel_decoder_fp32: bool,
        inputs: Inputs,
        mask_token: Literal["branch", "shared"] = "branch",
    ) -> None:
        super().__init__()
        shape = SwinShape(embed_dim, depths, num_heads, window_size, mlp_ratio, drop_path_rate)
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
        check_heads(shape.widths, num_heads)
        self.num_classes = num_classes
        self.drop_path_rate = drop_path_rate
        self.backbone = RgbtBackbone(
            shape,
            share_start=share_start,
            fusion=fusion,
            mask_token=mask_token,
            thermal_channels=inputs.thermal_channels,
        )
        self.sem_seg_head = MaskHead(head, shape.widths)
        self.inputs = inputs

    def forward(  # noqa: PLR0913 - what every network takes, and what is stacked
        self,
        rgb: Tensor,
        thermal: Tensor,
        masks: MaskPair | None = None,
        *,
        passes: int = 1,
        views: tuple[View, ...] = (),
        num_predictions: int | None = None,
        num_masks: int | None = None,
        generator: torch.Generator | None = None,
    ) -> Output:
        """Predictions of every view and pass, as one batch through the head.

        Predictions are in the order F R T F' R' T': pass by pass, within it view by view.

        Args:
            rgb: as `rgbt.models` says, N = passes * B, pass by pass.
            thermal: likewise.
            masks: likewise; a cell is a square of a multiple of 4 pixels, whose tokens are hidden.
            passes: stacked copies of one batch. The fusion's batch normalisation sees them one
                after the other, as successive calls would show them.
            views: which features are predicted from, each at most once: "rgbt" (fused), "rgb",
                "thermal". () is "rgbt". A branch that no view needs is not computed.
            num_predictions: P, how many of the len(views) * passes predictions are computed, from
                the first one on. None: all.
            num_masks: M, how many of the P have mask logits, from the first one on; the others have
                class logits alone, which costs less, because the gradient of the finest features is
                not needed. None: all.
            generator: draws stochastic depth, per sample and branch; needed in training mode
                unless `drop_path_rate` is 0.

        Returns:
            logits: (B, K, H, W) float32 semantic scores in evaluation mode when there is one view
                and one pass, else None. They are sums over queries, not normalised.
            aux: with L = decoder_layers + 1, the last one final:
                "class_logits" (L, P, B, Q, K + 1), last column = no object;
                "mask_logits" (L, M, B, Q, h, w) at 1/4 of the padded size; in memory the order
                is M, B, L, Q, h, w.

        Raises:
            ValueError: shapes, passes, views or numbers of predictions that do not fit; no
                generator where one is needed.
            InputError: mask cells that do not divide the padded image.
        """
        wanted = requested(rgb.shape[0], passes, views, num_predictions, num_masks)
        if self.training and self.drop_path_rate > 0 and generator is None:
            raise ValueError("training with drop_path_rate > 0 requires `generator`, got None.")
        image_hw = rgb.shape[2], rgb.shape[3]
        images = self.inputs(rgb, thermal, multiple=STRIDE)
        cells = padded_hw(image_hw)
        hidden = None if masks is None else expand_cells(masks, rgb.shape[0], cells, PATCH)
        features = self.backbone(
            images,
            hidden,
            passes=passes,
            views=wanted.views,
            num_predictions=wanted.predictions,
            generator=generator,
        )
        output: Output = self.sem_seg_head(features, wanted, image_hw)
        return output

    def dense_logits(self, output: Output, image_hw: tuple[int, int]) -> Tensor:
        """As `rgbt.models.mask2former.head.dense_logits`."""
        return dense_logits(output, image_hw)
