"""Class weights from labels, hard pixels, focal loss and Lovász-Softmax, by hand."""

from __future__ import annotations

from math import log
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rgbt.losses.cross_entropy import Computed, CrossEntropy, weights_from
from rgbt.losses.dense import Focal, LovaszSoftmax, OhemCrossEntropy
from rgbt.types import Output
from tests.losses.problems import NOTHING, batch_of, seeded

PIXELS = np.array([[60, 40, 0], [100, 0, 0]])  # of three classes, in two labels


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("enet", (1 / log(1.02 + 0.8), 1 / log(1.02 + 0.2), 0)),
        ("median_frequency", (0.6 / 0.8, 0.6 / 0.4, 0)),  # 160 of 200 and 40 of 100 pixels
        ("inverse", (1 / (3 * 0.8), 1 / (3 * 0.2), 0)),
    ],
)
def test_weights_by_hand(kind: Computed, expected: tuple[float, ...]) -> None:
    assert weights_from(PIXELS, kind) == pytest.approx(expected)
    loss = CrossEntropy(class_weights=kind, class_pixels=lambda: PIXELS)
    assert loss.class_weights == pytest.approx(expected)


def scores_of(*probabilities: list[float]) -> Tensor:
    """Scores (B, 2, 1, P) whose probability of class 1 is given, by image."""
    values = torch.tensor(probabilities)[:, None, None]
    return torch.cat([1 - values, values], 1).log().requires_grad_()


def part_of(loss: Any, logits: Tensor, label: list[list[int]], name: str) -> float:
    (part,) = (
        p for n, p in loss(Output(logits, {}), batch_of(rows(label)), NOTHING).items() if n == name
    )
    assert part.shape == (1,)
    return float(part)


def rows(label: list[list[int]]) -> Tensor:
    return torch.tensor(label)[:, None]


EASY = scores_of([0.5, 0.75, 0.9, 0.1], [0.9, 0.95, 0.9, 0.9])
LABEL = [[1, 1, 1, 255], [1, 1, 255, 255]]


@pytest.mark.parametrize(
    ("threshold", "min_share", "expected"),
    [
        (0.7, 0.0, [0.5]),
        (0.7, 0.5, [0.5, 0.75, 0.9]),  # two of three pixels, and one of two
        (0.8, 0.0, [0.5, 0.75]),
        (1.0, 0.0, [0.5, 0.75, 0.9, 0.9, 0.95]),
        (0.0, 0.4, [0.5, 0.75, 0.9]),  # none is hard: the share alone
    ],
)
def test_hard_pixels_by_hand(threshold: float, min_share: float, expected: list[float]) -> None:
    loss = OhemCrossEntropy(threshold=threshold, min_share=min_share, class_weights=None)
    costs = [-log(share) for share in expected]
    assert part_of(loss, EASY, LABEL, "ohem") == pytest.approx(sum(costs) / len(costs), rel=1e-5)
    assert loss.record.weighs_confidence is False


def test_weights_of_hard_pixels_are_those_of_cross_entropy() -> None:
    label = torch.randint(0, 3, (2, 4, 5), generator=seeded(0))
    label[0, 0] = 255
    logits = torch.randn(2, 3, 4, 5, generator=seeded(1))
    weights = (1.0, 2.0, 0.5)
    every = OhemCrossEntropy(threshold=1.0, min_share=0.0, class_weights=weights)
    plain = CrossEntropy(class_weights=weights)
    output, batch = Output(logits, {}), batch_of(label)
    found, expected = every(output, batch, NOTHING)["ohem"], plain(output, batch, NOTHING)
    assert torch.allclose(found, expected["cross_entropy"])


def test_focal_by_hand() -> None:
    logits, label = scores_of([0.5, 0.25, 0.9]), [[1, 0, 255]]
    plain = (0.5**2 * log(2) + 0.25**2 * log(4 / 3)) / 2
    assert part_of(Focal(gamma=2.0, class_weights=None), logits, label, "focal") == pytest.approx(
        plain
    )
    weighted = (2 * 0.5 * log(2) + 3 * 0.25 * log(4 / 3)) / 2  # not divided by the weights
    focal = Focal(gamma=1.0, class_weights=(3.0, 2.0))
    assert part_of(focal, logits, label, "focal") == pytest.approx(weighted)


def test_lovasz_by_hand() -> None:
    """Errors of class 0: 0.4, 0.3 (other), 0.2; of class 1: 0.4 (other), 0.3, 0.2 (other)."""
    logits = scores_of([0.2, 0.4, 0.7, 0.5], [0.0001, 0.0001, 0.0001, 0.0001])
    first = (0.4 * 1 / 2 + 0.3 * (2 / 3 - 1 / 2) + 0.2 * (1 - 2 / 3), 0.4 * 1 / 2 + 0.3 * 1 / 2)
    loss = LovaszSoftmax(cross_entropy=0.5)
    # The second image shows one class, which is found but for 0.0001.
    label = [[0, 0, 1, 255], [0, 0, 0, 0]]
    value = part_of(loss, logits, label, "lovasz")
    assert value == pytest.approx((sum(first) / 2 + 0.0001) / 2, rel=1e-4)
    costs = [-log(share) for share in (0.8, 0.6, 0.7, *[0.9999] * 4)]
    assert part_of(loss, logits, label, "cross_entropy") == pytest.approx(0.5 * sum(costs) / 7)


@pytest.mark.parametrize(
    "loss",
    [
        OhemCrossEntropy(threshold=0.7, min_share=0.1, class_weights=None),
        Focal(gamma=0.5, class_weights=None),
        LovaszSoftmax(cross_entropy=1.0),
    ],
)
def test_nothing_labelled_costs_nothing_and_gradients_are_finite(loss: Any) -> None:
    logits = torch.tensor([[[[90.0, 0.0]], [[-90.0, 0.0]]]]).requires_grad_()
    parts = loss(Output(logits, {}), batch_of(torch.full((1, 1, 2), 255)), NOTHING)
    assert [float(part) for part in parts.values()] == [0.0] * len(parts)
    parts = loss(Output(logits, {}), batch_of(torch.tensor([[[0, 1]]])), NOTHING)
    torch.cat([*parts.values()]).sum().backward()
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()
    assert logits.grad[0, :, 0, 1].abs().sum() > 0
