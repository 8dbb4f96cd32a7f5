from __future__ import annotations

import itertools

import pytest
import torch
from torch.nn import functional as F

from rgbt.checks import RunError
from rgbt.losses.matcher import assign, pairwise_costs, targets_of
from rgbt.losses.spatial import PointWeights
from tests.losses.problems import seeded


def test_targets_are_padded_and_counted() -> None:
    label = torch.tensor([[[0, 2], [255, 2]], [[255, 255], [255, 255]]])
    targets = targets_of(label, (3, 4), 3, None)
    assert targets.label[0].tolist() == [[0, 2, 255, 255], [255, 2, 255, 255], [255] * 4]
    assert targets.present.tolist() == [[True, False, True], [False] * 3]
    assert not targets.unknown


@pytest.mark.parametrize("value", [3, 9, 254, 256, 1000, -1, -7])
def test_unknown_labels_are_refused(value: int) -> None:
    targets = targets_of(torch.tensor([[[0, value]]]), (1, 2), 3, None)
    with pytest.raises(ValueError, match="expected 0 to 2 or 255"):
        assign(torch.zeros(1, 1, 4, 3), targets)


def test_pairwise_costs_against_the_printed_formula() -> None:
    generator = seeded(0)
    x = 4 * torch.randn(2, 3, 50, generator=generator)
    t = torch.rand(2, 4, 50, generator=generator)
    w = PointWeights(
        1 + torch.rand(2, 50, generator=generator), torch.full((2,), 50.0), torch.tensor([1.0, 0.0])
    )
    expected = torch.zeros(2, 3, 4)
    for r, q, k in itertools.product(range(2), range(3), range(4)):
        weight, s = w.values[r], x[r, q].sigmoid()
        bce = F.binary_cross_entropy_with_logits(x[r, q], t[r, k], weight, reduction="sum") / 50
        numerator = 2 * (weight * s * t[r, k]).sum() + w.smoothing[r]
        dice = 1 - numerator / ((weight * (s + t[r, k])).sum() + w.smoothing[r])
        expected[r, q, k] = 2 * bce + 3 * dice
    assert torch.allclose(
        pairwise_costs(x, t * w.values[:, None], w, 2.0, 3.0), expected, atol=1e-5
    )


def test_assignment_is_the_cheapest_of_all() -> None:
    cost = torch.randn(6, 2, 4, 3, generator=seeded(3))
    targets = targets_of(torch.tensor([[[0, 2]], [[1, 255]]]), (1, 2), 3, None)
    matches = assign(cost, targets)
    assert matches.image.tolist() == [0, 0, 1]
    assert matches.label.tolist() == [0, 2, 1]
    for one_set in range(6):
        first = min(
            itertools.permutations(range(4), 2),
            key=lambda pair, c=cost[one_set, 0]: float(c[pair[0], 0] + c[pair[1], 2]),
        )
        assert tuple(matches.query[one_set, :2]) == first
        assert matches.query[one_set, 2] == cost[one_set, 1, :, 1].argmin()


def test_more_targets_than_queries() -> None:
    targets = targets_of(torch.tensor([[[0, 1, 2]]]), (1, 3), 3, None)
    cost = torch.tensor([[[[5.0, 1.0, 4.0], [5.0, 2.0, 3.0]]]])
    # Queries 0 and 1 take classes 1 and 2 (1 + 3 = 4); class 0 is left without one.
    assert assign(cost, targets).query.tolist() == [[-1, 0, 1]]


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_costs_that_are_not_finite(bad: float) -> None:
    targets = targets_of(torch.tensor([[[0, 1]]]), (1, 2), 2, None)
    with pytest.raises(RunError, match="matching cost"):
        assign(torch.full((1, 1, 3, 2), bad), targets)
