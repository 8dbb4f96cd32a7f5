"""What deformable attention reads, in blocks and with its own gradients, and Swin's windows."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.models.mask2former import head
from rgbt.models.swin import attend, attend_in_one_kernel

LEVELS = ((2, 3), (4, 6), (8, 12))
LENGTH = sum(rows * columns for rows, columns in LEVELS)


def drawn(rows: int, channels: int, dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Values, positions (some outside of the maps) and weights."""
    generator = torch.Generator().manual_seed(0)
    value = torch.rand(rows, channels, LENGTH, generator=generator)
    grid = torch.rand(rows, 3, head.POINTS, 2, LENGTH, generator=generator) * 2.4 - 1.2
    weights = torch.rand(rows, 3 * head.POINTS, LENGTH, generator=generator)
    return [x.to(dtype).requires_grad_() for x in (value, grid, weights)]


def test_the_sum_of_one_token_is_that_of_its_samples() -> None:
    value, grid, weights = drawn(1, 2)
    with torch.no_grad():
        grid[:, :, :, :, 5] = torch.tensor(0.0)  # between the four middle pixels of every level
        found = head.sample_sum(value, grid, weights, LEVELS)[0, :, 5]
        expected, first = torch.zeros(2, dtype=torch.float64), 0
        for level, (rows, columns) in enumerate(LEVELS):
            maps = value[0, :, first : first + rows * columns].view(2, rows, columns)
            first += rows * columns
            y, x = rows // 2, columns // 2
            if columns % 2:  # the middle column, between two rows
                middle = maps[:, y - 1 : y + 1, x].mean(-1)
            else:
                middle = maps[:, y - 1 : y + 1, x - 1 : x + 1].mean((-2, -1))
            share = weights[0, level * head.POINTS : (level + 1) * head.POINTS, 5].sum()
            expected += share * middle
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("block", [1, 4 * head.POINTS * 3 * LENGTH * 2, 2**40])
def test_own_gradients_are_those_of_autograd(block: int, monkeypatch: Any) -> None:
    monkeypatch.setattr(head, "BLOCK_BYTES", block)  # one row, two rows, all five
    arguments = drawn(5, 3)
    plain = head.sample_sum(*arguments, LEVELS)
    upstream = torch.rand(plain.shape, generator=torch.Generator().manual_seed(1)).double()
    expected = torch.autograd.grad(plain, arguments, upstream)
    blocked = head.SampleSum.apply(*arguments, LEVELS)
    torch.testing.assert_close(blocked, plain, rtol=1e-12, atol=0)
    found = torch.autograd.grad(blocked, arguments, upstream)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-14)


def test_it_keeps_its_arguments_alone() -> None:
    kept: list[Tensor] = []
    arguments = drawn(2, 3)
    with torch.autograd.graph.saved_tensors_hooks(lambda x: kept.append(x) or x, lambda x: x):
        head.SampleSum.apply(*arguments, LEVELS)
    assert [x.data_ptr() for x in kept] == [x.data_ptr() for x in arguments]


@pytest.mark.parametrize("windows", [1, 6])
def test_one_kernel_attends_as_the_plain_formula(windows: int) -> None:
    generator = torch.Generator().manual_seed(0)
    q, k, v = (torch.rand(2, 6, 3, 9, 4, generator=generator).double() for _ in range(3))
    bias = torch.rand(windows, 3, 9, 9, generator=generator).double().requires_grad_()
    expected = attend(q, k, v, bias, 0.7)
    found = attend_in_one_kernel(q, k, v, bias, 0.7)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
    weight = torch.rand(expected.shape, generator=generator).double()
    first, second = (torch.autograd.grad((x * weight).sum(), bias)[0] for x in (expected, found))
    torch.testing.assert_close(second, first, rtol=1e-11, atol=1e-12)


def test_the_network_keeps_no_samples() -> None:
    attention = head.DeformableAttention(64, heads=2, num_levels=3)
    tokens = torch.rand(2, LENGTH, 64)
    kept: list[Tensor] = []
    with torch.autograd.graph.saved_tensors_hooks(lambda x: kept.append(x) or x, lambda x: x):
        attention(tokens, tokens, LEVELS)
    samples = 2 * 64 * LENGTH * head.POINTS  # of one level
    assert max(x.numel() for x in kept) < samples
