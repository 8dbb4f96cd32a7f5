"""Pixel decoder: deformable attention over strides 32, 16, 8, then one step up to stride 4."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.mask2former.deformable import EncoderLayer, Levels

GROUPS = 32
"""Groups of every group normalisation (Mask2Former release)."""
NUM_LEVELS = 3


class PixelPyramid(NamedTuple):
    """The output of the pixel decoder.

    Mask features are W f + b with the last 1 x 1 convolution (W, b). They are handed on as the
    three factors: e (W f + b) = (e W) f + e b costs less, for fewer embeddings e than pixels.

    Attributes:
        fine: f, (M, C, H/4, W/4) of the first M of B samples, M <= B.
        reduced: f of all samples at strides 32, 16, 8, (B, C, S_l) each, without gradient.
        weight: W, (C, C).
        bias: b, (C,).
        tokens: (B, S_l, C) at strides 32, 16, 8, row-major.
        levels: rows and columns of these three.
    """

    fine: Tensor
    reduced: tuple[Tensor, ...]
    weight: Tensor
    bias: Tensor
    tokens: tuple[Tensor, ...]
    levels: Levels


@lru_cache(maxsize=64)
def sine_code(hw: tuple[int, int], dim: int, device: torch.device) -> Tensor:
    """Position code of every token of a map: first half of the channels y, second half x.

        angle(p, k) = 2 pi p / (P + 1e-6) / 10000^(2 floor(k / 2) / (dim / 2)),  p = 1..P
        code(p, k) = sin(angle) for even k, cos(angle) for odd k

    Source: DETR, supplement A.4; normalised variant as in Mask2Former.

    `hw` are rows and columns, `dim` is a multiple of 4; (rows * columns, dim) float32, row-major,
    kept per size.
    """

    def axis(size: int) -> Tensor:
        position = torch.arange(1, size + 1, dtype=torch.float32) / (size + 1e-6) * (2 * math.pi)
        pair = torch.arange(dim // 2, dtype=torch.float32).div(2, rounding_mode="floor")
        angle = position[:, None] / 10_000 ** (2 * pair / (dim // 2))
        return torch.stack([angle[:, 0::2].sin(), angle[:, 1::2].cos()], dim=-1).flatten(1)

    with torch.inference_mode(False):
        y, x = (axis(size) for size in hw)
        code = torch.cat([y[:, None].expand(-1, hw[1], -1), x[None].expand(hw[0], -1, -1)], -1)
        return code.flatten(0, 1).to(device)


class ConvNorm(nn.Conv2d):
    """Convolution without bias, then group normalisation, under the released names."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int) -> None:
        super().__init__(in_channels, out_channels, kernel, padding=kernel // 2, bias=False)
        nn.init.kaiming_uniform_(self.weight, a=1)
        self.norm = nn.GroupNorm(GROUPS, out_channels)

    def forward(self, input: Tensor) -> Tensor:
        """(B, c, H, W) -> (B, C, H, W)."""
        out: Tensor = self.norm(super().forward(input))
        return out


class LevelEncoder(nn.Module):
    """Encoder layers over the tokens of all levels."""

    def __init__(self, dim: int, *, num_layers: int, heads: int, ffn_dim: int) -> None:
        super().__init__()
        layers = nn.ModuleList(
            EncoderLayer(dim, heads=heads, num_levels=NUM_LEVELS, ffn_dim=ffn_dim)
            for _ in range(num_layers)
        )
        self.encoder = nn.ModuleDict({"layers": layers})
        self.level_embed = nn.Parameter(torch.empty(NUM_LEVELS, dim))
        nn.init.normal_(self.level_embed)

    def forward(self, tokens: Tensor, levels: Levels) -> Tensor:
        """(B, S, C) -> (B, S, C)."""
        codes = (sine_code(hw, tokens.shape[-1], tokens.device) for hw in levels)
        position = torch.cat([c + e for c, e in zip(codes, self.level_embed, strict=True)])
        for layer in self.encoder["layers"].children():
            tokens = layer(tokens, position, levels)
        return tokens


class PixelDecoder(nn.Module):
    """Features of four strides to mask features and three levels of tokens.

    Source: Mask2Former, Sec. 3.2 and 4.1; MSDeformAttn variant of its release.

    `widths` are channels at strides 4, 8, 16, 32; `fp32` runs it in single precision under autocast
    too (released: true).
    """

    def __init__(
        self,
        widths: tuple[int, int, int, int],
        *,
        hidden_dim: int,
        encoder_layers: int,
        heads: int,
        ffn_dim: int,
        fp32: bool,
    ) -> None:
        super().__init__()
        self.fp32 = fp32
        self.input_proj = nn.ModuleList(
            nn.Sequential(nn.Conv2d(width, hidden_dim, 1), nn.GroupNorm(GROUPS, hidden_dim))
            for width in reversed(widths[1:])
        )
        self.transformer = LevelEncoder(
            hidden_dim, num_layers=encoder_layers, heads=heads, ffn_dim=ffn_dim
        )
        self.adapter_1 = ConvNorm(widths[0], hidden_dim, 1)
        self.layer_1 = ConvNorm(hidden_dim, hidden_dim, 3)
        self.mask_features = nn.Conv2d(hidden_dim, hidden_dim, 1)
        nn.init.kaiming_uniform_(self.mask_features.weight, a=1)
        for projection in self.input_proj:
            nn.init.xavier_uniform_(projection.get_submodule("0").get_parameter("weight"))
            nn.init.zeros_(projection.get_submodule("0").get_parameter("bias"))
        nn.init.zeros_(self.mask_features.get_parameter("bias"))

    def forward(self, features: list[Tensor], num_masks: int | None = None) -> PixelPyramid:
        """Features (B, C_s, H/s, W/s), s = 4, 8, 16, 32, to mask features and tokens.

        Args:
            features: of the four strides.
            num_masks: M, how many samples from the first one on have masks. No gradient is computed
                of the mask features of the others. None: all.
        """
        count = features[0].shape[0] if num_masks is None else num_masks
        if not self.fp32:
            return self._decode(features, count)
        with torch.autocast(features[0].device.type, enabled=False):
            return self._decode([each.float() for each in features], count)

    def _decode(self, features: list[Tensor], num_masks: int) -> PixelPyramid:
        fine, *coarse = features
        maps = [project(x) for project, x in zip(self.input_proj, reversed(coarse), strict=True)]
        levels = tuple((x.shape[2], x.shape[3]) for x in maps)
        tokens = torch.cat([x.flatten(2).transpose(1, 2) for x in maps], dim=1)
        tokens = self.transformer(tokens, levels)

        per_level = tokens.split([rows * columns for rows, columns in levels], dim=1)
        stride_8 = per_level[-1].unflatten(1, levels[-1]).permute(0, 3, 1, 2)
        finest = self._finest(fine[:num_masks], stride_8[:num_masks])
        with torch.no_grad():
            reduced = _reduce(finest, levels)
            if num_masks < fine.shape[0]:
                others = self._finest(fine[num_masks:], stride_8[num_masks:])
                pairs = zip(reduced, _reduce(others, levels), strict=True)
                reduced = tuple(torch.cat(pair) for pair in pairs)
        weight, bias = (self.mask_features.get_parameter(name) for name in ("weight", "bias"))
        return PixelPyramid(finest, reduced, weight.flatten(1), bias, per_level, levels)

    def _finest(self, fine: Tensor, stride_8: Tensor) -> Tensor:
        """The backbone's map at stride 4 and the enlarged one of stride 8: (M, C, H/4, W/4)."""
        upsampled = F.interpolate(
            stride_8, size=fine.shape[-2:], mode="bilinear", align_corners=False
        )
        # Contiguous, because group normalisation's gradient is slow where channels come last.
        summed = self.adapter_1(fine.contiguous()) + upsampled
        return F.relu(self.layer_1(summed))


def _reduce(fine: Tensor, levels: Levels) -> tuple[Tensor, ...]:
    """(B, C, H, W) at the sizes of all levels, (B, C, S_l) each."""
    return tuple(shrink(fine, fine.shape[-1] // columns).flatten(2) for _, columns in levels)


def shrink(x: Tensor, factor: int) -> Tensor:
    """Bilinear resize by an even factor: the mean of the four pixels around each new centre.

    Equals `interpolate(mode="bilinear", align_corners=False)`, which is slow on CPU. Sides of x
    (..., H, W) are multiples of `factor`: (..., H / factor, W / factor).
    """
    low, high = factor // 2 - 1, factor // 2
    rows = x[..., low::factor, :] + x[..., high::factor, :]
    return (rows[..., low::factor] + rows[..., high::factor]) / 4
