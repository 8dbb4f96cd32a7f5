"""Samples of padded frames: `grid_sample` bit by bit, and what is kept for the gradient."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks
from torch.nn import functional as F

from rgbt.geometry.warp import NOWHERE, normalised, powers_of_two, sample

HW = (11, 13)


def points(hw: tuple[int, int], batch: int = 2, seed: int = 0) -> Tensor:
    """A grid of points within the frame of `HW`, on its pixels, on its borders and outside."""
    generator = torch.Generator().manual_seed(seed)
    x, y = (3 * side * torch.rand(batch, *hw, generator=generator) - side for side in reversed(HW))
    x[:, 0], y[:, :, 0] = x[:, 0].round(), y[:, :, 0].round()
    x[:, 1], y[:, :, 1] = -0.5, HW[0] - 0.5
    x[:, 2], y[:, :, 2] = HW[1] - 1.0, 0.0
    x[:, 3] = y[:, 3] = NOWHERE
    return normalised(x, y, HW)


def random(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(1))


def by_torch(values: Tensor, grid: Tensor) -> Tensor:
    height, width = powers_of_two(HW)
    padded = F.pad(values, (0, width - HW[1], 0, height - HW[0]))
    return F.grid_sample(padded, grid.to(values.dtype), align_corners=False)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("hw", [HW, (5, 30)], ids=["same size", "other size"])
def test_sample_values_and_gradients_are_those_of_torch(
    hw: tuple[int, int], dtype: torch.dtype
) -> None:
    grid, upstream = points(hw), random(2, 3, *hw, dtype=dtype)
    ours, theirs = (random(2, 3, *HW, dtype=dtype).requires_grad_() for _ in range(2))
    sampled, expected = sample(ours, grid), by_torch(theirs, grid)
    assert torch.equal(sampled, expected)
    sampled.backward(upstream)
    expected.backward(upstream)
    assert ours.grad is not None
    assert theirs.grad is not None
    assert torch.equal(ours.grad, theirs.grad)
    assert bool(ours.grad.any())


def test_sample_keeps_the_grid_alone() -> None:
    kept: list[tuple[int, ...]] = []

    def note(tensor: Tensor) -> Tensor:
        kept.append(tuple(tensor.shape))
        return tensor

    values, grid = random(2, 3, *HW).requires_grad_(), points(HW)
    with saved_tensors_hooks(note, lambda tensor: tensor):
        sample(values, grid)
    assert kept == [(2, *HW, 2)]


def test_normalised_edges_and_centres_by_hand() -> None:
    """11 x 13 is padded to 16 x 16: pixel 0 has its centre at 1/16 - 1, its edge at -1."""
    assert powers_of_two(HW) == (16, 16)
    x, y = torch.tensor([[[-0.5, 0.0, 12.0]]]), torch.tensor([[[15.5, 7.5, 0.5]]])
    expected = [[-1.0, 1.0], [-15 / 16, 0.0], [9 / 16, -14 / 16]]
    assert normalised(x, y, HW)[0, 0].tolist() == expected
