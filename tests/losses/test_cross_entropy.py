from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.losses.cross_entropy import CrossEntropy
from rgbt.types import Output
from tests.losses.problems import NOTHING, batch_of, seeded


def test_value_by_hand() -> None:
    # Two pixels with scores (0, 0): log 2 each; the ignored one counts nowhere.
    batch = batch_of(torch.tensor([[[0, 1, 255]]]))
    logits = torch.tensor([[[[0.0, 0.0, 9.0]], [[0.0, 0.0, -9.0]]]])
    part = CrossEntropy(class_weights=None)(Output(logits, {}), batch, NOTHING)["cross_entropy"]
    assert part.shape == (1,)
    assert torch.allclose(part, torch.tensor([2.0]).log())


def test_class_weights() -> None:
    generator = seeded(0)
    label = torch.randint(0, 3, (2, 4, 5), generator=generator)
    logits = torch.randn(2, 3, 4, 5, generator=generator).requires_grad_()
    loss = CrossEntropy(class_weights=(1.0, 2.0, 0.5))
    part = loss(Output(logits, {}), batch_of(label), NOTHING)["cross_entropy"]
    expected = F.cross_entropy(logits, label, torch.tensor([1.0, 2.0, 0.5]), ignore_index=255)
    assert torch.allclose(part, expected)
    part.sum().backward()
    assert logits.grad is not None
    assert logits.grad.abs().sum() > 0


def test_nothing_labelled_costs_nothing() -> None:
    logits = torch.ones(1, 3, 2, 2, requires_grad=True)
    batch = batch_of(torch.full((1, 2, 2), 255))
    part = CrossEntropy(class_weights=None)(Output(logits, {}), batch, NOTHING)["cross_entropy"]
    part.sum().backward()
    assert part.item() == 0.0
    assert logits.grad is not None
    assert not logits.grad.any()


def test_raises() -> None:
    batch = batch_of(torch.zeros(1, 2, 2, dtype=torch.long))
    plain = CrossEntropy(class_weights=None)
    with pytest.raises(ValueError, match="label"):
        plain(Output(torch.zeros(1, 3, 4, 4), {}), batch, NOTHING)
    with pytest.raises(InputError, match="2 numbers"):
        CrossEntropy(class_weights=(1.0, 2.0))(Output(torch.zeros(1, 3, 2, 2), {}), batch, NOTHING)


def test_confidences_by_hand() -> None:
    """Costs log 2, log 2, log 4 of confidence 1, 0.5, 0.25; the ignored pixel counts nowhere."""
    label = torch.tensor([[[0, 1, 1, 255]]])
    logits = torch.zeros(1, 2, 1, 4)
    logits[0, 0, 0, 2] = torch.tensor(3.0).log()  # the probability of class 1 is 1/4
    batch = replace(batch_of(label), confidence=torch.tensor([[[1.0, 0.5, 0.25, 1.0]]]))
    part = CrossEntropy(class_weights=None)(Output(logits, {}), batch, NOTHING)["cross_entropy"]
    log2 = torch.tensor(2.0).log()
    assert torch.allclose(part, (1 + 0.5 + 0.25 * 2) * log2 / 3)
    assert part.shape == (1,)
    # Class weights enter the mean that is divided by, confidences do not.
    weighted = CrossEntropy(class_weights=(2.0, 0.5))
    part = weighted(Output(logits, {}), batch, NOTHING)["cross_entropy"]
    assert torch.allclose(part, (2 * 1 + 0.5 * 0.5 + 0.5 * 0.25 * 2) * log2 / (2 + 0.5 + 0.5))


@pytest.mark.parametrize("weights", [None, (1.0, 2.0, 0.5)])
def test_full_confidence_changes_nothing(weights: Any) -> None:
    generator = seeded(3)
    label = torch.randint(0, 4, (2, 4, 5), generator=generator)
    batch = batch_of(torch.where(label == 3, 255, label))
    output = Output(torch.randn(2, 3, 4, 5, generator=generator), {})
    loss = CrossEntropy(class_weights=weights)
    sure = loss(output, replace(batch, confidence=torch.ones(2, 4, 5)), NOTHING)
    assert torch.allclose(sure["cross_entropy"], loss(output, batch, NOTHING)["cross_entropy"])


def test_gradient_is_weighted_by_the_confidence() -> None:
    logits = torch.zeros(1, 3, 1, 2, dtype=torch.float64, requires_grad=True)
    confidence = torch.tensor([[[0.25, 0.0]]])
    batch = replace(batch_of(torch.zeros(1, 1, 2, dtype=torch.long)), confidence=confidence)
    CrossEntropy(class_weights=None)(Output(logits, {}), batch, NOTHING)["cross_entropy"].backward()
    assert logits.grad is not None
    assert logits.grad[0, :, 0, 1].abs().sum() == 0
    assert logits.grad[0, :, 0, 0].tolist() == pytest.approx([-0.25 / 3, 0.125 / 3, 0.125 / 3])


def test_confidences_of_another_size_are_refused() -> None:
    batch = replace(batch_of(torch.zeros(1, 2, 2, dtype=torch.long)), confidence=torch.ones(1, 2))
    with pytest.raises(ValueError, match="confidence: expected shape B=1 x H=2 x W=2"):
        CrossEntropy(class_weights=None)(Output(torch.zeros(1, 3, 2, 2), {}), batch, NOTHING)
