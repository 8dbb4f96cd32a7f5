"""The plain vision transformers of DINOv2 and DINOv3.

Entries have the names and shapes of the published files, except `register_tokens`, which DINOv3
names `storage_tokens`, and the mask of its bias, which has no entry here.

Letters beyond `rgbt.types`: ``d`` width, ``h w`` rows and columns of patches, ``T`` tokens: class,
registers, then patches row by row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.dinov2.layers import Attention, GatedMlp, LayerScale
from rgbt.models.dinov2.lora import LoraBlocks, LoraProjection
from rgbt.models.dinov2.rotary import RotaryPositions, Rotation
from rgbt.models.parts import Mlp

OFFSET = 0.1
"""Patches added to the size when positions are enlarged by a factor (DINOv2 release)."""

TOKEN_STD = {"learned": 1e-6, "rotary": 0.02}
"""Deviation of the initial class token and registers (DINOv2 and DINOv3 releases)."""

PositionResize = Literal["factor", "size"]
MlpForm = Literal["gelu", "swiglu"]


@dataclass(frozen=True, kw_only=True)
class ViTShape:
    """Sizes of the encoder; see `rgbt.models.dinov2.model.DinoMask2Former`.

    Raises:
        InputError: heads that do not divide the width, or positions that are both learned and
            rotary, or neither.
    """

    patch: int
    embed_dim: int
    depth: int
    num_heads: int
    mlp_ratio: float
    num_registers: int
    position_grid: int | None
    position_resize: PositionResize | None
    rope_base: float | None
    norm_eps: float
    key_bias: bool
    mlp: MlpForm

    def __post_init__(self) -> None:
        if self.embed_dim % self.num_heads:
            raise InputError(
                f"model.num_heads = {self.num_heads} must divide model.embed_dim = "
                f"{self.embed_dim}."
            )
        is_learned = {self.position_grid is not None, self.position_resize is not None}
        if is_learned != {self.rope_base is None}:
            raise InputError(
                "model: positions are either learned, with model.position_grid and "
                "model.position_resize, or rotary, with model.rope_base; set the others to null."
            )
        if self.rope_base is not None and self.embed_dim % (4 * self.num_heads):
            raise InputError(
                f"model.embed_dim = {self.embed_dim} must be a multiple of 4 channels for each of "
                f"model.num_heads = {self.num_heads}, because positions are rotary."
            )


class Block(nn.Module):
    """Attention and MLP, each normalised before, scaled by channel and added to its input.

        x + s1 attention(norm(x)),  then  x + s2 mlp(norm(x))

    Source: Vision Transformer, Eqs. (2) and (3); LayerScale: CaiT (Touvron et al., ICCV 2021).
    """

    def __init__(self, shape: ViTShape) -> None:
        super().__init__()
        dim = shape.embed_dim
        self.norm1 = nn.LayerNorm(dim, eps=shape.norm_eps)
        self.attn = Attention(dim, shape.num_heads, key_bias=shape.key_bias)
        self.ls1 = LayerScale(dim)
        self.norm2 = nn.LayerNorm(dim, eps=shape.norm_eps)
        mlp = GatedMlp if shape.mlp == "swiglu" else Mlp
        self.mlp = mlp(dim, int(dim * shape.mlp_ratio))
        self.ls2 = LayerScale(dim)

    def forward(
        self, x: Tensor, lora: LoraProjection | None = None, rotation: Rotation | None = None
    ) -> Tensor:
        """(N, T, d) -> (N, T, d)."""
        x = x + self.ls1(self.attn(self.norm1(x), lora, rotation))
        out: Tensor = x + self.ls2(self.mlp(self.norm2(x)))
        return out


def resized_positions(
    positions: Tensor, hw: tuple[int, int], position_resize: PositionResize
) -> Tensor:
    """Positions of the class token and of h x w patches.

    Source: DINOv2 release, `interpolate_pos_encoding`: both forms are bicubic. The files without
    registers were trained with "factor", those with registers with "size".

    Args:
        positions: (1, 1 + g * g, d), the class token's first, then a square grid row by row.
        hw: patches of the image.
        position_resize: "factor": the grid is enlarged by ((h + 0.1) / g, (w + 0.1) / g) without
            antialiasing; "size": to h x w with antialiasing.

    Returns:
        (1, 1 + h * w, d) float32; unchanged for a square of g x g patches.
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
    """Patch embedding, positions, registers and blocks.

    Source: DINOv2 (Oquab et al., TMLR 2024); registers: Darcet et al., "Vision Transformers Need
    Registers" (ICLR 2024), Sec. 2.2; rotary positions, bias and MLP: DINOv3 (Siméoni et al., 2025),
    Sec. 3.2, and its release. Hidden patches get the mask token before the positions.
    """

    def __init__(self, shape: ViTShape) -> None:
        super().__init__()
        dim = shape.embed_dim
        self.shape = shape
        self.patch_embed = nn.ModuleDict(
            {"proj": nn.Conv2d(3, dim, shape.patch, stride=shape.patch)}
        )
        self.cls_token = nn.Parameter(torch.empty(1, 1, dim))
        if shape.position_grid is not None:
            self.pos_embed = nn.Parameter(torch.empty(1, 1 + shape.position_grid**2, dim))
        if shape.rope_base is not None:
            self.rope_embed = RotaryPositions(dim // shape.num_heads, shape.rope_base)
        if shape.num_registers:
            self.register_tokens = nn.Parameter(torch.empty(1, shape.num_registers, dim))
        self.mask_token = nn.Parameter(torch.zeros(1, dim))
        self.blocks = nn.ModuleList(Block(shape) for _ in range(shape.depth))
        self.norm = nn.LayerNorm(dim, eps=shape.norm_eps)
        self._initialise()

    def _initialise(self) -> None:
        """Draw the initial weights as the releases do."""
        std = TOKEN_STD["rotary"]
        if self.shape.position_grid is not None:
            std = TOKEN_STD["learned"]
            nn.init.trunc_normal_(self.pos_embed, std=0.02)
        nn.init.normal_(self.cls_token, std=std)
        if self.shape.num_registers:
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
        lora: LoraBlocks | None = None,
    ) -> list[Tensor]:
        """Normalised patch tokens after some of the blocks, as maps.

        Args:
            image: (N, 3, H, W) normalised, sides multiples of the patch.
            hidden: (N, h, w) bool, True = the patch is replaced by the mask token; None: none.
            layers: numbers of blocks, rising, 1 = the first block.
            added: (d,), added to every patch token before the blocks; None: nothing.
            lora: low-rank updates of the blocks; None: none.

        Returns:
            (N, d, h, w) for each of `layers`; the final normalisation is applied to all.
        """
        x = self.patch_embed["proj"](image)
        hw = x.shape[2], x.shape[3]
        x = x.flatten(2).transpose(1, 2)
        if hidden is not None:
            x = torch.where(hidden.flatten(1)[..., None], self.mask_token.to(x.dtype), x)
        if added is not None:
            x = x + added
        x, rotation = self._positioned(x, hw)

        maps, skipped = [], 1 + self.shape.num_registers
        for number, block in enumerate(self.blocks[: layers[-1]], 1):
            x = block(x, None if lora is None else lora[number - 1], rotation)
            if number in layers:
                tokens = self.norm(x[:, skipped:])
                maps.append(tokens.transpose(1, 2).unflatten(2, hw))
        return maps

    def _positioned(self, x: Tensor, hw: tuple[int, int]) -> tuple[Tensor, Rotation | None]:
        """All tokens (N, T, d) with learned positions, or with the rotation of rotary ones."""
        first: list[Tensor] = [self.cls_token]
        rotation = None
        if self.shape.position_resize is None:
            rotation = self.rope_embed(hw, 1 + self.shape.num_registers)
        else:
            positions = resized_positions(self.pos_embed, hw, self.shape.position_resize)
            first, x = [self.cls_token + positions[:, :1]], x + positions[:, 1:]
        if self.shape.num_registers:  # registers have no position
            first.append(self.register_tokens)
        return torch.cat([*(each.expand(x.shape[0], -1, -1) for each in first), x], 1), rotation
