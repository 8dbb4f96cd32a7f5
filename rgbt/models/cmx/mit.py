"""Mix Transformer (MiT): patch embedding, attention with fewer keys, feed-forward.

Maps are (N, H, W, C) throughout, which is a sequence of tokens and an image that convolutions
take as it is (channels last), so that nothing is copied between the two.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.parts import ResidualBlock
from rgbt.ranges import Widths

NORM_EPS = 1e-5
"""Of the normalisations in patch embeddings and of keys, and of all of CMNeXt's RGB stream."""


def convolve(convolution: nn.Module, x: Tensor) -> Tensor:
    """A module that expects (N, C, H, W), on (N, H, W, C) without a copy."""
    out: Tensor = convolution(x.permute(0, 3, 1, 2))
    return out.permute(0, 2, 3, 1)


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
        tokens: Tensor = self.norm(convolve(self.proj, x))
        return tokens


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
        mixed: Tensor = self.proj(out.transpose(1, 2).reshape(x.shape))
        return mixed


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
        out: Tensor = self.fc2(F.gelu(convolve(self.dwconv, self.fc1(x))))
        return out


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
    """Starting weights of the streams and of what lies between them, before ImageNet's.

    Linear: normal with deviation 0.02; convolution: normal with variance 2 / (outputs that one
    input value reaches); biases 0.   Source: SegFormer and CMX releases.   Released, CMNeXt: the
    outputs of all groups are counted (`divide_groups` False).
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
