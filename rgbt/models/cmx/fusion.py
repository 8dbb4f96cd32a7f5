"""Modules between the streams: rectification (FRM) at every stage, fusion (FFM) for the decoder.

Maps are (N, H, W, C); x1 is RGB, x2 thermal.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rgbt.models.cmx.mit import convolve


class ChannelWeights(nn.Module):
    """How much of each channel of a map the other stream takes up, from the whole image.

        sigmoid(MLP([mean(x1), mean(x2), max(x1), max(x2)]))

    Source: CMX, Sec. III-B.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(4 * dim, 4 * dim), nn.ReLU(), nn.Linear(4 * dim, 2 * dim)
        )

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Two (N, H, W, C) -> (2, N, 1, 1, C) in (0, 1): weights on x1, weights on x2."""
        maps = [x.flatten(1, 2) for x in (x1, x2)]
        # Of equal maxima one has the gradient, as in the release: hidden pixels make such ties.
        pooled = [x.mean(1) for x in maps] + [x.max(1).values for x in maps]
        weights: Tensor = self.mlp(torch.cat(pooled, 1)).sigmoid()
        return weights.view(x1.shape[0], 2, 1, 1, -1).transpose(0, 1)


class SpatialWeights(nn.Module):
    """How much of each position of a map the other stream takes up.

        sigmoid(conv1x1(ReLU(conv1x1([x1, x2]))))

    Source: CMX, Sec. III-B.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Conv2d(2 * dim, dim, 1), nn.ReLU(), nn.Conv2d(dim, 2, 1))

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Two (N, H, W, C) -> (2, N, H, W, 1) in (0, 1): weights on x1, weights on x2."""
        weights = convolve(self.mlp, torch.cat([x1, x2], -1)).sigmoid()
        return weights.permute(3, 0, 1, 2).unsqueeze(-1)


class Rectification(nn.Module):
    """FRM: each stream takes up what the other one is sure of.

        x1 + 1/2 (Wc2 + Ws2) x2   and   x2 + 1/2 (Wc1 + Ws1) x1

    Source: CMX, Sec. III-B, with lambda_C = lambda_S = 1/2.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.channel_weights = ChannelWeights(dim)
        self.spatial_weights = SpatialWeights(dim)

    def forward(self, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
        """Two (N, H, W, C) -> the two rectified ones."""
        weights = self.channel_weights(x1, x2) + self.spatial_weights(x1, x2)
        first, second = (0.5 * weights).unbind()
        return torch.addcmul(x1, x2, second), torch.addcmul(x2, x1, first)


class CrossAttention(nn.Module):
    """Each stream reads the other's global context, at a cost linear in the number of tokens.

        z1 = u1 softmax(k2' v2 / sqrt(d)),  z2 = u2 softmax(k1' v1 / sqrt(d)),  [k, v] = u W

    The softmax runs over the channels of k. Source: CMX, Sec. III-C.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.kv1 = nn.Linear(dim, 2 * dim, bias=False)
        self.kv2 = nn.Linear(dim, 2 * dim, bias=False)

    def forward(self, u1: Tensor, u2: Tensor) -> tuple[Tensor, Tensor]:
        """Two (N, T, C) -> two (N, T, C)."""
        context1, context2 = self._context(self.kv1(u1)), self._context(self.kv2(u2))
        return self._read(u1, context2), self._read(u2, context1)

    def _context(self, kv: Tensor) -> Tensor:
        """(N, T, 2C) -> (N, heads, d, d); every column sums to 1."""
        k, v = kv.view(*kv.shape[:2], 2, self.heads, -1).permute(2, 0, 3, 1, 4)
        scale = k.shape[-1] ** -0.5
        similarity: Tensor = k.transpose(-2, -1) @ v * scale
        return similarity.softmax(-2)

    def _read(self, queries: Tensor, context: Tensor) -> Tensor:
        split = queries.view(*queries.shape[:2], self.heads, -1).transpose(1, 2)
        return (split @ context).transpose(1, 2).flatten(2)


class CrossPath(nn.Module):
    """Half of each stream's projection stays, the other half meets the other stream's.

    Source: CMX, Sec. III-C, stage 1.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.channel_proj1 = nn.Linear(dim, 2 * dim)
        self.channel_proj2 = nn.Linear(dim, 2 * dim)
        self.cross_attn = CrossAttention(dim, heads)
        self.end_proj1 = nn.Linear(2 * dim, dim)
        self.end_proj2 = nn.Linear(2 * dim, dim)
        self.norm1 = nn.LayerNorm(dim)
        self.norm2 = nn.LayerNorm(dim)

    def forward(self, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
        """Two (N, T, C) -> two (N, T, C)."""
        kept1, u1 = self.channel_proj1(x1).relu().chunk(2, -1)
        kept2, u2 = self.channel_proj2(x2).relu().chunk(2, -1)
        z1, z2 = self.cross_attn(u1, u2)
        out1 = self.norm1(x1 + self.end_proj1(torch.cat([kept1, z1], -1)))
        out2 = self.norm2(x2 + self.end_proj2(torch.cat([kept2, z2], -1)))
        return out1, out2


class ChannelEmbed(nn.Module):
    """Both streams mixed into one: a 1x1 shortcut and a path with a depthwise convolution.

    Source: CMX, Sec. III-C, stage 2.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.residual = nn.Conv2d(2 * dim, dim, 1, bias=False)
        self.channel_embed = nn.Sequential(
            nn.Conv2d(2 * dim, dim, 1),
            nn.Conv2d(dim, dim, 3, padding=1, groups=dim),
            nn.ReLU(),
            nn.Conv2d(dim, dim, 1),
            nn.BatchNorm2d(dim),
        )
        self.norm = nn.BatchNorm2d(dim)

    def forward(self, both: Tensor) -> Tensor:
        """(N, H, W, 2C) -> (N, H, W, C)."""
        both = both.permute(0, 3, 1, 2)
        out: Tensor = self.norm(self.residual(both) + self.channel_embed(both))
        return out.permute(0, 2, 3, 1)


class Fusion(nn.Module):
    """FFM: exchange of global context, then both streams mixed into one map.

    Source: CMX, Sec. III-C.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.cross = CrossPath(dim, heads)
        self.channel_emb = ChannelEmbed(dim)

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Two (N, H, W, C) -> (N, H, W, C)."""
        streams = self.cross(x1.flatten(1, 2), x2.flatten(1, 2))
        fused: Tensor = self.channel_emb(torch.cat(streams, -1).view(*x1.shape[:3], -1))
        return fused
