"""Low-rank updates of the projections of attention."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Part = Literal["q", "k", "v"]
PARTS: tuple[Part, ...] = ("q", "k", "v")
"""In the order of the rows of a joint projection."""


class LoraProjection(nn.Module):
    """What is added to the joint projection of queries, keys and values of one block.

        alpha / rank * B A x,  for each of `parts`, 0 for the others

    Source: LoRA (Hu et al., ICLR 2022), Sec. 4.1, Eq. (3): A is drawn, B is 0, so that the network
    is unchanged at first. A is drawn as its release does, uniformly with a deviation of
    1 / sqrt(3 d).

    Args:
        dim: d, width of the tokens.
        rank: r, of every update.
        alpha: factor of the updates before the division by the rank.
        parts: updated projections; the LoRA paper updates "q" and "v" (Sec. 7.1).
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


class LoraBlocks(nn.ModuleList):
    """One `LoraProjection` for every block of an encoder."""

    def __init__(
        self, depth: int, dim: int, *, rank: int, alpha: float, parts: tuple[Part, ...]
    ) -> None:
        super().__init__(
            LoraProjection(dim, rank=rank, alpha=alpha, parts=parts) for _ in range(depth)
        )
