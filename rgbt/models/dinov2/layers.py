"""Parts of a block: attention with its joint projection, the gated MLP, and factors by channel.

Letters: as in `rgbt.models.dinov2.encoder`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.dinov2.lora import LoraProjection
from rgbt.models.dinov2.rotary import Rotation, rotated


class KeylessLinear(nn.Linear):
    """Joint projection of queries, keys and values with a bias whose third for keys counts as 0.

    Source: DINOv3 release, `layers/attention.py`, mask_k_bias. The published files have the third.
    """

    def forward(self, input: Tensor) -> Tensor:
        """(..., d) -> (..., 3 d)."""
        query, key, value = self.bias.chunk(3)
        bias = torch.cat([query, torch.zeros_like(key), value])
        return F.linear(input, self.weight, bias)


class Attention(nn.Module):
    """Multi-head attention among all tokens.

        softmax(q k' / sqrt(d / heads)) v

    Source: Vision Transformer (Dosovitskiy et al., ICLR 2021), App. A; rotation of q and k:
    RoFormer (Su et al., 2021), Sec. 3.2.2.
    """

    def __init__(self, dim: int, heads: int, *, key_bias: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = (nn.Linear if key_bias else KeylessLinear)(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, lora: LoraProjection | None, rotation: Rotation | None) -> Tensor:
        """(N, T, d) -> (N, T, d); `lora` is added to the projections."""
        qkv = self.qkv(x)
        if lora is not None:
            qkv = qkv + lora(x)
        q, k, v = qkv.unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        if rotation is not None:
            q, k = rotated(q, rotation), rotated(k, rotation)
        out = F.scaled_dot_product_attention(q, k, v)
        projected: Tensor = self.proj(out.transpose(1, 2).flatten(2))
        return projected


class LayerScale(nn.Module):
    """One factor per channel.

    It is 1 at first (DINOv2 release, `hub/backbones.py`, init_values). DINOv3's own training begins
    with 1e-5, which matters only without a file of weights.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        """(..., d) -> (..., d)."""
        return x * self.gamma


class GatedMlp(nn.Module):
    """The MLP of DINOv3's larger forms.

        w3(silu(w1 x) * w2 x)

    Source: Shazeer, GLU Variants Improve Transformer (2020), Eq. (6); biases: DINOv3 release.
    """

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.w1 = nn.Linear(dim, hidden)
        self.w2 = nn.Linear(dim, hidden)
        self.w3 = nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(..., d) -> (..., d)."""
        out: Tensor = self.w3(F.silu(self.w1(x)) * self.w2(x))
        return out
