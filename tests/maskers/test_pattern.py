"""Which cells a mask takes: counts, weights, positions."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from rgbt.maskers import pattern
from rgbt.randomness import torch_generator


@pytest.mark.parametrize(
    ("grid_hw", "ratio", "expected"),
    [((8, 10), 0.5, 40), ((7, 10), 0.5, 35), ((3, 3), 0.5, 5), ((4, 5), 0.55, 11), ((4, 5), 0, 0)],
)
def test_number_of_cells_is_rounded_up(grid_hw, ratio, expected) -> None:
    assert pattern.num_taken(grid_hw, ratio) == expected


def test_gaussian_by_hand() -> None:
    weight = pattern.gaussian_log_weight((2, 3), torch.tensor([[1.0, 1.5]]), 2.0, 0.0)
    # log W(0, 0) = -(1 + 2.25) / 8, log W(1, 2) = -0.25 / 8
    assert weight.shape == (1, 2, 3)
    assert weight[0, 0, 0].item() == pytest.approx(-3.25 / 8)
    assert weight[0, 1, 2].item() == pytest.approx(-0.25 / 8)


def test_fixed_count_is_exact_and_differs_between_samples() -> None:
    log_weight = pattern.gaussian_log_weight(
        (8, 10), torch.tensor([[4.0, 5.0]]).expand(64, 2), 1, 0
    )
    taken = pattern.fixed_count(log_weight, 40, torch_generator(0, "t"))
    assert taken.dtype == torch.bool
    assert (taken.sum((1, 2)) == 40).all()
    assert len({tuple(t.flatten().tolist()) for t in taken}) == 64


def test_fixed_count_is_drawing_one_after_the_other() -> None:
    # Three cells of weight 4, 2, 1; two are drawn without replacement.
    weights = (4.0, 2.0, 1.0)
    expected = dict.fromkeys(range(3), 0.0)
    for first, second in itertools.permutations(range(3), 2):
        rest = sum(weights) - weights[first]
        probability = weights[first] / sum(weights) * weights[second] / rest
        expected[first] += probability
        expected[second] += probability
    log_weight = torch.tensor(weights).log().expand(40000, 1, 3)
    share = pattern.fixed_count(log_weight, 2, torch_generator(1, "t")).double().mean(0)[0]
    # Standard error at most 0.0025.
    assert share.tolist() == pytest.approx([expected[i] for i in range(3)], abs=0.01)


@pytest.mark.parametrize("count", [0, 6])
def test_fixed_count_takes_none_or_all(count) -> None:
    taken = pattern.fixed_count(torch.zeros(2, 2, 3), count, torch_generator(0, "t"))
    assert taken.sum().item() == 2 * count


def test_fixed_count_survives_weights_that_vanish_in_float32() -> None:
    log_weight = torch.full((500, 1, 4), -1e4)
    log_weight[..., 0] = 0.0
    taken = pattern.fixed_count(log_weight, 2, torch_generator(0, "t"))
    assert taken[..., 0].all()
    assert (taken.sum((1, 2)) == 2).all()
    assert taken[..., 1:].any(0).all()


def test_bernoulli_takes_the_centre_always_and_others_by_probability() -> None:
    log_probability = torch.tensor([0.0, math.log(0.25), -1e4]).expand(40000, 1, 3)
    share = pattern.bernoulli(log_probability, torch_generator(0, "t")).double().mean(0)[0]
    assert share[0] == 1
    assert share[1].item() == pytest.approx(0.25, abs=0.01)
    assert share[2] == 0


def test_square_is_one_rectangle_of_half_the_sides() -> None:
    taken = pattern.square(200, (8, 10), 0.5, torch_generator(0, "t"))
    rows, columns = taken.any(2), taken.any(1)
    assert (rows.sum(1) == 4).all()
    assert (columns.sum(1) == 5).all()
    assert torch.equal(taken, rows[:, :, None] & columns[:, None, :])
    # Contiguous: the first and last taken row are three apart.
    first = rows.int().argmax(1)
    last = 7 - rows.flip(1).int().argmax(1)
    assert (last - first == 3).all()
    # Every one of the 5 x 6 positions occurs.
    assert set(first.tolist()) == set(range(5))
    assert set(columns.int().argmax(1).tolist()) == set(range(6))


@pytest.mark.parametrize(("ratio", "cells"), [(0.0, 0), (1.0, 80)])
def test_square_takes_none_or_all(ratio, cells) -> None:
    assert pattern.square(1, (8, 10), ratio, torch_generator(0, "t")).sum() == cells
