"""The network: a plain vision transformer of DINOv2 or DINOv3, and Mask2Former's head."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import torch
from annotated_types import Interval, Len, MultipleOf
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.dinov2.encoder import Encoder, LoraProjection, MlpForm, Part, Resize
from rgbt.models.inputs import Inputs, as_rgb
from rgbt.models.mask2former.head import HeadShape
from rgbt.models.mask2former.network import (
    MODALITIES,
    RECORD,
    Fusion,
    FusionKind,
    HiddenDim,
    Maps,
    MaskNetwork,
    NumQueries,
)
from rgbt.models.parts import ChannelNorm
from rgbt.ranges import Blocks, Channels, Epsilon, MlpRatio, NumClasses, Positive

STRIDES = (4, 8, 16, 32)


def pyramid_level(dim: int, *, token_px: int, stride: int) -> nn.Sequential:
    """Make the layers from a map with one token per `token_px` pixels to a map of one stride.

    Each doubling of the size halves the channels.

    Source: ViTDet (Li et al., ECCV 2022), Sec. 3, "simple feature pyramid"; layers as in detectron2
    (`modeling/backbone/vit.py`, SimpleFeaturePyramid). Its last 1x1 and 3x3 convolutions of each
    level are left out, because Mask2Former's pixel decoder begins with convolutions of its own.
    """
    layers: list[nn.Module] = []
    width, size = dim, token_px
    while size > stride:
        if layers:
            layers += [ChannelNorm(width), nn.GELU()]
        layers.append(nn.ConvTranspose2d(width, width // 2, 2, stride=2))
        width, size = width // 2, size // 2
    if size < stride:
        layers.append(nn.MaxPool2d(stride // size))
    return nn.Sequential(*layers, ChannelNorm(width))


class DinoBackbone(nn.Module):
    """Passes RGB and thermal through one encoder and a pyramid each; the fusion is here too.

    Sources: fusion: CRM, Sec. III-B. Ours: the shared encoder, with a vector that is added to the
    patch tokens of thermal images (0 at first) and low-rank updates for both or for each modality.
    `lora` has the updates of the blocks by "rgb" and "thermal", or by "both".
    """

    def __init__(
        self,
        encoder: Encoder,
        lora: dict[str, nn.ModuleList],
        *,
        token_px: int,
        layers: tuple[int, ...],
        fusion: FusionKind,
        thermal_embedding: bool,
    ) -> None:
        super().__init__()
        self.token_px, self.layers = token_px, layers
        self.encoder = encoder
        (dim,) = encoder.norm.normalized_shape
        self.thermal_embedding = nn.Parameter(torch.zeros(dim)) if thermal_embedding else None
        self.lora = nn.ModuleDict(dict(lora))
        self.pyramids = nn.ModuleDict()
        for modality in MODALITIES:
            self.pyramids[modality] = nn.ModuleList(
                pyramid_level(dim, token_px=token_px, stride=stride) for stride in STRIDES
            )
        # The width of a level: see `pyramid_level`.
        first, second, third, last = (dim * min(stride, token_px) // token_px for stride in STRIDES)
        self.norm_layers = Fusion((first, second, third, last), fusion)

    def maps(self, modality: str, image: Tensor, hidden: Tensor | None, _: object) -> Maps:
        """Return maps of four strides, (N, C_s, H/s, W/s), of (N, c, H, W) and (N, h, w).

        Images are resized so that a patch has `token_px` pixels.
        """
        image, patch = as_rgb(image), self.encoder.patch
        if patch != self.token_px:
            height, width = (side // self.token_px * patch for side in image.shape[-2:])
            image = F.interpolate(image, (height, width), mode="bilinear", antialias=True)
        owner = modality if modality in self.lora else "both"
        tokens = self.encoder(
            image,
            hidden,
            layers=self.layers,
            added=self.thermal_embedding if modality == "thermal" else None,
            lora=self.lora[owner] if len(self.lora) else None,
        )
        levels = list(self.pyramids[modality].children())
        sources = tokens if len(tokens) > 1 else tokens * len(levels)
        return [level(source) for level, source in zip(levels, sources, strict=True)]


class DinoMask2Former(MaskNetwork):
    """Predicts by one vision transformer for both images, fused as in CRM, and Mask2Former's head.

    Sources: encoder: DINOv2 (Oquab et al., TMLR 2024) or DINOv3 (Siméoni et al., 2025); pyramid:
    ViTDet, Sec. 3; fusion: CRM, Sec. III-B; head: Mask2Former, Sec. 3.2. The combination is ours.
    With the weights of a published file, the patch tokens of an RGB image are those of its network.

    The arguments are the keys of ``conf/model/dinov2.yaml`` and ``dinov3.yaml``. With
    `thermal_embedding`, a frozen encoder keeps the activations of thermal images for its gradient.
    """

    record = replace(
        RECORD,
        pretrained_parts=("backbone.encoder.",),
        recomputed=("backbone.encoder.blocks.*", *RECORD.recomputed),
    )

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        patch: Annotated[int, Interval(ge=1, le=64)],
        embed_dim: Annotated[Channels, MultipleOf(4)],
        depth: Blocks,
        num_heads: Channels,
        mlp_ratio: MlpRatio,
        num_registers: Annotated[int, Interval(ge=0, le=1024)],
        position_grid: Annotated[int, Interval(ge=1, le=1024)] | None,
        position_resize: Resize | None,
        token_px: Literal[8, 16],
        layers: Annotated[tuple[Blocks, ...], Len(1, 4)],
        tuning: Literal["frozen", "lora", "full"],
        lora_rank: Channels,
        lora_alpha: Positive,
        lora_parts: Annotated[tuple[Part, ...], Len(1, 3)],
        lora_per_modality: bool,
        thermal_embedding: bool,
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
        rope_base: Annotated[float, Interval(gt=1, le=1e6)] | None = None,
        norm_eps: Epsilon = 1e-6,
        key_bias: bool = True,
        mlp: MlpForm = "gelu",
    ) -> None:
        rising = all(a < b for a, b in zip(layers, layers[1:], strict=False))
        if len(layers) not in (1, len(STRIDES)) or not rising or layers[-1] > depth:
            raise InputError(
                f"model.layers must be one block or four rising ones of {depth}, got {layers}."
            )
        encoder = Encoder(
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
        encoder.requires_grad_(tuning == "full")
        owners: tuple[str, ...] = MODALITIES if lora_per_modality else ("both",)
        lora = {
            owner: nn.ModuleList(
                LoraProjection(embed_dim, rank=lora_rank, alpha=lora_alpha, parts=lora_parts)
                for _ in range(layers[-1])
            )
            for owner in (owners if tuning == "lora" else ())
        }
        backbone = DinoBackbone(
            encoder,
            lora,
            token_px=token_px,
            layers=layers,
            fusion=fusion,
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
        super().__init__(backbone, head, inputs)
