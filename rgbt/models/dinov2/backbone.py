"""Both modalities through one encoder: pyramids of features, and their fusion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.dinov2.encoder import Encoder, ViTShape
from rgbt.models.dinov2.lora import LoraBlocks, Part
from rgbt.models.mask2former.backbone import Fusion, Maps
from rgbt.types import MaskPair, View

STRIDES = (4, 8, 16, 32)
MODALITIES: tuple[Literal["rgb", "thermal"], ...] = ("rgb", "thermal")
Tuning = Literal["frozen", "lora", "full"]


@dataclass(frozen=True, kw_only=True)
class TuningSettings:
    """What of the encoder is trained; see `rgbt.models.dinov2.model.DinoMask2Former`."""

    tuning: Tuning
    rank: int
    alpha: float
    parts: tuple[Part, ...]
    per_modality: bool
    thermal_embedding: bool


class ChannelNorm(nn.LayerNorm):
    """Layer normalisation over the channels of maps."""

    def forward(self, input: Tensor) -> Tensor:
        """(N, C, h, w) -> (N, C, h, w)."""
        return super().forward(input.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Level(nn.Sequential):
    """A map of one stride from a map with one token per `token_px` pixels.

    Each doubling of the size halves the channels. `width` is their number.
    """

    def __init__(self, dim: int, *, token_px: int, stride: int) -> None:
        layers: list[nn.Module] = []
        width, size = dim, token_px
        while size > stride:
            layers += [ChannelNorm(width), nn.GELU()] if layers else []
            layers.append(nn.ConvTranspose2d(width, width // 2, 2, stride=2))
            width, size = width // 2, size // 2
        if size < stride:
            layers.append(nn.MaxPool2d(stride // size))
        super().__init__(*layers, ChannelNorm(width))
        self.width = width


class Pyramid(nn.ModuleList):
    """Maps at strides 4, 8, 16 and 32 from maps of one size.

    Source: ViTDet (Li et al., ECCV 2022), Sec. 3, "simple feature pyramid"; layers as in detectron2
    (`modeling/backbone/vit.py`, SimpleFeaturePyramid). Its last 1x1 and 3x3 convolutions of each
    level are left out, because Mask2Former's pixel decoder begins with convolutions of its own.

    `widths` are the channels of the four maps.
    """

    def __init__(self, dim: int, token_px: int) -> None:
        levels = [Level(dim, token_px=token_px, stride=stride) for stride in STRIDES]
        super().__init__(levels)
        first, second, third, last = (level.width for level in levels)
        self.widths = first, second, third, last

    def forward(self, maps: Maps) -> Maps:
        """One (N, d, h, w), or one for each level, to four (N, C_s, H/s, W/s)."""
        sources = maps if len(maps) > 1 else maps * len(self)
        return [level(source) for level, source in zip(self, sources, strict=True)]


class DinoBackbone(nn.Module):
    """RGB and thermal through the same encoder, a pyramid each, and their fusion.

    Sources: fusion: CRM, Sec. III-B. Ours: the shared encoder, with a vector that is added to the
    patch tokens of thermal images (0 at first) and low-rank updates for both or for each modality.

    Args:
        shape: of the encoder.
        settings: what of the encoder is trained.
        token_px: image pixels per token and side; images are resized so that a patch covers them.
        layers: numbers of the blocks, rising, whose tokens are used: one, or one for each level.
        fusion: "max" or "add".
    """

    def __init__(
        self,
        shape: ViTShape,
        settings: TuningSettings,
        *,
        token_px: int,
        layers: tuple[int, ...],
        fusion: Literal["max", "add"],
    ) -> None:
        super().__init__()
        self.token_px, self.layers = token_px, layers
        self.encoder = Encoder(shape)
        self.encoder.requires_grad_(settings.tuning == "full")
        self.thermal_embedding = (
            nn.Parameter(torch.zeros(shape.embed_dim)) if settings.thermal_embedding else None
        )
        owners = MODALITIES if settings.per_modality else ("both",)
        self.lora = nn.ModuleDict(
            {
                owner: LoraBlocks(
                    layers[-1],
                    shape.embed_dim,
                    rank=settings.rank,
                    alpha=settings.alpha,
                    parts=settings.parts,
                )
                for owner in (owners if settings.tuning == "lora" else ())
            }
        )
        pyramids: dict[str, Pyramid] = {
            modality: Pyramid(shape.embed_dim, token_px) for modality in MODALITIES
        }
        self.pyramids = nn.ModuleDict(pyramids)
        self.widths = pyramids["rgb"].widths
        self.norm_layers = Fusion(self.widths, fusion=fusion)

    def forward(
        self,
        images: tuple[Tensor, Tensor],
        hidden: MaskPair | None = None,
        *,
        passes: int = 1,
        views: tuple[View, ...] = ("rgbt",),
        num_predictions: int | None = None,
    ) -> Maps:
        """Features of all views as one batch; a modality that no view needs is not computed.

        Args:
            images: (N, 3, H, W) each, normalised, sides multiples of 32.
            hidden: per token, (N, H/t, W/t) bool each, t = token_px; None: nothing is hidden.
            passes: see `rgbt.models.mask2former.backbone.Fusion.forward`, as all below.
            views: likewise.
            num_predictions: likewise.

        Returns:
            as there.
        """
        maps: dict[str, Maps] = {}
        for index, modality in enumerate(MODALITIES):
            if views == (MODALITIES[1 - index],):
                continue
            mask = None if hidden is None else hidden[index]
            maps[modality] = self._maps(modality, images[index], mask)
        fused: Maps = self.norm_layers(
            maps, passes=passes, views=views, num_predictions=num_predictions
        )
        return fused

    def _maps(self, modality: str, image: Tensor, hidden: Tensor | None) -> Maps:
        """The pyramid of one modality."""
        owner = modality if modality in self.lora else "both"
        tokens = self.encoder(
            self._resized(image),
            hidden,
            layers=self.layers,
            added=self.thermal_embedding if modality == "thermal" else None,
            lora=self.lora[owner] if len(self.lora) else None,
        )
        maps: Maps = self.pyramids[modality](tokens)
        return maps

    def _resized(self, image: Tensor) -> Tensor:
        """The image at the size at which a patch covers `token_px` pixels of it."""
        patch = self.encoder.shape.patch
        if patch == self.token_px:
            return image
        height, width = (side // self.token_px * patch for side in image.shape[-2:])
        return F.interpolate(image, (height, width), mode="bilinear", antialias=True)
