"""The head of Mask2Former: pixel decoder, and the decoder in which queries read their own masks.

The pixel decoder has deformable attention over strides 32, 16, 8, then one step up to stride 4.

Shape letters beside those of `rgbt.types`: `S` tokens of all levels together, `S_l` of one level.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from rgbt.fusion import fused
from rgbt.models.parts import add_and_normalise, parameters_of

GROUPS = 32  # groups of every normalisation (Mask2Former release)
NUM_LEVELS = 3
POINTS = 4  # sampled per head and level (Deformable DETR, Sec. 4.1; Mask2Former release)

# What is read of a block of maps in `SampleSum` stays in the cache of a core.
BLOCK_BYTES = 2 * 2**20

# Rows and columns of every level.
Levels = tuple[tuple[int, int], ...]


@dataclass(frozen=True, kw_only=True)
class HeadShape:
    """Holds the sizes of both decoders, keys of ``conf/model/mask2former.yaml``."""

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
    """Holds the output of the pixel decoder.

    Mask features are W f + b with the last 1 x 1 convolution (W, b). They are handed on as the
    three factors: e (W f + b) = (e W) f + e b costs less, for fewer embeddings e than pixels.
    """

    fine: Tensor  # f, (M, C, H/4, W/4) of the first M of B samples
    reduced: tuple[Tensor, ...]  # f of all at strides 32, 16, 8, (B, C, S_l), without gradient
    weight: Tensor  # W, (C, C)
    bias: Tensor  # b, (C,)
    tokens: tuple[Tensor, ...]  # (B, S_l, C) at strides 32, 16, 8, row-major
    levels: Levels  # levels of the three maps


@lru_cache(maxsize=64)
def centre_grid(levels: Levels, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the centre of every token of all levels and the length of a pixel for `grid_sample`.

        (x, y) = 2 (column + 1/2) / columns - 1,  2 (row + 1/2) / rows - 1;  2 / columns, 2 / rows

    (2, S) and (levels, 1, 2, 1) float32, x first; kept per size.   Source: Deformable DETR,
    Sec. 4.1 (reference points).
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
    """Return the position code of every token of a map: half of the channels y, then x.

        angle(p, k) = 2 pi p / (P + 1e-6) / 10000^(2 floor(k / 2) / (dim / 2)),  p = 1..P
        code(p, k) = sin(angle) for even k, cos(angle) for odd k

    `dim` is a multiple of 4; (rows * columns, dim) float32, row-major, kept per size.
    Source: DETR, supplement A.4; normalised variant as in Mask2Former.
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
    """Averages for every token a few bilinear samples of each level, at predicted positions.

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
        """(B, S, C) -> (B, S, C); `query` are the tokens with their position code."""
        batch, length, dim = tokens.shape
        # Tokens are last, as grid_sample wants them: no transposed copies.
        tokens, query = tokens.transpose(1, 2), query.transpose(1, 2)
        value = _project(self.value_proj, tokens).view(batch * self.heads, -1, length)
        weights = _project(self.attention_weights, query)
        weights = weights.view(batch * self.heads, -1, length).softmax(1)
        # Sampling positions: (B heads, levels, points, 2, S), (x, y).
        offset = _project(self.sampling_offsets, query)
        offset = offset.view(batch * self.heads, self.num_levels, POINTS, 2, length)
        centre, scale = centre_grid(levels, query.device)
        grid = torch.addcmul(centre, offset, scale)
        read = SampleSum.apply if torch.is_grad_enabled() else sample_sum
        dtype = torch.promote_types(value.dtype, grid.dtype)  # under autocast float32
        total = read(value.to(dtype), grid.to(dtype), weights.to(dtype), levels)
        return _project(self.output_proj, total.view(batch, dim, length)).transpose(1, 2)


def sample_sum(value: Tensor, grid: Tensor, weights: Tensor, levels: Levels) -> Tensor:
    """Read maps at points, and return the weighted sum of what was read for every token.

    (R, C, S) values of all levels, (R, levels, points, 2, S) positions, (R, levels * points, S)
    weights -> (R, C, S); all of one dtype.
    """
    total: Tensor | None = None
    shares = torch.split(weights, POINTS, 1)
    every = zip(_maps_of(value, levels), shares, grid.unbind(1), strict=True)
    for maps, weight, points in every:
        sampled = F.grid_sample(maps, points.transpose(2, 3), align_corners=False)
        part = weighted_sum(sampled, weight)
        total = part if total is None else total + part
    assert total is not None, "there are levels"
    return total


def _maps_of(value: Tensor, levels: Levels) -> list[Tensor]:
    """View the tokens (R, C, S) as the maps of the levels, (R, C, rows, columns)."""
    parts = torch.split(value, [rows * columns for rows, columns in levels], -1)
    return [part.view(*part.shape[:2], *hw) for part, hw in zip(parts, levels, strict=True)]


@fused
def weighted_sum(sampled: Tensor, weight: Tensor) -> Tensor:
    """(R, C, points, S) and (R, points, S) -> (R, C, S)."""
    return (sampled * weight[:, None]).sum(2)


@fused
def weighted_sum_gradients(
    sampled: Tensor, weight: Tensor, gradient: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the gradients of what was read and of the weights, for that of `weighted_sum`."""
    spread = gradient[:, :, None]
    return spread * weight[:, None], (sampled * spread).sum(1)


