"""The network: a plain vision transformer of DINOv2 or DINOv3, and Mask2Former's head."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from annotated_types import Interval, Len
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.geometry.padding import STRIDE, padded_hw
from rgbt.models.dinov2.backbone import STRIDES, DinoBackbone, Tuning, TuningSettings
from rgbt.models.dinov2.encoder import MlpForm, PositionResize, ViTShape
from rgbt.models.dinov2.lora import Part
from rgbt.models.inputs import Inputs, expand_cells
from rgbt.models.mask2former.head import HeadShape, MaskHead, dense_logits, requested
from rgbt.ranges import Blocks, Channels, Epsilon, MlpRatio, NumClasses, Positive
from rgbt.requirements import Record
from rgbt.types import VIEWS, MaskPair, Output, View


class DinoMask2Former(nn.Module):
    """RGB and thermal through one vision transformer, fused as in CRM, with Mask2Former's head.

    Sources: encoder: DINOv2 (Oquab et al., TMLR 2024) or DINOv3 (Siméoni et al., 2025); pyramid:
    ViTDet, Sec. 3; fusion: CRM, Sec. III-B; head: Mask2Former, Sec. 3.2. The combination is ours.
    With the weights of a published file, the patch tokens of an RGB image are those of its network.

    The settings with a default are those of DINOv3. Configurations of DINOv2 are older and do not
    name them, so that the keys of their runs are unchanged.

    Args:
        num_classes: K, without the no-object class.
        patch: side of a patch in the resized image, pixels.
        embed_dim: d, width of the encoder, a multiple of 4.
        depth: its blocks.
        num_heads: its attention heads.
        mlp_ratio: width of a block's MLP divided by the width of the block.
        num_registers: its register tokens; 4 in the files with registers, else 0.
        position_grid: side of the grid of its position embedding, 37 in the files of DINOv2; None:
            positions are rotary.
        position_resize: how positions are resized: "factor" without and "size" with registers
            (`rgbt.models.dinov2.encoder.resized_positions`); None: positions are rotary.
        token_px: pixels of the image per token and side. Images, padded to multiples of 32, are
            resized by patch / token_px, so that the tokens fit the strides 4 to 32 of the head.
        layers: numbers of the blocks whose tokens are used, rising: one for all levels, or four.
        tuning: "full": the encoder is trained; "frozen": it is not; "lora": low-rank updates of its
            attention are.
        lora_rank: rank of an update; this and the other settings of LoRA are read for "lora" only.
        lora_alpha: factor of an update, divided by the rank.
        lora_parts: updated projections, of "q", "k" and "v".
        lora_per_modality: whether RGB and thermal have updates of their own.
        thermal_embedding: whether a learned vector is added to the patch tokens of thermal images.
            A frozen encoder then keeps the activations of thermal images for its gradient.
        fusion: "max" or "add" of the two modalities.
        hidden_dim: channels of both decoders, a multiple of 32.
        num_queries: Q.
        encoder_layers: deformable layers of the pixel decoder.
        encoder_ffn_dim: width of their feed-forward networks.
        decoder_layers: layers of the query decoder, without the initial prediction.
        decoder_ffn_dim: width of theirs.
        attention_heads: heads of both decoders.
        pixel_decoder_fp32: keep the pixel decoder in single precision under autocast.
        inputs: normalisation of the images, with three thermal channels.
        rope_base: base of the periods of rotary positions
            (`rgbt.models.dinov2.rotary.RotaryPositions`), 100 in DINOv3; None: positions are
            learned.
        norm_eps: epsilon of the layer normalisations of the encoder; 1e-6 in DINOv2, 1e-5 in
            DINOv3.
        key_bias: whether keys have a bias; not in DINOv3.
        mlp: MLP of a block, "gelu" or the gated "swiglu".

    Raises:
        InputError: settings that do not fit each other.
    """

    record = Record(
        outputs="masks",
        views=VIEWS,
        stacks_passes=True,
        dense_logits=True,
        pretrained_parts=("backbone.encoder.",),
        recomputed=(
            "backbone.encoder.blocks.*",
            "sem_seg_head.pixel_decoder.transformer.encoder.layers.*",
            "sem_seg_head.predictor.transformer_*_layers.*",
        ),
    )

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        patch: Annotated[int, Interval(ge=1, le=64)],
        embed_dim: Channels,
        depth: Blocks,
        num_heads: Channels,
        mlp_ratio: MlpRatio,
        num_registers: Annotated[int, Interval(ge=0, le=1024)],
        position_grid: Annotated[int, Interval(ge=1, le=1024)] | None,
        position_resize: PositionResize | None,
        token_px: Literal[8, 16],
        layers: Annotated[tuple[Blocks, ...], Len(1, 4)],
        tuning: Tuning,
        lora_rank: Channels,
        lora_alpha: Positive,
        lora_parts: Annotated[tuple[Part, ...], Len(1, 3)],
        lora_per_modality: bool,
        thermal_embedding: bool,
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
        rope_base: Annotated[float, Interval(gt=1, le=1e6)] | None = None,
        norm_eps: Epsilon = 1e-6,
        key_bias: bool = True,
        mlp: MlpForm = "gelu",
    ) -> None:
        super().__init__()
        shape = ViTShape(
            patch=patch,
            embed_dim=embed_dim,
            depth=depth,
            num_heads=num_heads,
            mlp_ratio=mlp_ratio,
            num_registers=num_registers,
            position_grid=position_grid,
            position_resize=position_resize,
            rope_base=rope_base,
            norm_eps=norm_eps,
            key_bias=key_bias,
            mlp=mlp,
        )
        settings = TuningSettings(
            tuning=tuning,
            rank=lora_rank,
            alpha=lora_alpha,
            parts=lora_parts,
            per_modality=lora_per_modality,
            thermal_embedding=thermal_embedding,
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
        _check(shape, layers, lora_parts, inputs)
        self.num_classes = num_classes
        self.token_px = token_px
        self.backbone = DinoBackbone(
            shape, settings, token_px=token_px, layers=layers, fusion=fusion
        )
        self.sem_seg_head = MaskHead(head, self.backbone.widths)
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
        generator: torch.Generator | None = None,  # noqa: ARG002 - nothing is dropped at random
    ) -> Output:
        """Predictions of every view and pass, as one batch through the head.

        Arguments, results and errors as `rgbt.models.mask2former.model.Mask2Former.forward` states
        them. A cell of `masks` is a square of a multiple of `token_px` pixels: its pixels are 0,
        and the mask token of the encoder takes the place of its tokens. Nothing is drawn from
        `generator`.
        """
        wanted = requested(rgb.shape[0], passes, views, num_predictions, num_masks)
        image_hw = rgb.shape[2], rgb.shape[3]
        images = self.inputs(rgb, thermal, masks, multiple=STRIDE)
        hidden = None
        if masks is not None:
            hidden = expand_cells(masks, rgb.shape[0], padded_hw(image_hw), self.token_px)
        features = self.backbone(
            images,
            hidden,
            passes=passes,
            views=wanted.views,
            num_predictions=wanted.predictions,
        )
        output: Output = self.sem_seg_head(features, wanted, image_hw)
        return output

    def dense_logits(self, output: Output, image_hw: tuple[int, int]) -> Tensor:
        """As `rgbt.models.mask2former.head.dense_logits`."""
        return dense_logits(output, image_hw)


def _check(
    shape: ViTShape, layers: tuple[int, ...], lora_parts: tuple[Part, ...], inputs: Inputs
) -> None:
    """Refuse settings that do not fit each other."""
    if shape.embed_dim % 4:
        raise InputError(f"model.embed_dim must be a multiple of 4, got {shape.embed_dim}.")
    rising = all(a < b for a, b in zip(layers, layers[1:], strict=False))
    if len(layers) not in (1, len(STRIDES)) or not rising or layers[-1] > shape.depth:
        raise InputError(
            f"model.layers must be one number of a block, or four rising ones, from 1 to "
            f"model.depth = {shape.depth}, got {list(layers)}."
        )
    if len(set(lora_parts)) < len(lora_parts):
        raise InputError(f"model.lora_parts must name each part once, got {list(lora_parts)}.")
    if inputs.thermal_channels != 3:
        raise InputError(
            "model.inputs: the encoder takes thermal images of three channels, got "
            f"{inputs.thermal_channels}; choose model/inputs=cmx."
        )
