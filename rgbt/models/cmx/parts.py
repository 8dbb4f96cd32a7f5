"""Parts of CMX: the Mix Transformer (MiT) of a stream, and the modules between the streams.

Maps are (N, H, W, C) throughout. Linear layers take them as tokens, convolutions (`MapConv`) as
images in the memory format "channels last", so that nothing is copied between the two. Of the
modules between the streams, rectification (FRM; CMX, Sec. III-B) follows every stage and fusion
(FFM; Sec. III-C) feeds the decoder; x1 is RGB, x2 thermal.
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


class MapConv(nn.Conv2d):
    """Convolves maps (N, H, W, C) without a copy."""

    def forward(self, input: Tensor) -> Tensor:
        """(N, H, W, c) -> (N, h, w, C)."""
        return super().forward(input.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


def mit_patch_embed(
    in_channels: int, dim: int, kernel: int, stride: int, *, norm_eps: float
) -> nn.Sequential:
    """Make the embedding of overlapping patches as normalised tokens.

    (N, H, W, c) -> (N, ceil(H / stride), ceil(W / stride), C).
    """
    proj = MapConv(in_channels, dim, kernel, stride=stride, padding=kernel // 2)
    return nn.Sequential(OrderedDict(proj=proj, norm=nn.LayerNorm(dim, eps=norm_eps)))


class MitAttention(nn.Module):
    """Attends with several heads to a map whose sides are `reduction` times smaller.

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
            self.sr = MapConv(dim, dim, reduction, stride=reduction)
            self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> Tensor:
        """(N, H, W, C) -> (N, H, W, C), sides at least `reduction`."""
        n, _, _, dim = x.shape
        seen = self.norm(self.sr(x)) if self.reduction > 1 else x
        q = self.q(x).view(n, -1, self.heads, dim // self.heads).transpose(1, 2)
        kv = self.kv(seen).view(n, -1, 2, self.heads, dim // self.heads)
        k, v = kv.permute(2, 0, 3, 1, 4)
        out = F.scaled_dot_product_attention(q, k, v)
        return self.proj(out.transpose(1, 2).reshape(x.shape))


def mix_ffn(first: nn.Module, depthwise: nn.Module, last: nn.Module) -> nn.Sequential:
    """Make a feed-forward network of three layers, with an exact GELU before the last one.

    Linear layers around a depthwise 3x3 convolution in MiT, convolutions alone in CMNeXt.
    Source: SegFormer, Sec. 3.1, Eq. (3).
    """
    named = nn.Sequential(OrderedDict(dwconv=depthwise))  # the released name
    return nn.Sequential(OrderedDict(fc1=first, dwconv=named, act=nn.GELU(), fc2=last))


def mit_blocks(
    dims: Widths, heads: Widths, reductions: Widths, ratio: float, *, norm_eps: float
) -> Callable[[int], ResidualBlock]:
    """Return the function that makes a block of stage 0..3; arguments as in `CMX`."""

    def block(stage: int) -> ResidualBlock:
        attention = MitAttention(dims[stage], heads[stage], reductions[stage])
        dim, hidden = dims[stage], int(dims[stage] * ratio)
        mlp = mix_ffn(
            nn.Linear(dim, hidden),
            MapConv(hidden, hidden, 3, padding=1, groups=hidden),
            nn.Linear(hidden, dim),
        )
        return ResidualBlock(dim, attention, mlp, norm_eps=norm_eps)

    return block


def initialise(module: nn.Module, *, divide_groups: bool = True) -> None:
    """Draw starting weights, before ImageNet's.   Source: SegFormer and CMX releases.

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


class Rectification(nn.Module):
    """FRM: adds to each stream what the other one is sure of.

        x1 + 1/2 (Wc2 + Ws2) x2   and   x2 + 1/2 (Wc1 + Ws1) x1
        Wc = sigmoid(MLP([mean(x1), mean(x2), max(x1), max(x2)]))     of channels, from all pixels
        Ws = sigmoid(conv1x1(ReLU(conv1x1([x1, x2]))))                of positions

    with lambda_C = lambda_S = 1/2.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        mlp = nn.Sequential(nn.Linear(4 * dim, 4 * dim), nn.ReLU(), nn.Linear(4 * dim, 2 * dim))
        self.channel_weights = nn.Sequential(OrderedDict(mlp=mlp, share=nn.Sigmoid()))
        mlp = nn.Sequential(MapConv(2 * dim, dim, 1), nn.ReLU(), MapConv(dim, 2, 1))
        self.spatial_weights = nn.Sequential(OrderedDict(mlp=mlp, share=nn.Sigmoid()))

    def forward(self, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
        """Two (N, H, W, C) -> the two rectified ones."""
        maps = [x.flatten(1, 2) for x in (x1, x2)]
        # One of equal maxima has the gradient, as in the release: hidden pixels make such ties.
        pooled = [x.mean(1) for x in maps] + [x.max(1).values for x in maps]
        # Weights on x1, then on x2: (2, N, 1, 1, C) of channels and (2, N, H, W, 1) of positions.
        of_channels = self.channel_weights(torch.cat(pooled, 1))
        of_channels = of_channels.view(x1.shape[0], 2, 1, 1, -1).transpose(0, 1)
        of_positions = self.spatial_weights(torch.cat([x1, x2], -1))
        of_positions = of_positions.permute(3, 0, 1, 2).unsqueeze(-1)
        first, second = (0.5 * (of_channels + of_positions)).unbind()
        return torch.addcmul(x1, x2, second), torch.addcmul(x2, x1, first)


class CrossAttention(nn.Module):
    """Lets each stream read the other's global context, at a cost linear in the number of tokens.

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
    """Keeps half of each stream's projection, and lets the other half read the other stream's."""

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


class StreamFusion(nn.Module):
    """FFM: exchanges global context, then mixes both streams into one map.

    They are mixed by a 1x1 shortcut and a path with a depthwise convolution.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.cross = CrossPath(dim, heads)
        path = nn.Sequential(
            nn.Conv2d(2 * dim, dim, 1),
            nn.Conv2d(dim, dim, 3, padding=1, groups=dim),
            nn.ReLU(),
            nn.Conv2d(dim, dim, 1),
            nn.BatchNorm2d(dim),
        )
        self.channel_emb = nn.ModuleDict()
        self.channel_emb["residual"] = nn.Conv2d(2 * dim, dim, 1, bias=False)
        self.channel_emb["channel_embed"] = path
        self.channel_emb["norm"] = nn.BatchNorm2d(dim)

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Two (N, H, W, C) -> (N, H, W, C)."""
        streams = self.cross(x1.flatten(1, 2), x2.flatten(1, 2))
        both = torch.cat(streams, -1).view(*x1.shape[:3], -1).permute(0, 3, 1, 2)
        shortcut, path, norm = self.channel_emb.children()
        return norm(shortcut(both) + path(both)).permute(0, 2, 3, 1)
