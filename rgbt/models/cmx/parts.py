"""Parts of CMX: the Mix Transformer (MiT) of a stream, and the modules between the streams.

Maps are (N, H, W, C) throughout, which is a sequence of tokens and an image that convolutions
take as it is (channels last), so that nothing is copied between the two. Of the modules between the
streams, rectification (FRM; CMX, Sec. III-B) follows every stage and fusion (FFM; Sec. III-C) feeds
the decoder; x1 is RGB, x2 thermal.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.parts import ResidualBlock
from rgbt.ranges import Widths

NORM_EPS = 1e-5  # in patch embeddings and of keys, and in all of CMNeXt's RGB stream


def convolve(convolution: nn.Module, x: Tensor) -> Tensor:
    """A module that expects (N, C, H, W), on (N, H, W, C) without a copy."""
    return convolution(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


class MitPatchEmbed(nn.Module):
    """One token per patch; neighbouring patches overlap."""

    def __init__(
        self, in_channels: int, dim: int, kernel: int, stride: int, *, norm_eps: float
    ) -> None:
        super().__init__()
        self.proj = nn.Conv2d(in_channels, dim, kernel, stride=stride, padding=kernel // 2)
        self.norm = nn.LayerNorm(dim, eps=norm_eps)

    def forward(self, x: Tensor) -> Tensor:
        """(N, H, W, c) -> (N, ceil(H / stride), ceil(W / stride), C)."""
        return self.norm(convolve(self.proj, x))


class MitAttention(nn.Module):
    """Multi-head attention to a map whose sides are `reduction` times smaller.

        softmax(q k' / sqrt(d)) v,   k and v from LayerNorm(conv(x)), kernel = stride = reduction

    Source: SegFormer, Sec. 3.1, Eqs. (1)-(2); PVT.
    """

    def __init__(self, dim: int, heads: int, reduction: int) -> None:
        super().__init__()
        self.heads, self.reduction = heads, reduction
        self.q = nn.Linear(dim, dim)
        self.kv = nn.Linear(dim, 2 * dim)
        self.proj = nn.Linear(dim, dim)
        if reduction > 1:
            self.sr = nn.Conv2d(dim, dim, reduction, stride=reduction)
            self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> Tensor:
        """(N, H, W, C) -> (N, H, W, C), sides at least `reduction`."""
        n, _, _, dim = x.shape
        seen = self.norm(convolve(self.sr, x)) if self.reduction > 1 else x
        q = self.q(x).view(n, -1, self.heads, dim // self.heads).transpose(1, 2)
        kv = self.kv(seen).view(n, -1, 2, self.heads, dim // self.heads)
        k, v = kv.permute(2, 0, 3, 1, 4)
        out = F.scaled_dot_product_attention(q, k, v)
        return self.proj(out.transpose(1, 2).reshape(x.shape))


class MixFfn(nn.Module):
    """Linear, depthwise 3x3 convolution, exact GELU, linear.

    Source: SegFormer, Sec. 3.1, Eq. (3).
    """

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        depthwise = nn.Conv2d(hidden, hidden, 3, padding=1, groups=hidden)
        self.dwconv = nn.Sequential(OrderedDict(dwconv=depthwise))  # the released name
        self.fc2 = nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(N, H, W, C) -> (N, H, W, C)."""
        return self.fc2(F.gelu(convolve(self.dwconv, self.fc1(x))))


def mit_blocks(
    dims: Widths, heads: Widths, reductions: Widths, ratio: float, *, norm_eps: float
) -> Callable[[int], ResidualBlock]:
    """What makes a block of stage 0..3; arguments as in `CMX`."""

    def block(stage: int) -> ResidualBlock:
        attention = MitAttention(dims[stage], heads[stage], reductions[stage])
        mlp = MixFfn(dims[stage], int(dims[stage] * ratio))
        return ResidualBlock(dims[stage], attention, mlp, norm_eps=norm_eps)

    return block


def initialise(module: nn.Module, *, divide_groups: bool = True) -> None:
    """Starting weights, before ImageNet's.   Source: SegFormer and CMX releases.

    Linear: normal with deviation 0.02; convolution: normal with variance 2 / (outputs that one
    input value reaches), in CMNeXt counted in all groups (`divide_groups` False); biases 0.
    """
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
    elif isinstance(module, nn.Conv2d):
        reached = module.weight[:, 0].numel() // (module.groups if divide_groups else 1)
        nn.init.normal_(module.weight, std=(2 / reached) ** 0.5)
    else:
        return
    if module.bias is not None:
        nn.init.zeros_(module.bias)


class ChannelWeights(nn.Module):
    """How much of each channel of a map the other stream takes up, from the whole image.

    sigmoid(MLP([mean(x1), mean(x2), max(x1), max(x2)]))
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(4 * dim, 4 * dim), nn.ReLU(), nn.Linear(4 * dim, 2 * dim)
        )

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Two (N, H, W, C) -> (2, N, 1, 1, C) in (0, 1): weights on x1, weights on x2."""
        maps = [x.flatten(1, 2) for x in (x1, x2)]
        # One of equal maxima has the gradient, as in the release: hidden pixels make such ties.
        pooled = [x.mean(1) for x in maps] + [x.max(1).values for x in maps]
        weights = self.mlp(torch.cat(pooled, 1)).sigmoid()
        return weights.view(x1.shape[0], 2, 1, 1, -1).transpose(0, 1)


class SpatialWeights(nn.Module):
    """How much of each position of a map the other stream takes up.

    sigmoid(conv1x1(ReLU(conv1x1([x1, x2]))))
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

    with lambda_C = lambda_S = 1/2.
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

    The softmax runs over the channels of k.
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
        return (k.transpose(-2, -1) @ v * scale).softmax(-2)

    def _read(self, queries: Tensor, context: Tensor) -> Tensor:
        split = queries.view(*queries.shape[:2], self.heads, -1).transpose(1, 2)
        return (split @ context).transpose(1, 2).flatten(2)


class CrossPath(nn.Module):
    """Half of each stream's projection stays, the other half meets the other stream's."""

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
    """Both streams mixed into one: a 1x1 shortcut and a path with a depthwise convolution."""

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
        return self.norm(self.residual(both) + self.channel_embed(both)).permute(0, 2, 3, 1)


class Fusion(nn.Module):
    """FFM: exchange of global context, then both streams mixed into one map."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.cross = CrossPath(dim, heads)
        self.channel_emb = ChannelEmbed(dim)

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Two (N, H, W, C) -> (N, H, W, C)."""
        streams = self.cross(x1.flatten(1, 2), x2.flatten(1, 2))
        return self.channel_emb(torch.cat(streams, -1).view(*x1.shape[:3], -1))