class SampleSum(torch.autograd.Function):
    """Computes `sample_sum` and its gradients by blocks of maps that fit the processor's cache.

    It keeps its arguments alone. What is read at the points is four times as large as a map, and is
    read again in the backward pass: that takes no longer than fetching it from memory.
    """

    @staticmethod
    def forward(ctx: Any, value: Tensor, grid: Tensor, weights: Tensor, levels: Levels) -> Tensor:
        """See `sample_sum`."""
        ctx.save_for_backward(value, grid, weights)
        ctx.levels = levels
        total = torch.empty_like(value)
        for rows in _blocks(value):
            total[rows] = sample_sum(value[rows], grid[rows], weights[rows], levels)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        """Return the gradients of values, positions and weights."""
        value, grid, weights = ctx.saved_tensors
        found = torch.empty_like(value), torch.empty_like(grid), torch.empty_like(weights)
        for rows in _blocks(value):
            of_value, of_grid, of_weights = (x[rows] for x in found)
            places = _maps_of(of_value, ctx.levels)
            every = zip(_maps_of(value[rows], ctx.levels), places, strict=True)
            for level, (maps, place) in enumerate(every):
                part = slice(level * POINTS, (level + 1) * POINTS)
                points = grid[rows, level].transpose(2, 3)
                sampled = F.grid_sample(maps, points, align_corners=False)
                weight, by_level = weights[rows, part], gradient[rows]
                of_sampled, of_weights[:, part] = weighted_sum_gradients(sampled, weight, by_level)
                of_maps, of_points = torch.ops.aten.grid_sampler_2d_backward(
                    of_sampled, maps, points, 0, 0, False, (True, True)
                )
                place.copy_(of_maps)
                of_grid[:, level] = of_points.transpose(2, 3)
        return *found, None


