"""Multi-scale deformable attention in plain PyTorch, and the encoder layer built on it.

Shape letters beside those of `rgbt.types`: `S` tokens of all levels together, `C` channels,
`M` heads, `D` = C / M, `E` levels, `J` points per head and level.
"""

from __future__ import annotations

import math
from functools import lru_cache, reduce

import torch
from torch import Tensor, nn
from torch.nn import functional as F

POINTS = 4
"""Sampling points per head and level (Deformable DETR, Sec. 4.1; Mask2Former release)."""

Levels = tuple[tuple[int, int], ...]


@lru_cache(maxsize=64)
def centre_grid(levels: Levels, device: torch.device) -> Tensor:
    """Centre of every token of all levels, in the coordinates of `grid_sample`.

        (x, y) = 2 (column + 1/2) / columns - 1,  2 (row + 1/2) / rows - 1

    Source: Deformable DETR, Sec. 4.1 (reference points).

    (2, tokens of all levels) float32, x first; kept per size.
    """
    with torch.inference_mode(False):
        centres = []
        for hw in levels:
            y, x = ((2 * torch.arange(side, dtype=torch.float32) + 1) / side - 1 for side in hw)
            centres.append(torch.stack([x.repeat(hw[0]), y.repeat_interleave(hw[1])]))
        return torch.cat(centres, dim=1).to(device)


@lru_cache(maxsize=64)
def pixel_scale(levels: Levels, device: torch.device) -> Tensor:
    """Length of one pixel in the coordinates of `grid_sample`: 2 / columns, 2 / rows.

    (levels, 1, 2, 1) float32; kept per size.
    """
    with torch.inference_mode(False):
        scale = torch.tensor([[2 / columns, 2 / rows] for rows, columns in levels])
        return scale.view(-1, 1, 2, 1).to(device)


class DeformableAttention(nn.Module):
    """Every token averages a few bilinear samples of each level, at predicted positions.

        out_q = W_o sum_j a_qj  value(reference_q + offset_qj),   sum_j a_qj = 1 per head

    Source: Deformable DETR, Eq. (3). `dim` is C, `heads` M, which divides it, `num_levels` E.
    """

    def __init__(self, dim: int, *, heads: int, num_levels: int) -> None:
        super().__init__()
        self.heads, self.num_levels = heads, num_levels
        samples = heads * num_levels * POINTS
        self.sampling_offsets = nn.Linear(dim, 2 * samples)
        self.attention_weights = nn.Linear(dim, samples)
        self.value_proj = nn.Linear(dim, dim)
        self.output_proj = nn.Linear(dim, dim)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Head m looks at 1..4 pixels in direction 2 pi m / M, all samples with equal weight."""
        for name in ("sampling_offsets", "attention_weights"):
            nn.init.zeros_(self.get_submodule(name).get_parameter("weight"))
        angle = torch.arange(self.heads) * (2 * math.pi / self.heads)
        direction = torch.stack([angle.cos(), angle.sin()], dim=-1)
        direction = direction / direction.abs().amax(-1, keepdim=True)
        length = torch.arange(1, POINTS + 1).view(1, 1, POINTS, 1)
        bias = direction[:, None, None] * length
        with torch.no_grad():
            self.sampling_offsets.bias.copy_(bias.expand(-1, self.num_levels, -1, -1).flatten())
        nn.init.zeros_(self.attention_weights.bias)
        for layer in (self.value_proj, self.output_proj):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, query: Tensor, tokens: Tensor, levels: Levels) -> Tensor:
        """Attention of all tokens to all levels: (B, S, C) -> (B, S, C).

        `query` are the tokens with their position code; S is the sum of rows x columns of the
        levels.
        """
        batch, length, dim = tokens.shape
        sizes = [rows * columns for rows, columns in levels]
        # Everything is computed with tokens last, as grid_sample wants it: no transposed copies.
        value = _project(self.value_proj, tokens.transpose(1, 2)).view(
            batch * self.heads, -1, length
        )
        weights = _project(self.attention_weights, query.transpose(1, 2))
        weights = weights.view(batch * self.heads, -1, length).softmax(1)
        # Sampling places: (B M, E, J, 2, S), (x, y) in the coordinates of grid_sample.
        offset = _project(self.sampling_offsets, query.transpose(1, 2))
        offset = offset.view(batch * self.heads, self.num_levels, POINTS, 2, length)
        centre, scale = centre_grid(levels, query.device), pixel_scale(levels, query.device)
        grids = torch.addcmul(centre, offset, scale).unbind(1)

        parts = []
        values, shares = torch.split(value, sizes, -1), torch.split(weights, POINTS, 1)
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

    def __init__(self, dim: int, *, heads: int, num_levels: int, ffn_dim: int) -> None:
        super().__init__()
        self.self_attn = DeformableAttention(dim, heads=heads, num_levels=num_levels)
        self.norm1 = nn.LayerNorm(dim)
        self.linear1 = nn.Linear(dim, ffn_dim)
        self.linear2 = nn.Linear(ffn_dim, dim)
        self.norm2 = nn.LayerNorm(dim)
        for layer in (self.linear1, self.linear2):
            nn.init.xavier_uniform_(layer.weight)

    def forward(self, tokens: Tensor, position: Tensor, levels: Levels) -> Tensor:
        """(B, S, C) -> (B, S, C); `position` (S, C) is added to the queries only."""
        tokens = self.norm1(tokens + self.self_attn(tokens + position, tokens, levels))
        out: Tensor = self.norm2(tokens + self.linear2(F.relu(self.linear1(tokens))))
        return out
