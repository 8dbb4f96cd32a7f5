from __future__ import annotations

import itertools

import pytest
import torch
from torch.nn import functional as F

from rgbt.checks import RunError
from rgbt.losses.points import Points, class_shares, most_uncertain, sample
from rgbt.losses.set_criterion import assign, pairwise_costs, targets_of
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


CPU = torch.device("cpu")


def source(seed: int = 0) -> Points:
    return Points(seeded(seed), device=CPU)


@pytest.mark.parametrize("count", [1, 3, 64])
def test_draws_do_not_depend_on_the_number_of_sets(count: int) -> None:
    together = source().loss(5, 3, count)
    one_by_one = source()
    pieces = [one_by_one.loss(n, 3, count) for n in (1, 3, 1)]
    assert together.shape == (5, 3, count, 2)
    assert torch.equal(together, torch.cat(pieces))


def test_points_are_uniform_and_independent() -> None:
    points = source().matcher(2, 4, 50_000).reshape(-1, 2)
    assert points.abs().max() < 1
    # Uniform on [-1, 1]: mean 0, variance 1/3. 400,000 draws: five standard errors are below 0.005.
    assert torch.allclose(points.mean(0), torch.zeros(2), atol=5e-3)
    assert torch.allclose(points.var(0), torch.full((2,), 1 / 3), atol=5e-3)
    neighbours = torch.cat([points[:-1], points[1:]], dim=1)
    assert torch.corrcoef(neighbours.T).fill_diagonal_(0)[:2].abs().triu(1).max() < 0.01
    share, _ = torch.histogram(points[:, 0], bins=16, range=(-1.0, 1.0))
    assert torch.allclose(share / len(points), torch.full((16,), 1 / 16), atol=3e-3)


def test_sample_by_hand() -> None:
    # 1 x 2 pixels [4, 8]: their centres lie at x = -1/2 and 1/2.
    maps = torch.tensor([[[[4.0, 8.0]]]])
    points = torch.tensor([[[[-0.5, 0.0], [0.0, 0.0], [0.25, 0.0], [-1.0, 0.0]]]])
    assert sample(maps, points).flatten().tolist() == [4.0, 6.0, 7.0, 2.0]  # the last half outside
    assert sample(maps, points, "border").flatten().tolist() == [4.0, 6.0, 7.0, 4.0]


def test_class_shares_equal_the_sampled_one_hot_label() -> None:
    generator = seeded(0)
    label = torch.randint(0, 5, (3, 10, 14), generator=generator)
    label[label == 4] = 255
    points = 2 * torch.rand(2, 3, 500, 2, generator=generator) - 1
    points[0, 0, 0] = torch.tensor([1.0, 1.0])
    points[0, 0, 1] = torch.tensor([-1.0, -1.0])
    one_hot = torch.stack([label == k for k in range(4)], 1).float()
    expected = sample(one_hot, points.transpose(0, 1)).permute(2, 0, 1, 3)
    assert torch.allclose(class_shares(label, points, 4), expected, atol=1e-5)


def test_most_uncertain_keeps_the_smallest_magnitudes() -> None:
    logits = torch.tensor([[3.0, -1.0, 0.5, -0.0], [-9.0, 8.0, -7.0, 6.0]])
    points = torch.arange(16.0).reshape(2, 4, 2)
    kept = most_uncertain(logits.clone(), points, 2)
    assert sorted(kept[0, :, 0].tolist()) == [4.0, 6.0]
    assert sorted(kept[1, :, 0].tolist()) == [12.0, 14.0]
    assert most_uncertain(logits.clone(), points, 0).shape == (2, 0, 2)