def _blocks(value: Tensor) -> Iterator[slice]:
    """Cut (R, C, S) into rows whose samples are about `BLOCK_BYTES`; a GPU has one block."""
    step = len(value)
    if value.device.type == "cpu":
        step = max(1, BLOCK_BYTES // (4 * POINTS * value[0].numel()))
    for start in range(0, len(value), step):
        yield slice(start, start + step)


def _project(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a layer to channels that come before the tokens: (B, C, S) -> (B, C', S)."""
    batch, _, length = x.shape
    bias = layer.bias[:, None].expand(batch, -1, length)
    return torch.baddbmm(bias, layer.weight.expand(batch, -1, -1), x)


def add_then_normalise(x: Tensor, residual: Tensor, norm: nn.Module) -> Tensor:
    """Return the normalised sum: (..., C) twice -> (..., C)."""
    assert isinstance(norm, nn.LayerNorm), "it has weight, bias and epsilon"
    return add_and_normalise(x, residual, None, parameters_of(norm))[1]


class EncoderLayer(nn.Module):
    """Adds deformable self-attention, then a feed-forward network; normalises after each."""

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
        read = self.self_attn(tokens + position, tokens, levels)
        tokens = add_then_normalise(tokens, read, self.norm1)
        hidden = F.relu(self.linear1(tokens))
        return add_then_normalise(tokens, self.linear2(hidden), self.norm2)


class LevelEncoder(nn.Module):
    """Applies encoder layers to the tokens of all levels."""

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
    """Convolves without bias and normalises groups of channels, under the released names."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int) -> None:
        super().__init__(in_channels, out_channels, kernel, padding=kernel // 2, bias=False)
        nn.init.kaiming_uniform_(self.weight, a=1)
        self.norm = nn.GroupNorm(GROUPS, out_channels)

    def forward(self, input: Tensor) -> Tensor:
        """(B, c, H, W) -> (B, C, H, W)."""
        return self.norm(super().forward(input))


class PixelDecoder(nn.Module):
    """Computes mask features and three levels of tokens from four maps of `widths` channels.

    Source: Mask2Former, Sec. 3.2 and 4.1; MSDeformAttn variant of its release.
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

    def forward(self, features: list[Tensor], num_masks: int) -> PixelPyramid:
        """Compute mask features and tokens of features (B, C_s, H/s, W/s), s = 4, 8, 16, 32.

        Only the first `num_masks` samples have masks. No gradient is computed of the mask features
        of the others.
        """
        if not self.fp32:
            return self._decode(features, num_masks)
        with torch.autocast(features[0].device.type, enabled=False):
            return self._decode([x.float() for x in features], num_masks)

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
            every = [finest]
            if num_masks < fine.shape[0]:
                every.append(self._finest(fine[num_masks:], stride_8[num_masks:]))
            factors = [finest.shape[-1] // columns for _, columns in levels]
            reduced = tuple(torch.cat([shrink(x, f).flatten(2) for x in every]) for f in factors)
        weight, bias = self.mask_features.weight, self.mask_features.get_parameter("bias")
        return PixelPyramid(finest, reduced, weight.flatten(1), bias, per_level, levels)

    def _finest(self, fine: Tensor, stride_8: Tensor) -> Tensor:
        """Add the enlarged map of stride 8 to the backbone's map at stride 4: (M, C, H/4, W/4)."""
        upsampled = F.interpolate(
            stride_8, size=fine.shape[-2:], mode="bilinear", align_corners=False
        )
        # Contiguous, because group normalisation's gradient is slow where channels come last.
        summed = self.adapter_1(fine.contiguous()) + upsampled
        return F.relu(self.layer_1(summed))


def shrink(x: Tensor, factor: int) -> Tensor:
    """Resize by an even factor, bilinear: the mean of the four pixels around each new centre.

    Equals `interpolate(mode="bilinear", align_corners=False)`, which is slow on CPU; (..., H, W) ->
    (..., H / factor, W / factor).
    """
    low, high = factor // 2 - 1, factor // 2
    rows = x[..., low::factor, :] + x[..., high::factor, :]
    return (rows[..., low::factor] + rows[..., high::factor]) / 4


# ---- queries ----


class QueryAttention(nn.Module):
    """Attends as `torch.nn.MultiheadAttention`, with one mask for all heads, not repeated."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.in_proj_weight = nn.Parameter(torch.empty(3 * dim, dim))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * dim))
        self.out_proj = nn.Linear(dim, dim)
        nn.init.xavier_uniform_(self.in_proj_weight)
        nn.init.xavier_uniform_(self.out_proj.weight)
        nn.init.zeros_(self.out_proj.bias)

    def forward(self, query: Tensor, key: Tensor, value: Tensor, allowed: Tensor | None) -> Tensor:
        """(B, Q, C), (B, S, C) twice -> (B, Q, C); `allowed` (B, Q, S) bool is what may be read."""
        weights, biases = self.in_proj_weight.chunk(3), self.in_proj_bias.chunk(3)
        q, k, v = (
            F.linear(x, w, b).view(*x.shape[:2], self.heads, -1).transpose(1, 2)
            for x, w, b in zip((query, key, value), weights, biases, strict=True)
        )
        mask = None if allowed is None else allowed[:, None]
        if q.device.type == "cpu" and q.dtype in (torch.bfloat16, torch.float16):
            # The gradient takes up to three times as long in bfloat16 as in single precision.
            with torch.autocast("cpu", enabled=False):
                out = F.scaled_dot_product_attention(q.float(), k.float(), v.float(), mask)
        else:
            out = F.scaled_dot_product_attention(q, k, v, mask)
        return self.out_proj(out.transpose(1, 2).flatten(2))


class AttentionLayer(nn.Module):
    """Adds to queries what they read of one level, or of each other, and normalises them."""

    def __init__(self, name: str, dim: int, heads: int) -> None:
        super().__init__()
        self.add_module(name, QueryAttention(dim, heads))  # the released name
        self.norm = nn.LayerNorm(dim)

    def forward(
        self, queries: Tensor, placed: Tensor, memory: tuple[Tensor, Tensor], allowed: Tensor | None
    ) -> Tensor:
        """(B, Q, C), without and with position, and keys and values (B, S, C) -> (B, Q, C)."""
        attention, norm = self.children()
        return add_then_normalise(queries, attention(placed, *memory, allowed), norm)


class FfnLayer(nn.Module):
    """Adds to queries a feed-forward network of them, and normalises them."""

    def __init__(self, dim: int, ffn_dim: int) -> None:
        super().__init__()
        self.linear1 = nn.Linear(dim, ffn_dim)
        self.linear2 = nn.Linear(ffn_dim, dim)
        self.norm = nn.LayerNorm(dim)
        for layer in (self.linear1, self.linear2):
            nn.init.xavier_uniform_(layer.weight)

    def forward(self, queries: Tensor) -> Tensor:
        """(B, Q, C) -> (B, Q, C)."""
        hidden = F.relu(self.linear1(queries))
        return add_then_normalise(queries, self.linear2(hidden), self.norm)


def mask_embed(dim: int) -> nn.Sequential:
    """Make three linear layers with ReLU between them: query (..., C) -> mask embedding (..., C).

    The released numbers count the linear layers alone.
    """
    layers: OrderedDict[str, nn.Module] = OrderedDict()
    for number in range(3):
        if number:
            layers[f"relu{number}"] = nn.ReLU()
        layers[str(number)] = nn.Linear(dim, dim)
    return nn.Sequential(OrderedDict(layers=nn.Sequential(layers)))


class QueryDecoder(nn.Module):
    """Decodes queries, with a prediction before the first and after every layer.

    Layer i reads level i mod 3 (strides 32, 16, 8).   Source: Mask2Former, Sec. 3.2, Eq. (1)-(2).
    """

    def __init__(self, shape: HeadShape) -> None:
        super().__init__()
        dim, heads, count = shape.hidden_dim, shape.attention_heads, range(shape.decoder_layers)
        self.transformer_self_attention_layers = nn.ModuleList(
            AttentionLayer("self_attn", dim, heads) for _ in count
        )
        self.transformer_cross_attention_layers = nn.ModuleList(
            AttentionLayer("multihead_attn", dim, heads) for _ in count
        )
        self.transformer_ffn_layers = nn.ModuleList(
            FfnLayer(dim, shape.decoder_ffn_dim) for _ in count
        )
        self.decoder_norm = nn.LayerNorm(dim)
        self.query_feat = nn.Embedding(shape.num_queries, dim)
        self.query_embed = nn.Embedding(shape.num_queries, dim)
        self.level_embed = nn.Embedding(NUM_LEVELS, dim)
        self.class_embed = nn.Linear(dim, shape.num_classes + 1)
        self.mask_embed = mask_embed(dim)

    def forward(self, pyramid: PixelPyramid) -> tuple[Tensor, Tensor]:
        """Predict from the initial queries and after each layer, L times, the last one final.

        Class logits (L, B, Q, K + 1), last column = no object, and mask logits (L, M, Q, H/4, W/4)
        of the M samples of `PixelPyramid.fine`, a view of memory ordered M, L, Q, H/4, W/4.
        """
        memories = []  # keys and values of the three levels, each (B, S_l, C)
        every_level = zip(pyramid.tokens, pyramid.levels, self.level_embed.weight, strict=True)
        for tokens, hw, embed in every_level:
            values = tokens + embed
            memories.append((values + sine_code(hw, values.shape[-1], values.device), values))
        position = self.query_embed.weight
        queries = self.query_feat.weight.expand(pyramid.tokens[0].shape[0], -1, -1)
        normed: list[Tensor] = [self.decoder_norm(queries)]
        embeds: list[Tensor] = [self.mask_embed(normed[0])]
        layers = zip(
            self.transformer_cross_attention_layers,
            self.transformer_self_attention_layers,
            self.transformer_ffn_layers,
            strict=True,
        )
        for index, (cross_attention, self_attention, ffn) in enumerate(layers):
            level = index % NUM_LEVELS
            # Read where the own mask has probability 1/2 or more, if anywhere. Resizing is linear:
            # a resized mask is the product of the embedding with resized features.
            with torch.no_grad():
                inside = _mask_logits(embeds[-1], pyramid, pyramid.reduced[level]) >= 0
                allowed = inside | ~inside.any(-1, keepdim=True)
            queries = cross_attention(queries, queries + position, memories[level], allowed)
            placed = queries + position
            queries = ffn(self_attention(queries, placed, (placed, queries), None))
            normed.append(self.decoder_norm(queries))
            embeds.append(self.mask_embed(normed[-1]))

        # The masks of all layers are one matrix product: no copy, one gradient of the features.
        class_logits = self.class_embed(torch.stack(normed))
        embed = torch.cat(embeds, dim=1)[: pyramid.fine.shape[0]]
        masks = _mask_logits(embed, pyramid, pyramid.fine.flatten(2))
        masks = masks.view(masks.shape[0], len(embeds), -1, *pyramid.fine.shape[-2:])
        return class_logits, masks.transpose(0, 1)


def _mask_logits(embed: Tensor, pyramid: PixelPyramid, fine: Tensor) -> Tensor:
    """Multiply mask embeddings (B, Q, C) by the mask features of `fine`: (B, Q, pixels)."""
    offset = embed @ pyramid.bias[:, None]
    return torch.baddbmm(offset.expand(-1, -1, fine.shape[-1]), embed @ pyramid.weight, fine)
