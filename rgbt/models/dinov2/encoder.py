"""The plain vision transformers of DINOv2 and DINOv3, with rotary positions and low-rank updates.

Entries have the names and shapes of the published files, except `register_tokens`, which DINOv3
names `storage_tokens`, and the mask of its bias, which has no entry here.
Letters beyond `rgbt.types`: ``d`` width, ``h w`` rows and columns of patches, ``T`` tokens: class,
registers, then patches row by row.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.parts import check_heads, feed_forward

OFFSET = 0.1  # patches added to the size when positions are enlarged by a factor (DINOv2 release)

Resize = Literal["factor", "size"]
MlpForm = Literal["gelu", "swiglu"]
Part = Literal["q", "k", "v"]
PARTS: tuple[Part, ...] = ("q", "k", "v")  # in the order of the rows of a joint projection

# Cosine and sine, (T, D) each, D channels of a head.
Rotation = tuple[Tensor, Tensor]


class LoraProjection(nn.Module):
    """Computes what is added to the joint projection of queries, keys and values of one block.

        alpha / rank * B A x,  for each of `parts`, 0 for the others

    Source: LoRA (Hu et al., ICLR 2022), Sec. 4.1, Eq. (3): B is 0, so that the network is unchanged
    at first. A is drawn as in its release, uniformly with a deviation of 1 / sqrt(3 d). The paper
    updates "q" and "v" (Sec. 7.1).
    """

    def __init__(self, dim: int, *, rank: int, alpha: float, parts: tuple[Part, ...]) -> None:
        super().__init__()
        self.scale = alpha / rank
        self.parts = parts
        self.down = nn.ParameterDict({part: torch.empty(rank, dim) for part in parts})
        self.up = nn.ParameterDict({part: torch.zeros(dim, rank) for part in parts})
        for part in parts:
            nn.init.kaiming_uniform_(self.down[part], a=5**0.5)

    def forward(self, x: Tensor) -> Tensor:
        """(N, T, d) -> (N, T, 3 d)."""
        updates = {
            part: self.scale * F.linear(F.linear(x, self.down[part]), self.up[part])
            for part in self.parts
        }
        nothing = torch.zeros_like(next(iter(updates.values())))
        return torch.cat([updates.get(part, nothing) for part in PARTS], dim=-1)


class RotaryPositions(nn.Module):
    """Computes the angles of the channels of a head for every token.

        2 pi y / period and 2 pi x / period,  period = base ** (j / (D / 4)),  j = 0 .. D / 4 - 1

    y and x are the centre of a patch in [-1, 1], each divided by its own side of the image. The
    first half of the channels has the angles of y, then those of x; the second half repeats them.

    Source: DINOv3 release, `layers/rope_position_encoding.py`, normalize_coords "separate", without
    its random rescaling in training. The published files hold the periods rounded to bfloat16.
    """

    periods: Tensor

    def __init__(self, head_dim: int, base: float) -> None:
        super().__init__()
        exponents = 2 * torch.arange(head_dim // 4, dtype=torch.float32) / (head_dim // 2)
        self.register_buffer("periods", base**exponents)

    def forward(self, hw: tuple[int, int], num_first: int) -> Rotation:
        """Return the rotation of `num_first` tokens without a position (none), and of h x w."""
        rows, columns = (self._angles(side) for side in hw)
        rows, columns = rows[:, None].expand(-1, hw[1], -1), columns.expand(hw[0], -1, -1)
        angles = torch.cat([rows, columns], dim=-1).flatten(0, 1).tile(2)
        angles = torch.cat([angles.new_zeros(num_first, angles.shape[1]), angles])
        return angles.cos(), angles.sin()

    def _angles(self, side: int) -> Tensor:
        """(side, D / 4) of the patches along one side of the image."""
        centres = torch.arange(0.5, side, dtype=torch.float32, device=self.periods.device)
        return 2 * math.pi * (2 * (centres / side) - 1)[:, None] / self.periods


def rotated(x: Tensor, rotation: Rotation) -> Tensor:
    """Rotate channels j and j + D / 2 of (N, heads, T, D) as a pair, in single precision."""
    cos, sin = rotation
    first, second = x.chunk(2, dim=-1)
    turned = torch.cat([-second, first], dim=-1)
    return (x * cos + turned * sin).to(x.dtype)


class Attention(nn.Module):
    """Attends with several heads to all tokens.

        softmax(q k' / sqrt(d / heads)) v

    Source: Vision Transformer, App. A; rotation of q and k: RoFormer (2021), Sec. 3.2.2. Without
    `key_bias` the third of the bias for k counts as 0 (DINOv3 release, `layers/attention.py`,
    mask_k_bias).
    """

    def __init__(self, dim: int, heads: int, *, key_bias: bool) -> None:
        super().__init__()
        self.heads, self.key_bias = heads, key_bias
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, lora: LoraProjection | None, rotation: Rotation | None) -> Tensor:
        """(N, T, d) -> (N, T, d); `lora` is added to the projections."""
        bias: Tensor = self.qkv.bias
        if not self.key_bias:
            query, key, value = bias.chunk(3)
            bias = torch.cat([query, torch.zeros_like(key), value])
        qkv = F.linear(x, self.qkv.weight, bias)
        if lora is not None:
            qkv = qkv + lora(x)
        q, k, v = qkv.view(*x.shape[:2], 3, self.heads, -1).permute(2, 0, 3, 1, 4).unbind(0)
        if rotation is not None:
            q, k = rotated(q, rotation), rotated(k, rotation)
        out = F.scaled_dot_product_attention(q, k, v)
        return self.proj(out.transpose(1, 2).flatten(2))


class GatedMlp(nn.Module):
    """Computes ``w3(silu(w1 x) * w2 x)``, the MLP of DINOv3's larger forms.

    Source: Shazeer, GLU Variants Improve Transformer (2020), Eq. (6); biases: DINOv3 release.
    """

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.w1 = nn.Linear(dim, hidden)
        self.w2 = nn.Linear(dim, hidden)
        self.w3 = nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(..., d) -> (..., d)."""
        return self.w3(F.silu(self.w1(x)) * self.w2(x))


class Block(nn.Module):
    """Adds to its input attention, then an MLP, each of the normalised input, scaled by channel.

        x + s1 attention(norm(x)),  then  x + s2 mlp(norm(x))

    Source: Vision Transformer, Eqs. (2) and (3); s1 and s2 (LayerScale): CaiT (ICCV 2021). They are
    1 at first, as in DINOv2's release; DINOv3's own training begins with 1e-5.
    """

    def __init__(
        self, dim: int, heads: int, hidden: int, *, norm_eps: float, key_bias: bool, mlp: MlpForm
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=norm_eps)
        self.attn = Attention(dim, heads, key_bias=key_bias)
        self.ls1 = nn.ParameterDict({"gamma": torch.ones(dim)})
        self.norm2 = nn.LayerNorm(dim, eps=norm_eps)
        self.mlp = GatedMlp(dim, hidden) if mlp == "swiglu" else feed_forward(dim, hidden)
        self.ls2 = nn.ParameterDict({"gamma": torch.ones(dim)})

    def forward(
        self, x: Tensor, lora: LoraProjection | None = None, rotation: Rotation | None = None
    ) -> Tensor:
        """(N, T, d) -> (N, T, d)."""
        x = x + self.attn(self.norm1(x), lora, rotation) * self.ls1["gamma"]
        return x + self.mlp(self.norm2(x)) * self.ls2["gamma"]


def resized_positions(positions: Tensor, hw: tuple[int, int], position_resize: Resize) -> Tensor:
    """Resize learned positions to those of the class token and of h x w patches.

    Source: DINOv2 release, `interpolate_pos_encoding`: both forms are bicubic. "factor", of the
    files without registers, enlarges the grid by ((h + 0.1) / g, (w + 0.1) / g) without
    antialiasing; "size", of those with registers, to h x w with antialiasing.

    (1, 1 + g * g, d), the class token's first, then a square grid row by row -> (1, 1 + h * w, d)
    float32; unchanged for a square of g x g patches.
    """
    grid = round((positions.shape[1] - 1) ** 0.5)
    if hw == (grid, grid):
        return positions
    patches = positions[:, 1:].float().reshape(1, grid, grid, -1).permute(0, 3, 1, 2)
    if position_resize == "factor":
        factor = tuple((side + OFFSET) / grid for side in hw)
        patches = F.interpolate(patches, scale_factor=factor, mode="bicubic")
    else:
        patches = F.interpolate(patches, size=hw, mode="bicubic", antialias=True)
    return torch.cat([positions[:, :1].float(), patches.flatten(2).transpose(1, 2)], dim=1)


class Encoder(nn.Module):
    """Computes patch tokens by the vision transformer of DINOv2 or DINOv3.

    Source: DINOv2 (Oquab et al., TMLR 2024); registers: Darcet et al., "Vision Transformers Need
    Registers" (ICLR 2024), Sec. 2.2; rotary positions, bias and MLP: DINOv3 (Siméoni et al., 2025),
    Sec. 3.2, and its release. Hidden patches get the mask token before the positions. Weights are
    drawn as in the releases.
    """

    def __init__(  # noqa: PLR0913 - see `rgbt.models.dinov2.model.DinoMask2Former`
        self,
        *,
        patch: int,
        embed_dim: int,
        depth: int,
        num_heads: int,
        mlp_ratio: float,
        num_registers: int,
        position_grid: int | None,
        position_resize: Resize | None,
        rope_base: float | None,
        norm_eps: float,
        key_bias: bool,
        mlp: MlpForm,
    ) -> None:
        super().__init__()
        check_heads("model.num_heads", (num_heads,), (embed_dim,))
        if len({position_grid is None, position_resize is None, rope_base is not None}) > 1:
            raise InputError(
                "model.rope_base is for rotary positions, model.position_grid and "
                "model.position_resize are for learned ones; set those of the other kind to null."
            )
        self.patch, self.position_resize, self.num_registers = patch, position_resize, num_registers
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, embed_dim, patch, stride=patch)})
        self.cls_token = nn.Parameter(torch.empty(1, 1, embed_dim))
        if position_grid is not None:
            self.pos_embed = nn.Parameter(torch.empty(1, 1 + position_grid**2, embed_dim))
        if rope_base is not None:
            check_heads("model.rope_base: 4 * num_heads", (4 * num_heads,), (embed_dim,))
            self.rope_embed = RotaryPositions(embed_dim // num_heads, rope_base)
        if num_registers:
            self.register_tokens = nn.Parameter(torch.empty(1, num_registers, embed_dim))
        self.mask_token = nn.Parameter(torch.zeros(1, embed_dim))
        hidden = int(embed_dim * mlp_ratio)
        self.blocks = nn.ModuleList(
            Block(embed_dim, num_heads, hidden, norm_eps=norm_eps, key_bias=key_bias, mlp=mlp)
            for _ in range(depth)
        )
        self.norm = nn.LayerNorm(embed_dim, eps=norm_eps)
        if position_grid is not None:
            nn.init.trunc_normal_(self.pos_embed, std=0.02)
        std = 0.02 if position_grid is None else 1e-6
        nn.init.normal_(self.cls_token, std=std)
        if num_registers:
            nn.init.normal_(self.register_tokens, std=std)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def forward(
        self,
        image: Tensor,
        hidden: Tensor | None = None,
        *,
        layers: tuple[int, ...],
        added: Tensor | None = None,
        lora: nn.ModuleList | None = None,
    ) -> list[Tensor]:
        """Return normalised patch tokens after some of the blocks, as maps (N, d, h, w).

        Args:
            image: (N, 3, H, W) normalised, sides multiples of the patch.
            hidden: (N, h, w) bool, True = the patch is replaced by the mask token.
            layers: numbers of blocks, rising, 1 = the first block.
            added: (d,), added to every patch token before the blocks.
            lora: low-rank updates of the blocks.
        """
        x = self.patch_embed["proj"](image)
        hw = x.shape[2], x.shape[3]
        x = x.flatten(2).transpose(1, 2)
        if hidden is not None:
            x = torch.where(hidden.flatten(1)[..., None], self.mask_token.to(x.dtype), x)
        if added is not None:
            x = x + added
        first: list[Tensor] = [self.cls_token]
        rotation = None
        if self.position_resize is None:
            rotation = self.rope_embed(hw, 1 + self.num_registers)
        else:
            positions = resized_positions(self.pos_embed, hw, self.position_resize)
            first, x = [self.cls_token + positions[:, :1]], x + positions[:, 1:]
        if self.num_registers:  # registers have no position
            first.append(self.register_tokens)
        x = torch.cat([*(token.expand(x.shape[0], -1, -1) for token in first), x], 1)

        maps = []
        for number, block in enumerate(self.blocks[: layers[-1]], 1):
            x = block(x, None if lora is None else lora[number - 1], rotation)
            if number in layers:
                tokens = self.norm(x[:, 1 + self.num_registers :])
                maps.append(tokens.transpose(1, 2).unflatten(2, hw))
        return maps
