"""The network CMX: two streams, the modules between them, and the decoder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.cmx.decoder import MlpDecoder
from rgbt.models.cmx.fusion import Fusion, Rectification
from rgbt.models.cmx.mit import MitShape, Stage2, drop_rates, initialise, stage_modules
from rgbt.models.inputs import Images, Inputs, only_view
from rgbt.models.parts import check_heads, keep_factors
from rgbt.ranges import Channels, Depths, Epsilon, MlpRatio, NumClasses, ShareBelowOne, Widths
from rgbt.requirements import Record
from rgbt.types import MaskPair, Output, View

STREAMS = ("", "extra_")
"""Beginnings of the released names: RGB, and the other modality."""


class CmxEncoder(nn.Module):
    """Two Mix Transformers with weights of their own that meet after every stage.

    The next stage continues with what the rectification returns; the decoder reads what the fusion
    returns.   Source: CMX, Sec. III-A.

    `drop_rates` (2, blocks): probabilities of stochastic depth, RGB's and thermal's; None: none.
    """

    def __init__(
        self, shape: MitShape, *, thermal_channels: int, drop_rates: Tensor | None
    ) -> None:
        super().__init__()
        self.depths = shape.depths
        self.drop_rates = drop_rates
        for prefix, channels in zip(STREAMS, (3, thermal_channels), strict=True):
            for stage in range(4):
                for name, module in stage_modules(shape, stage, channels).items():
                    self.add_module(f"{prefix}{name}{stage + 1}", module)
        self.FRMs = nn.ModuleList(Rectification(dim) for dim in shape.embed_dims)
        self.FFMs = nn.ModuleList(
            Fusion(dim, heads) for dim, heads in zip(shape.embed_dims, shape.num_heads, strict=True)
        )
        self.apply(initialise)

    def forward(self, images: Images, generator: torch.Generator | None) -> list[Tensor]:
        """Fused maps of the four stages, (N, h, w, C_s): H and W over 4, 8, 16, 32, rounded up.

        `images` are (N, 3, H, W) and (N, c, H, W), normalised; `generator` draws stochastic depth,
        in training mode with rates alone.
        """
        rgb, thermal = (image.permute(0, 2, 3, 1).contiguous() for image in images)
        # Factors of every residual by stream and stage, (blocks, 2, N, 1, 1, 1) each.
        keep_rgb: Sequence[Tensor | None] = [None] * 4
        keep_thermal = keep_rgb
        if self.training and self.drop_rates is not None:
            shape = (2, len(rgb), 1, 1, 1)
            drawn = keep_factors(self.drop_rates.flatten(), shape, generator, rgb.device, dim=1)
            keep_rgb, keep_thermal = (torch.split(x, list(self.depths)) for x in drawn.chunk(2))
        fused = []
        for stage, (rectify, fuse) in enumerate(zip(self.FRMs, self.FFMs, strict=True)):
            rgb = self._stage(STREAMS[0], stage, rgb, keep_rgb[stage])
            thermal = self._stage(STREAMS[1], stage, thermal, keep_thermal[stage])
            rgb, thermal = rectify(rgb, thermal)
            fused.append(fuse(rgb, thermal))
        return fused

    def _stage(self, prefix: str, stage: int, x: Tensor, keep: Tensor | None) -> Tensor:
        """One stage of one stream; `keep` is (blocks, 2, N, 1, 1, 1)."""
        embed, blocks, norm = (
            self.get_submodule(f"{prefix}{name}{stage + 1}")
            for name in ("patch_embed", "block", "norm")
        )
        x = embed(x)
        for number, block in enumerate(blocks.children()):
            x = block(x, None if keep is None else keep[number])
        normed: Tensor = norm(x)
        return normed


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
        if min(int(dim * mlp_ratio) for dim in embed_dims) < 1:
            raise InputError(
                f"model.mlp_ratio={mlp_ratio:g} gives 0 channels with "
                f"model.embed_dims={list(embed_dims)}; choose a larger ratio, such as 4."
            )
        check_heads(embed_dims, num_heads)
        self.num_classes = num_classes
        # The smallest image whose every map is at least as large as the kernel that shrinks it.
        self.shortest_side = max(
            stride * (ratio - 1) + 1
            for stride, ratio in zip((4, 8, 16, 32), sr_ratios, strict=True)
        )
        rates = drop_rates(depths, drop_path_rate, drop_path_stage2)
        self.backbone = CmxEncoder(
            shape,
            thermal_channels=inputs.thermal_channels,
            drop_rates=rates if drop_path_rate > 0 else None,
        )
        self.decode_head = MlpDecoder(
            embed_dims,
            num_classes,
            dim=decoder_dim,
            dropout=decoder_dropout,
            norm_eps=decoder_norm_eps,
            norm_eps_eval=decoder_norm_eps_eval or decoder_norm_eps,
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
        image_hw = rgb.shape[2], rgb.shape[3]
        if min(image_hw) < self.shortest_side:
            raise InputError(
                f"CMX with these model.sr_ratios requires images of at least {self.shortest_side} "
                f"pixels per side, got {image_hw[0]} x {image_hw[1]}; use larger images or crops, "
                "or smaller model.sr_ratios."
            )
        fused = self.backbone(images, generator)
        quarter = self.decode_head(fused, generator)
        logits = F.interpolate(quarter.float(), size=image_hw, mode="bilinear", align_corners=False)
        return Output(logits, {})
