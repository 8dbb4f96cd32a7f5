"""What is dropped at random while training, drawn from a given generator."""

from __future__ import annotations

import torch
from torch import Tensor


def keep_factors(
    rates: Tensor, shape: tuple[int, ...], generator: torch.Generator | None, device: torch.device
) -> Tensor:
    """Factors of residuals that are dropped at random: 0, or 1 / (1 - rate) where kept.

    Source: Deep Networks with Stochastic Depth, Eq. (4), rescaled while training.

    Args:
        rates: (n,) probabilities of being dropped, in [0, 1).
        shape: of the draws for each rate, such as (samples,).
        generator: drawn from.
        device: of the result.

    Returns:
        (n, *shape) float32.

    Raises:
        ValueError: no generator.
    """
    if generator is None:
        raise ValueError("training with random drops needs `generator`, got None.")
    probability = 1 - rates.view(-1, *(1 for _ in shape)).to(generator.device)
    draw = torch.rand(len(rates), *shape, generator=generator, device=generator.device)
    return ((draw < probability) / probability).to(device, non_blocking=True)


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
