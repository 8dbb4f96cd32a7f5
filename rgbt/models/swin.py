"""Swin Transformer branch that can replace tokens by a learned mask token after its embedding.

Maps are (N, H, W, C) throughout. A map is padded before it is rolled, and neither window nor shift
shrinks on small maps, as in the CRM and SpatialSeg releases, and unlike the ImageNet classifier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.parts import Keep, ResidualBlock, feed_forward, stochastic_depth

PATCH = 4


@dataclass(frozen=True)
class SwinShape:
    """Holds the sizes of one branch, keys of ``conf/model/mask2former.yaml``."""

    embed_dim: int
    depths: tuple[int, int, int, int]
    num_heads: tuple[int, int, int, int]
    window_size: int
    mlp_ratio: float
    drop_path_rate: float

    @property
    def widths(self) -> tuple[int, int, int, int]:
        """Return the channels of the four stages."""
        c = self.embed_dim
        return c, 2 * c, 4 * c, 8 * c


def relative_index(window: int) -> Tensor:
    """Return the row of the bias table for each (query, key) pair of a window.

    `window` is its side in tokens.

        index = (dy + window - 1) * (2 window - 1) + (dx + window - 1)

    (window^2, window^2) int64, dy, dx = query minus key position.   Source: Swin Transformer,
    Sec. 3.2, "Relative position bias".
    """
    axis = torch.arange(window)
    yx = torch.stack(torch.meshgrid(axis, axis, indexing="ij")).flatten(1)
    dy, dx = (yx[:, :, None] - yx[:, None, :] + window - 1).unbind()
    return dy * (2 * window - 1) + dx


@lru_cache(maxsize=64)
def shift_mask(hw: tuple[int, int], window: int, shift: int, device: torch.device) -> Tensor:
    """Make the mask that separates tokens which the roll made neighbours; scores are added to it.

    For a map of `hw` tokens, multiples of `window`, that was rolled by 0 < `shift` < window:
    (windows, 1, window^2, window^2) float32, 0 within a region, -100 across regions. Kept per size.
    Source: Swin Transformer, Sec. 3.2, "Efficient batch computation for shifted configuration".
    """
    with torch.inference_mode(False):
        # 0 before the last window, 1 in it, 2 in the tokens that the roll brought from the front.
        parts = []
        for side in hw:
            position = torch.arange(side)
            parts.append((position >= side - window).long() + (position >= side - shift).long())
        rows, columns = parts
        region = 3 * rows[:, None] + columns[None, :]
        grid = region.view(hw[0] // window, window, hw[1] // window, window)
        flat = grid.transpose(1, 2).reshape(-1, window * window)
        apart = flat[:, :, None] != flat[:, None, :]
        return (apart[:, None] * -100.0).to(device)


class WindowAttention(nn.Module):
    """Attends with several heads inside windows, with a learned bias per relative position.

        softmax(q k' / sqrt(d) + bias + shift mask) v

    Source: Swin Transformer, Eq. (4). Maps are rolled by -`shift`.
    """

    relative_position_index: Tensor

    def __init__(self, dim: int, heads: int, window: int, shift: int) -> None:
        super().__init__()
        self.heads, self.window, self.shift = heads, window, shift
        self.scale = (dim // heads) ** -0.5
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        self.relative_position_bias_table = nn.Parameter(torch.empty((2 * window - 1) ** 2, heads))
        nn.init.trunc_normal_(self.relative_position_bias_table, std=0.02)
        index = relative_index(window)
        self.register_buffer("relative_position_index", index, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(N, H, W, C) of any size -> the same."""
        hw, side, shift = x.shape[1:3], self.window, self.shift
        below, right = ((-length) % side for length in hw)
        if below or right:
            x = F.pad(x, (0, 0, 0, right, 0, below))
        if shift:
            x = x.roll((-shift, -shift), (1, 2))
        n, height, width, dim = x.shape
        rows, columns = height // side, width // side
        # Windows and heads are cut out of the projected map in one copy.
        qkv = self.qkv(x).view(n, rows, side, columns, side, 3, self.heads, -1)
        shape = 3, n, rows * columns, self.heads, side * side, -1
        q, k, v = qkv.permute(5, 0, 1, 3, 6, 2, 4, 7).reshape(shape).unbind(0)

        # (1, heads, t, t) or, for shifted windows, (windows, heads, t, t) with t = window^2.
        bias = F.embedding(self.relative_position_index, self.relative_position_bias_table)
        bias = bias.permute(2, 0, 1)[None]
        if shift:
            bias = bias + shift_mask((height, width), side, shift, bias.device)
        out = attend(q, k, v, bias, self.scale)

        out = out.view(n, rows, columns, self.heads, side, side, -1)
        out = out.permute(0, 1, 4, 2, 5, 3, 6).reshape(n, height, width, dim)
        if shift:
            out = out.roll((shift, shift), (1, 2))
        if below or right:
            out = F.pad(out, (0, 0, 0, -right, 0, -below))
        return self.proj(out)


def attend(q: Tensor, k: Tensor, v: Tensor, bias: Tensor, scale: float) -> Tensor:
    """Attend in windows: (N, windows, heads, t, d) each, bias (1 or windows, heads, t, t)."""
    if q.device.type == "cuda":
        return attend_in_one_kernel(q, k, v, bias, scale)
    return ((q * scale) @ k.transpose(-2, -1) + bias).softmax(-1) @ v


def attend_in_one_kernel(q: Tensor, k: Tensor, v: Tensor, bias: Tensor, scale: float) -> Tensor:
    """Compute `attend` without writing the scores, which does not pay on a CPU."""
    n, windows = q.shape[:2]
    bias = bias.expand(n, windows, -1, -1, -1).flatten(0, 1).to(q.dtype)
    q, k, v = (part.flatten(0, 1) for part in (q, k, v))
    out = F.scaled_dot_product_attention(q, k, v, bias, scale=scale)
    return out.view(n, windows, *out.shape[1:])


class PatchMerging(nn.Module):
    """Merges four neighbouring tokens to one of twice the width."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * dim)
        self.reduction = nn.Linear(4 * dim, 2 * dim, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(N, H, W, C) -> (N, ceil(H/2), ceil(W/2), 2C)."""
        n, height, width, dim = x.shape
        if height % 2 or width % 2:
            x = F.pad(x, (0, 0, 0, width % 2, 0, height % 2))
        x = x.view(n, (height + 1) // 2, 2, (width + 1) // 2, 2, dim)
        # Released order of the four: the row changes fastest.
        x = x.permute(0, 1, 3, 4, 2, 5).flatten(3)
        return self.reduction(self.norm(x))


class Stage(nn.Module):
    """Applies blocks of one width, every second one shifted; the merging after them is here too."""

    def __init__(self, shape: SwinShape, index: int) -> None:
        super().__init__()
        dim, heads, window = shape.widths[index], shape.num_heads[index], shape.window_size
        self.blocks = nn.ModuleList()
        for block in range(shape.depths[index]):
            attention = WindowAttention(dim, heads, window, shift=block % 2 * (window // 2))
            hidden = int(dim * shape.mlp_ratio)
            self.blocks.append(ResidualBlock(dim, attention, feed_forward(dim, hidden)))
        self.downsample = PatchMerging(dim) if index < 3 else nn.Identity()

    def forward(self, x: Tensor, keeps: Sequence[Keep]) -> Tensor:
        """(N, H, W, C) -> (N, H, W, C), before merging; `keeps` has one for every block."""
        for block, keep in zip(self.blocks, keeps, strict=True):
            x = block(x, keep)
        return x


class Swin(nn.Module):
    """Computes four normalised maps of one modality, at strides 4, 8, 16 and 32.

    A token is a linear map of 4 x 4 pixels, normalised. `shared` are stages of another branch, by
    index, which this branch uses instead of own ones.
    """

    def __init__(self, in_channels: int, *, shape: SwinShape, shared: dict[int, Stage]) -> None:
        super().__init__()
        self.shape = shape
        self.patch_embed = nn.ModuleDict()
        self.patch_embed["proj"] = nn.Conv2d(in_channels, shape.embed_dim, PATCH, stride=PATCH)
        self.patch_embed["norm"] = nn.LayerNorm(shape.embed_dim)
        self.mask_token = nn.Parameter(torch.empty(1, shape.embed_dim, 1, 1))
        nn.init.trunc_normal_(self.mask_token, std=0.02)
        self.layers = nn.ModuleList(
            shared[index] if index in shared else Stage(shape, index) for index in range(4)
        )
        for index, width in enumerate(shape.widths):
            self.add_module(f"norm{index}", nn.LayerNorm(width))

    def forward(
        self, image: Tensor, hidden: Tensor | None, generator: torch.Generator | None
    ) -> list[Tensor]:
        """Return normalised maps of the four stages, (N, C_s, H/s, W/s), channels last in memory.

        Of a normalised image (N, c, H, W), sides multiples of 32; where `hidden` (N, H/4, W/4) is
        true, the token is replaced by the mask token.
        """
        # The patches do not overlap: as a matrix product the result has tokens last at once.
        n, c, height, width = image.shape
        patches = image.view(n, c, height // PATCH, PATCH, width // PATCH, PATCH)
        patches = patches.permute(0, 2, 4, 1, 3, 5).flatten(3)
        proj, norm = self.patch_embed.children()
        weight, bias = proj.get_parameter("weight"), proj.get_parameter("bias")
        x = norm(F.linear(patches, weight.flatten(1), bias))
        if hidden is not None:
            x = torch.where(hidden[..., None], self.mask_token.view(-1), x)
        rates = None
        if self.training and self.shape.drop_path_rate > 0:  # rates rise from 0
            rates = torch.linspace(0, self.shape.drop_path_rate, sum(self.shape.depths))
        keeps = stochastic_depth(rates, self.shape.depths, x, generator)
        maps = []
        for index, (stage, keep) in enumerate(zip(self.layers, keeps, strict=True)):
            x = stage(x, keep)
            maps.append(self.get_submodule(f"norm{index}")(x).permute(0, 3, 1, 2))
            x = stage.get_submodule("downsample")(x)
        return maps
