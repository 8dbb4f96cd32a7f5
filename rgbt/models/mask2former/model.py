"""The network RGB-T Mask2Former: backbone, pixel decoder and query decoder."""

from __future__ import annotations

from collections import OrderedDict
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError, check_choice
from rgbt.geometry.padding import STRIDE, padded_hw
from rgbt.models.inputs import Inputs, expand_cells
from rgbt.models.mask2former.backbone import RgbtBackbone
from rgbt.models.mask2former.decoder import Predictor
from rgbt.models.mask2former.pixel_decoder import GROUPS, PixelDecoder
from rgbt.models.mask2former.swin import PATCH, SwinShape
from rgbt.models.parts import check_heads
from rgbt.ranges import Blocks, Channels, Depths, MlpRatio, NumClasses, ShareBelowOne, Widths
from rgbt.requirements import Record
from rgbt.types import VIEWS, MaskPair, Output, View

FAINTEST = 1e-6
"""Smallest semantic score whose logarithm is taken."""


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
        if hidden_dim % GROUPS or hidden_dim % attention_heads:
            raise InputError(
                f"model.hidden_dim must be a multiple of {GROUPS} and of model.attention_heads "
                f"({attention_heads}), got {hidden_dim}."
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
        pixel_decoder = PixelDecoder(
            shape.widths,
            hidden_dim=hidden_dim,
            encoder_layers=encoder_layers,
            heads=attention_heads,
            ffn_dim=encoder_ffn_dim,
            fp32=pixel_decoder_fp32,
        )
        predictor = Predictor(
            num_classes,
            hidden_dim=hidden_dim,
            num_queries=num_queries,
            num_layers=decoder_layers,
            heads=attention_heads,
            ffn_dim=decoder_ffn_dim,
        )
        parts = {"pixel_decoder": pixel_decoder, "predictor": predictor}
        self.sem_seg_head = nn.Sequential(OrderedDict(parts))
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
        views = views or VIEWS[:1]
        if passes < 1 or rgb.shape[0] % passes:
            raise ValueError(f"{rgb.shape[0]} images are not {passes} stacked passes of one batch.")
        if len(set(views)) < len(views):
            raise ValueError(f"views must name each view at most once, got {views}.")
        for view in views:
            check_choice("view", view, VIEWS)
        stacked = len(views) * passes
        predictions = stacked if num_predictions is None else num_predictions
        with_masks = predictions if num_masks is None else num_masks
        if not 1 <= with_masks <= predictions <= stacked:
            raise ValueError(
                f"num_predictions={num_predictions} and num_masks={num_masks} do not fit: expected "
                f"1 <= num_masks <= num_predictions <= {stacked} (views times passes)."
            )
        if self.training and self.drop_path_rate > 0 and generator is None:
            raise ValueError("training with drop_path_rate > 0 requires `generator`, got None.")
        image_hw = rgb.shape[2], rgb.shape[3]
        full_hw = padded_hw(image_hw)
        images = self.inputs(rgb, thermal, multiple=STRIDE)
        hidden = None if masks is None else expand_cells(masks, rgb.shape[0], full_hw, PATCH)
        features = self.backbone(
            images,
            hidden,
            passes=passes,
            views=views,
            num_predictions=predictions,
            generator=generator,
        )

        count = rgb.shape[0] // passes
        pyramid = self.sem_seg_head.get_submodule("pixel_decoder")(features, with_masks * count)
        classes, mask_logits = self.sem_seg_head.get_submodule("predictor")(pyramid)
        logits = None
        if not self.training and stacked == 1:
            logits = semantic_logits(classes[-1], mask_logits[-1], image_hw, full_hw)
        aux = {
            "class_logits": classes.unflatten(1, (predictions, count)),
            "mask_logits": mask_logits.unflatten(1, (with_masks, count)),
        }
        return Output(logits, aux)

    def dense_logits(self, output: Output, image_hw: tuple[int, int]) -> Tensor:
        """Class scores of every pixel in training, for losses that compare dense predictions.

        `output` is of one pass and view. (B, K, H, W) float32: logarithm of the semantic scores, so
        that their softmax is the share of a class in the sum over classes.
        """
        scores = semantic_logits(
            output.aux["class_logits"][-1, 0],
            output.aux["mask_logits"][-1, 0],
            image_hw,
            padded_hw(image_hw),
        )
        return scores.clamp(min=FAINTEST).log()


def semantic_logits(
    class_logits: Tensor, mask_logits: Tensor, image_hw: tuple[int, int], padded: tuple[int, int]
) -> Tensor:
    """Score of every class at every pixel, at the size of the image.

        score(k, pixel) = sum over queries of softmax(class)(k) * sigmoid(mask)(pixel)

    Source: Mask2Former release, semantic inference; the no-object class is dropped.

    (B, Q, K + 1) and (B, Q, h, w), which stands for an image of size `padded` whose top left part
    is `image_hw`, -> (B, K, H, W) float32, >= 0.
    """
    with torch.autocast(class_logits.device.type, enabled=False):
        masks = F.interpolate(
            mask_logits.float(), size=padded, mode="bilinear", align_corners=False
        )
        masks = masks[..., : image_hw[0], : image_hw[1]].sigmoid()
        classes = class_logits.float().softmax(-1)[..., :-1]
        scores = classes.transpose(1, 2) @ masks.flatten(2)
        return scores.view(*scores.shape[:2], *image_hw)
