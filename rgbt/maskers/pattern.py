"""Pure functions that draw the cells of a mask and combine masks of RGB and thermal.

A mask is (B, h, w) bool, True = taken. Every function draws a whole batch on the device of its
arguments.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rgbt.types import MaskPair


def num_taken(grid_hw: tuple[int, int], ratio: float) -> int:
    """How many cells a mask takes: ``ceil(h w ratio)`` (CRM release, mask generator)."""
    # 20 * 0.55 is 11.000000000000002 in binary; that excess must not cost a cell.
    return math.ceil(grid_hw[0] * grid_hw[1] * ratio - 1e-9)


def gaussian_log_weight(
    grid_hw: tuple[int, int], centre_yx: Tensor, sigma_cells: float, cell_offset: float
) -> Tensor:
    """Logarithm of a Gaussian of the distance between each cell and a centre.

        log W(y, x) = -((y + o - c_y)^2 + (x + o - c_x)^2) / (2 sigma^2)

    Source: SpatialSeg, Sec. IV-B, Eq. 8 (o = 0).

    Centres (B, 2) float and sigma > 0 are in cells; `cell_offset` o says where in a cell its
    position is measured: 0 its index, 0.5 its middle. (B, h, w) float32, 0 at the centre, negative
    elsewhere.
    """
    height, width = grid_hw
    y = torch.arange(height, device=centre_yx.device) + cell_offset
    x = torch.arange(width, device=centre_yx.device) + cell_offset
    squared_y = (y - centre_yx[:, :1]) ** 2
    squared_x = (x - centre_yx[:, 1:]) ** 2
    return -(squared_y[:, :, None] + squared_x[:, None, :]) / (2 * sigma_cells**2)


def fixed_count(log_weight: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Exactly `count` cells per mask, drawn one after the other without replacement.

    Each draw takes a cell with probability proportional to its weight among the cells still there.
    The same distribution in one step (Efraimidis and Spirakis, Information Processing Letters 97,
    2006): take the `count` largest of ``log w - log e`` with independent exponential e.

    (B, h, w) float, all zero to draw uniformly -> (B, h, w) bool.
    """
    waiting = torch.empty_like(log_weight).exponential_(generator=generator)
    keys = (log_weight - waiting.log()).flatten(1)
    taken = torch.zeros_like(keys, dtype=torch.bool)
    taken.scatter_(1, keys.topk(count, dim=1).indices, value=True)
    return taken.view_as(log_weight)


def bernoulli(log_probability: Tensor, generator: torch.Generator) -> Tensor:
    """Every cell of (B, h, w), <= 0, independently with its own probability; their number varies.

    Source: SpatialSeg, Sec. IV-B, Eq. 9.
    """
    uniform = torch.rand(log_probability.shape, generator=generator, device=log_probability.device)
    return uniform < log_probability.exp()


def square(
    batch: int, grid_hw: tuple[int, int], ratio: float, generator: torch.Generator
) -> Tensor:
    """One rectangle per mask at a uniformly drawn position, `ratio` of the height and of the width.

    Paper: CRM, Fig. 5 (half the height and half the width, so a quarter of the area).
    Released: rows and columns of the slice are exchanged and the mask is in pixels where tokens are
    expected, so the released square mask stops with a size mismatch.

    Sides are rounded to whole cells; (B, h, w) bool on the device of `generator`.
    """
    inside = [_interval(batch, length, round(length * ratio), generator) for length in grid_hw]
    return inside[0][:, :, None] & inside[1][:, None, :]


def _interval(batch: int, length: int, extent: int, generator: torch.Generator) -> Tensor:
    """(B, length) bool: `extent` neighbours, every position equally likely."""
    device = generator.device
    start = torch.randint(length - extent + 1, size=[batch, 1], generator=generator, device=device)
    position = torch.arange(length, device=device)
    return (position >= start) & (position < start + extent)


def complementary(taken: Tensor) -> MaskPair:
    """RGB hides the taken cells (B, h, w), thermal all others.

    Source: CRM, Sec. 3.2 (there 1 keeps a cell; here True hides it); SpatialSeg, Eqs 6 and 10.
    """
    return MaskPair(rgb=taken, thermal=~taken)


def random_complementary(
    taken: Tensor, probabilities: tuple[float, float, float], generator: torch.Generator
) -> MaskPair:
    """One of three patterns per sample: only thermal hidden, only RGB hidden, both complementary.

        (M_rgb, M_th) = (0, 1 - m), (m, 0) or (m, 1 - m)

    Source: SpatialSeg, Eq. 11, and the default of both releases (`rand_comp`), each pattern with
    probability 1/3. The CRM paper describes the third alone (`complementary`).

    `taken` m is (B, h, w) bool; the probabilities, in this order, sum to 1.
    """
    batch = len(taken)
    weights = torch.tensor(probabilities, device=taken.device)
    pattern = torch.multinomial(weights, batch, replacement=True, generator=generator)
    pattern = pattern[:, None, None]
    return MaskPair(rgb=taken & (pattern != 0), thermal=~taken & (pattern != 1))
