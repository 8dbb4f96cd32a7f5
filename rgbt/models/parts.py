"""Parts that networks share: random drops from a given generator, the MLP, and up blocks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.processes import num_processes, own
from rgbt.ranges import ShareBelowOne

DropRates = tuple[ShareBelowOne, ShareBelowOne]
"""Channel dropout before the first block, and after every block; each in [0, 1)."""

Keep = Tensor | tuple[None, None]
"""Factors of the two residuals of a block, (2, N, 1, 1, 1); None where nothing is dropped."""

ALL_KEPT = (None, None)


def keep_factors(
    rates: Tensor,
    shape: tuple[int, ...],
    generator: torch.Generator | None,
    device: torch.device,
    *,
    dim: int = 0,
) -> Tensor:
    """Factors of what is dropped at random: 0, or 1 / (1 - rate) where kept.

    Source: Deep Networks with Stochastic Depth, Eq. (4), rescaled while training.

    `rates` are (n,) probabilities of being dropped, in [0, 1); `shape` is that of the draws for
    each of them, such as (samples,), and `dim` the dimension of the samples in it. Returns
    (n, *shape) float32 on `device`. Each process draws for the samples of all processes.

    Raises:
        ValueError: no generator.
    """
    if generator is None:
        raise ValueError("training with random drops requires `generator`, got None.")
    probability = 1 - rates.view(-1, *(1 for _ in shape)).to(generator.device)
    sizes = [*shape]
    sizes[dim] *= num_processes()
    draw = torch.rand(len(rates), *sizes, generator=generator, device=generator.device)
    draw = own(draw, dim + 1)
    return ((draw < probability) / probability).to(device, non_blocking=True)


def stochastic_depth(
    rates: Tensor | None, depths: Sequence[int], x: Tensor, generator: torch.Generator | None
) -> list[Sequence[Keep]]:
    """A `Keep` for every block of stages with `depths` blocks, for a batch x (N, ...).

    `rates` are those of all blocks in order; None: nothing is dropped, nothing drawn.
    """
    if rates is None:
        return [[ALL_KEPT] * depth for depth in depths]
    drawn = keep_factors(rates, (2, len(x), 1, 1, 1), generator, x.device, dim=1)
    return [stage.unbind() for stage in torch.split(drawn, list(depths))]


def add_residual(x: Tensor, residual: Tensor, factor: Tensor | None) -> Tensor:
    """``x + factor * residual``; None, where nothing is dropped, is 1."""
    return x + residual if factor is None else torch.addcmul(x, residual, factor)


def drop_channels(x: Tensor, rate: float, generator: torch.Generator | None) -> Tensor:
    """Whole channels of (N, C, H, W) set to 0 with probability `rate`, the others rescaled.

    Source: Tompson et al., Efficient Object Localization (spatial dropout; torch's Dropout2d).
    """
    if rate == 0:
        return x
    n, channels = x.shape[:2]
    factor = keep_factors(torch.tensor([rate]), (n, channels, 1, 1), generator, x.device)
    return x * factor[0].to(x.dtype)


class Mlp(nn.Module):
    """Linear, exact GELU, linear."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) -> (..., C)."""
        out: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return out


class ResidualBlock(nn.Module):
    """Attention and a feed-forward network, each normalised before and added to its input."""

    def __init__(
        self, dim: int, attn: nn.Module, mlp: nn.Module, *, norm_eps: float = 1e-5
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=norm_eps)
        self.attn = attn
        self.norm2 = nn.LayerNorm(dim, eps=norm_eps)
        self.mlp = mlp

    def forward(self, x: Tensor, keep: Keep = ALL_KEPT) -> Tensor:
        """(N, H, W, C) -> the same."""
        first, second = keep
        x = add_residual(x, self.attn(self.norm1(x)), first)
        return add_residual(x, self.mlp(self.norm2(x)), second)


class UpBlock(nn.Module):
    """Twice the size (bilinear), 3x3 convolution, normalisation, PReLU with one slope.

    Source: HeatNet release, PSPNet decoder; thesis, Fig. 5.
    """

    def __init__(self, in_channels: int, out_channels: int, *, align_corners: bool) -> None:
        super().__init__()
        self.align_corners = align_corners
        self.conv = nn.Sequential(
            nn.Conv2d(in_channels, out_channels, 3, padding=1),
            nn.BatchNorm2d(out_channels),
            nn.PReLU(),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, out, 2 H, 2 W)."""
        larger = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=self.align_corners)
        result: Tensor = self.conv(larger)
        return result


def enlarge(
    x: Tensor, blocks: Iterable[nn.Module], rates: DropRates, generator: torch.Generator | None
) -> Tensor:
    """`x` (N, C, H, W) through the blocks, with channels dropped before the first and after each.

    Rates (0, 0) drop nothing and need no generator, as in evaluation.
    """
    first, later = rates
    x = drop_channels(x, first, generator)
    for block in blocks:
        x = drop_channels(block(x), later, generator)
    return x


def check_heads(key: str, heads: Sequence[int], widths: Sequence[int]) -> None:
    """InputError unless the heads of every stage, settings of `key`, divide its channels."""
    if any(width % number for width, number in zip(widths, heads, strict=True)):
        raise InputError(f"{key}: {list(heads)} must divide the channels {list(widths)}.")
