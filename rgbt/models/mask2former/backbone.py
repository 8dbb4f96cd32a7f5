"""The two Swin branches, and the fusion of two modalities: one set of features per view."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from rgbt.models.mask2former.swin import Stage, Swin, SwinShape
from rgbt.types import MaskPair, View

LEVELS = ("res2", "res3", "res4", "res5")

Maps = list[Tensor]
"""(N, C_s, H/s, W/s) of one modality, s = 4, 8, 16, 32."""


class Fusion(nn.ModuleDict):
    """The normalised maximum (or sum) of the maps of both modalities, level by level.

    Source: CRM, Sec. III-B.   Released: batch normalisation of the fused maps only; the maps of
    a single modality leave as their branch normalised them.

    `widths` are the channels of the four levels, `fusion` is "max" or "add".
    """

    def __init__(self, widths: tuple[int, int, int, int], *, fusion: Literal["max", "add"]) -> None:
        super().__init__(
            {level: nn.BatchNorm2d(width) for level, width in zip(LEVELS, widths, strict=True)}
        )
        self.fuse = torch.maximum if fusion == "max" else torch.add

    def forward(
        self,
        maps: dict[str, Maps],
        *,
        passes: int = 1,
        views: tuple[View, ...] = ("rgbt",),
        num_predictions: int | None = None,
    ) -> Maps:
        """Features of all views as one batch.

        Args:
            maps: "rgb" and "thermal" -> maps; one that no view needs may be missing.
            passes: N holds this many stacked copies of a batch; batch normalisation takes them one
                after the other, so that each is normalised on its own.
            views: which sets of features, in this order within each pass.
            num_predictions: P, how many of the len(views) * passes sets are returned, from the
                first one on; None: all.

        Returns:
            four (P N / passes, C_s, H/s, W/s), s = 4, 8, 16, 32: pass by pass, then view by view.
        """
        levels = (self._split(level, maps, passes, views) for level in range(len(LEVELS)))
        wanted = [parts[:num_predictions] for parts in levels]
        return [torch.cat(parts) if len(parts) > 1 else parts[0] for parts in wanted]

    def _split(
        self, level: int, maps: dict[str, Maps], passes: int, views: tuple[View, ...]
    ) -> list[Tensor]:
        """The maps of one level: of every view of the first pass, then of the next."""
        by_view: list[tuple[Tensor, ...]] = []
        for view in views:
            if view != "rgbt":
                by_view.append(_parts(maps[view][level], passes))
                continue
            fused, norm = self.fuse(maps["rgb"][level], maps["thermal"][level]), LEVELS[level]
            # Without batch statistics all passes are one call.
            parts = _parts(fused, passes) if self.training else (fused,)
            normed = [self[norm](part) for part in parts]
            by_view.append(tuple(normed) if self.training else _parts(normed[0], passes))
        return [part for one_pass in zip(*by_view, strict=True) for part in one_pass]


class RgbtBackbone(nn.Module):
    """RGB branch, thermal branch, and the normalised maximum (or sum) of their maps.

    Source: CRM, Sec. III-B.

    Stages from `share_start` on (0..4) are the RGB branch's own in both branches; embedding and
    output normalisations never are. 4 shares none. `mask_token`: see `Mask2Former`.
    """

    def __init__(
        self,
        shape: SwinShape,
        *,
        share_start: int,
        fusion: Literal["max", "add"],
        mask_token: Literal["branch", "shared"],
        thermal_channels: int,
    ) -> None:
        super().__init__()
        self.RGB_branch = Swin(3, shape=shape, shared={})
        stages = {i: s for i, s in enumerate(self.RGB_branch.layers) if isinstance(s, Stage)}
        shared = {index: stage for index, stage in stages.items() if index >= share_start}
        self.THR_branch = Swin(thermal_channels, shape=shape, shared=shared)
        if mask_token == "shared":
            self.THR_branch.mask_token = self.RGB_branch.mask_token
        self.norm_layers = Fusion(shape.widths, fusion=fusion)

    def forward(
        self,
        images: tuple[Tensor, Tensor],
        hidden: MaskPair | None = None,
        *,
        passes: int = 1,
        views: tuple[View, ...] = ("rgbt",),
        num_predictions: int | None = None,
        generator: torch.Generator | None = None,
    ) -> Maps:
        """Features of all views as one batch; a branch that no view needs is not run.

        Args:
            images: (N, 3, H, W) and (N, c, H, W) normalised, sides multiples of 32.
            hidden: per token, (N, H/4, W/4) bool each; None: nothing is hidden.
            passes: see `Fusion.forward`.
            views: likewise.
            num_predictions: likewise.
            generator: draws stochastic depth, first the RGB branch's, then the thermal one's.

        Returns:
            as `Fusion.forward`.
        """
        maps: dict[str, Maps] = {}
        if views != ("thermal",):
            mask = None if hidden is None else hidden.rgb
            maps["rgb"] = self.RGB_branch(images[0], mask, generator)
        if views != ("rgb",):
            mask = None if hidden is None else hidden.thermal
            maps["thermal"] = self.THR_branch(images[1], mask, generator)
        fused: Maps = self.norm_layers(
            maps, passes=passes, views=views, num_predictions=num_predictions
        )
        return fused


def _parts(stacked: Tensor, passes: int) -> tuple[Tensor, ...]:
    """The passes of a stacked batch; one alone is not split, so that its size may be a symbol."""
    return (stacked,) if passes == 1 else stacked.chunk(passes)
