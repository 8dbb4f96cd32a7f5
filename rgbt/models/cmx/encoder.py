"""The encoder of CMX and CMNeXt: two streams of four stages that meet after every stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.models.cmx.fusion import Fusion, Rectification
from rgbt.models.cmx.mit import MitShape
from rgbt.models.inputs import Images
from rgbt.models.parts import keep_factors

STREAMS = ("", "extra_")
"""Beginnings of the names of the streams' modules: RGB, and the other modality."""

MakeStage = Callable[[int], Mapping[str, nn.Module]]
"""Stage 0..3 -> its modules "patch_embed", "block" and "norm", as `mit.stage_modules`."""


class CmxEncoder(nn.Module):
    """Two streams with weights of their own that meet after every stage.

    The next stage continues with what the rectification returns; the decoder reads what the fusion
    returns.   Source: CMX, Sec. III-A.

    Args:
        shape: sizes of both streams.
        streams: what makes the stages of the RGB stream, and of the other one.
        drop_rates: (2, blocks), probabilities of stochastic depth, RGB's and thermal's; None: none.
    """

    def __init__(
        self,
        shape: MitShape,
        streams: tuple[MakeStage, MakeStage],
        *,
        drop_rates: Tensor | None,
    ) -> None:
        super().__init__()
        self.depths = shape.depths
        self.drop_rates = drop_rates
        # The smallest image whose every map is at least as large as the kernel that shrinks it.
        self.shortest_side = max(
            stride * (ratio - 1) + 1
            for stride, ratio in zip((4, 8, 16, 32), shape.sr_ratios, strict=True)
        )
        for prefix, make_stage in zip(STREAMS, streams, strict=True):
            for stage in range(4):
                for name, module in make_stage(stage).items():
                    self.add_module(f"{prefix}{name}{stage + 1}", module)
        self.FRMs = nn.ModuleList(Rectification(dim) for dim in shape.embed_dims)
        self.FFMs = nn.ModuleList(
            Fusion(dim, heads) for dim, heads in zip(shape.embed_dims, shape.num_heads, strict=True)
        )

    def forward(self, images: Images, generator: torch.Generator | None) -> list[Tensor]:
        """Fused maps of the four stages, (N, h, w, C_s): H and W over 4, 8, 16, 32, rounded up.

        `images` are (N, 3, H, W) and (N, c, H, W), normalised; `generator` draws stochastic depth,
        in training mode with rates alone.

        Raises:
            InputError: images smaller than the deepest reduction of attention takes.
        """
        height, width = images.rgb.shape[2:]
        if min(height, width) < self.shortest_side:
            raise InputError(
                f"these model.sr_ratios require images of at least {self.shortest_side} pixels "
                f"per side, got {height} x {width}; use larger images or crops, or smaller "
                "model.sr_ratios."
            )
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
