"""Pixel decoder: deformable attention over strides 32, 16, 8, then one step up to stride 4.

Shape letters beside those of `rgbt.types`: `S` tokens of all levels together, `S_l` of one level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

GROUPS = 32
"""Groups of every group normalisation (Mask2Former release)."""
NUM_LEVELS = 3
POINTS = 4
"""Sampling points per head and level (Deformable DETR, Sec. 4.1; Mask2Former release)."""

Levels = tuple[tuple[int, int], ...]
"""Rows and columns of every level."""


@dataclass(frozen=True, kw_only=True)
class HeadShape:
    """Sizes of both decoders; see `rgbt.models.mask2former.model.Mask2Former`."""

    num_classes: int
    hidden_dim: int
    num_queries: int
    encoder_layers: int
    encoder_ffn_dim: int
    decoder_layers: int
    decoder_ffn_dim: int
    attention_heads: int
    pixel_decoder_fp32: bool


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
def centre_grid(levels: Levels, device: torch.device) -> tuple[Tensor, Tensor]:
    """Centre of every token of all levels, and length of a pixel, as `grid_sample` counts.

        (x, y) = 2 (column + 1/2) / columns - 1,  2 (row + 1/2) / rows - 1;  2 / columns, 2 / rows

    Source: Deformable DETR, Sec. 4.1 (reference points).

    (2, S) and (levels, 1, 2, 1) float32, x first; kept per size.
    """
    with torch.inference_mode(False):
        centres = []
        for hw in levels:
            y, x = ((2 * torch.arange(side, dtype=torch.float32) + 1) / side - 1 for side in hw)
            centres.append(torch.stack([x.repeat(hw[0]), y.repeat_interleave(hw[1])]))
        lengths = torch.tensor([[2 / columns, 2 / rows] for rows, columns in levels])
        return torch.cat(centres, dim=1).to(device), lengths.view(-1, 1, 2, 1).to(device)


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


class DeformableAttention(nn.Module):
    """Every token averages a few bilinear samples of each level, at predicted positions.

        out_q = W_o sum_j a_qj  value(reference_q + offset_qj),   sum_j a_qj = 1 per head

    At first, head m of M looks at 1..4 pixels in direction 2 pi m / M, all samples of equal weight.

    Source: Deformable DETR, Eq. (3).
    """

    def __init__(self, dim: int, *, heads: int, num_levels: int) -> None:
        super().__init__()
        self.heads, self.num_levels = heads, num_levels
        samples = heads * num_levels * POINTS
        self.sampling_offsets = nn.Linear(dim, 2 * samples)
        self.attention_weights = nn.Linear(dim, samples)
        self.value_proj = nn.Linear(dim, dim)
        self.output_proj = nn.Linear(dim, dim)
        angle = torch.arange(heads) * (2 * math.pi / heads)
        direction = torch.stack([angle.cos(), angle.sin()], dim=-1)
        direction = direction / direction.abs().amax(-1, keepdim=True)
        steps = direction[:, None, None] * torch.arange(1, POINTS + 1).view(1, 1, POINTS, 1)
        with torch.no_grad():
            self.sampling_offsets.bias.copy_(steps.expand(-1, num_levels, -1, -1).flatten())
        for layer in (self.sampling_offsets, self.attention_weights):
            nn.init.zeros_(layer.weight)
        for layer in (self.value_proj, self.output_proj):
            nn.init.xavier_uniform_(layer.weight)
        for layer in (self.attention_weights, self.value_proj, self.output_proj):
            nn.init.zeros_(layer.bias)

    def forward(self, query: Tensor, tokens: Tensor, levels: Levels) -> Tensor:
        """Attention of all tokens to all levels: (B, S, C) -> (B, S, C).

        `query` are the tokens with their position code.
        """
        batch, length, dim = tokens.shape
        # Everything is computed with tokens last, as grid_sample wants it: no transposed copies.
        tokens, query = tokens.transpose(1, 2), query.transpose(1, 2)
        value = _project(self.value_proj, tokens).view(batch * self.heads, -1, length)
        weights = _project(self.attention_weights, query)
        weights = weights.view(batch * self.heads, -1, length).softmax(1)
        # Sampling positions: (B heads, levels, points, 2, S), (x, y).
        offset = _project(self.sampling_offsets, query)
        offset = offset.view(batch * self.heads, self.num_levels, POINTS, 2, length)
        centre, scale = centre_grid(levels, query.device)
        grids = torch.addcmul(centre, offset, scale).unbind(1)

        parts = []
        values = torch.split(value, [rows * columns for rows, columns in levels], -1)
        shares = torch.split(weights, POINTS, 1)
        for value_l, weight_l, grid, hw in zip(values, shares, grids, levels, strict=True):
            maps = value_l.view(*value_l.shape[:2], *hw)
            sampled = F.grid_sample(maps, grid.transpose(2, 3), align_corners=False)
            parts.append((sampled * weight_l[:, None]).sum(2))
        total = reduce(torch.add, parts).view(batch, dim, length)
        return _project(self.output_proj, total).transpose(1, 2)


def _project(layer: nn.Linear, x: Tensor) -> Tensor:
    """(B, C, S) -> (B, C', S): the layer on channels that come before the tokens."""
    batch, _, length = x.shape
    bias = layer.bias[:, None].expand(batch, -1, length)
    return torch.baddbmm(bias, layer.weight.expand(batch, -1, -1), x)


class EncoderLayer(nn.Module):
    """Deformable self-attention and feed-forward network, each added and then normalised."""

    def __init__(self, shape: HeadShape) -> None:
        super().__init__()
        dim, heads = shape.hidden_dim, shape.attention_heads
        self.self_attn = DeformableAttention(dim, heads=heads, num_levels=NUM_LEVELS)
        self.norm1 = nn.LayerNorm(dim)
        self.linear1 = nn.Linear(dim, shape.encoder_ffn_dim)
        self.linear2 = nn.Linear(shape.encoder_ffn_dim, dim)
        self.norm2 = nn.LayerNorm(dim)
        for layer in (self.linear1, self.linear2):
            nn.init.xavier_uniform_(layer.weight)

    def forward(self, tokens: Tensor, position: Tensor, levels: Levels) -> Tensor:
        """(B, S, C) -> (B, S, C); `position` (S, C) is added to the queries only."""
        tokens = self.norm1(tokens + self.self_attn(tokens + position, tokens, levels))
        out: Tensor = self.norm2(tokens + self.linear2(F.relu(self.linear1(tokens))))
        return out


class LevelEncoder(nn.Module):
    """Encoder layers over the tokens of all levels."""

    def __init__(self, shape: HeadShape) -> None:
        super().__init__()
        layers = nn.ModuleList(EncoderLayer(shape) for _ in range(shape.encoder_layers))
        self.encoder = nn.ModuleDict({"layers": layers})
        self.level_embed = nn.Parameter(torch.empty(NUM_LEVELS, shape.hidden_dim))
        nn.init.normal_(self.level_embed)

    def forward(self, tokens: Tensor, levels: Levels) -> Tensor:
        """(B, S, C) -> (B, S, C)."""
        codes = (sine_code(hw, tokens.shape[-1], tokens.device) for hw in levels)
        position = torch.cat([c + e for c, e in zip(codes, self.level_embed, strict=True)])
        for layer in self.encoder["layers"].children():
            tokens = layer(tokens, position, levels)
        return tokens


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


class PixelDecoder(nn.Module):
    """Features of four strides to mask features and three levels of tokens.

    Source: Mask2Former, Sec. 3.2 and 4.1; MSDeformAttn variant of its release.

    `widths` are channels at strides 4, 8, 16, 32.
    """

    def __init__(self, widths: tuple[int, int, int, int], shape: HeadShape) -> None:
        super().__init__()
        dim = shape.hidden_dim
        self.fp32 = shape.pixel_decoder_fp32
        projections = [nn.Conv2d(width, dim, 1) for width in reversed(widths[1:])]
        self.input_proj = nn.ModuleList(
            nn.Sequential(projection, nn.GroupNorm(GROUPS, dim)) for projection in projections
        )
        self.transformer = LevelEncoder(shape)
        self.adapter_1 = ConvNorm(widths[0], dim, 1)
        self.layer_1 = ConvNorm(dim, dim, 3)
        self.mask_features = nn.Conv2d(dim, dim, 1)
        nn.init.kaiming_uniform_(self.mask_features.weight, a=1)
        for projection in projections:
            nn.init.xavier_uniform_(projection.weight)
        for convolution in (*projections, self.mask_features):
            nn.init.zeros_(convolution.get_parameter("bias"))

    def forward(self, features: list[Tensor], num_masks: int | None = None) -> PixelPyramid:
        """Features (B, C_s, H/s, W/s), s = 4, 8, 16, 32, to mask features and tokens.

        Only the first `num_masks` samples have masks (None: all). No gradient is computed of the
        mask features of the others.
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
        weight, bias = self.mask_features.weight, self.mask_features.get_parameter("bias")
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
