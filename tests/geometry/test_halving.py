"""Maps of half the size: values, gradients and odd sizes against pixel-by-pixel computations."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rgbt.geometry.halving import halved_all, halved_label, halved_mean
from rgbt.geometry.rectangle import inner_rectangle
from rgbt.geometry.warp import Resampling, Warp
from tests.geometry.views import HW, random_views


def covered(values: Tensor, row: int, column: int) -> Tensor:
    """The pixels of one half pixel, (..., N)."""
    return values[..., 2 * row : 2 * row + 2, 2 * column : 2 * column + 2].flatten(-2)


@pytest.mark.parametrize("hw", [(4, 6), (5, 6), (4, 7), (5, 7), (1, 1)])
def test_half_pixels_cover_what_exists_of_two_by_two(hw: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(2, 3, *hw, generator=generator)
    mask = torch.rand(2, *hw, generator=generator) < 0.8
    label = torch.randint(2, (2, *hw), generator=generator)
    label[0, 0, 0] = 255
    mean, whole, agreed = halved_mean(values), halved_all(mask), halved_label(label)
    rows, columns = -(-hw[0] // 2), -(-hw[1] // 2)
    assert mean.shape == (2, 3, rows, columns)
    assert whole.shape == agreed.shape == (2, rows, columns)
    for row in range(rows):
        for column in range(columns):
            expected = covered(values, row, column).mean(-1)
            torch.testing.assert_close(mean[..., row, column], expected)
            assert torch.equal(whole[:, row, column], covered(mask, row, column).all(-1))
            classes = covered(label, row, column)
            same = (classes == classes[:, :1]).all(-1)
            assert torch.equal(agreed[:, row, column], classes[:, 0].where(same, 255))


@pytest.mark.parametrize("hw", [(4, 6), (5, 7)])
def test_the_gradient_of_means_is_the_numerical_one(hw: tuple[int, int]) -> None:
    values = torch.randn(2, 3, *hw, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(halved_mean, (values,))
    memory = values.detach().to(memory_format=torch.channels_last).requires_grad_()
    assert torch.autograd.gradcheck(halved_mean, (memory,))


@pytest.mark.parametrize("hw", [HW, (45, 60), (44, 61), (45, 61)])
@pytest.mark.parametrize("resampling", ["once", "twice"])
def test_a_halved_warp_shows_the_same_points(hw: tuple[int, int], resampling: Resampling) -> None:
    """Maps of columns and rows: an error of the pixel centres would be at least 0.25 pixels."""
    views = random_views(3, 4)
    warp = Warp(views, inner_rectangle(views, HW, "largest"), HW, resampling).resized(hw)
    half = warp.halved()
    assert half.image_hw == (-(-hw[0] // 2), -(-hw[1] // 2))
    places = torch.stack(torch.meshgrid(*(torch.arange(n).float() for n in hw), indexing="ij"))
    places = places.expand(3, -1, -1, -1)
    expected = halved_mean(warp.bilinear(places))
    found = half.bilinear(halved_mean(places))
    last = torch.tensor(hw).view(1, 2, 1, 1) - 1
    # Values are repeated, or fade out, at the borders of both frames.
    away = ((expected > 3) & (expected < last - 3)).all(1, keepdim=True)
    away[..., :2, :] = away[..., -2:, :] = away[..., :2] = away[..., -2:] = False
    assert float(away.float().mean()) > 0.6
    difference = (found - expected).abs().where(away, 0)
    assert float(difference.max()) < 0.05
    if hw[0] % 2 == hw[1] % 2 == 0 and resampling == "once":
        assert bool(half.inside()[halved_all(warp.inside())].all())


@pytest.mark.parametrize("hw", [(6, 8), (5, 7)])
def test_a_halved_identity_gives_its_input(hw: tuple[int, int]) -> None:
    whole = torch.tensor([[-0.5, -0.5, hw[1] - 0.5, hw[0] - 0.5]], dtype=torch.float64)
    half = Warp(torch.eye(3).double()[None], whole, hw, "once").halved()
    values = halved_mean(torch.randn(1, 2, *hw, generator=torch.Generator().manual_seed(0)))
    assert torch.equal(half.bilinear(values), values)
    assert bool(half.inside().all())
