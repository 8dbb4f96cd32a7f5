from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.losses.cross_entropy import CrossEntropy
from rgbt.types import Output

NOTHING = torch.Generator()


def test_value_by_hand(make_batch: Any) -> None:
    # Two pixels with scores (0, 0): log 2 each; the ignored one counts nowhere.
    batch = make_batch(torch.tensor([[[0, 1, 255]]]))
    logits = torch.tensor([[[[0.0, 0.0, 9.0]], [[0.0, 0.0, -9.0]]]])
    part = CrossEntropy(class_weights=None)(Output(logits, {}), batch, NOTHING)["cross_entropy"]
    assert part.shape == (1,)
    assert torch.allclose(part, torch.tensor([2.0]).log())


def test_class_weights(make_batch: Any) -> None:
    generator = torch.Generator().manual_seed(0)
    label = torch.randint(0, 3, (2, 4, 5), generator=generator)
    logits = torch.randn(2, 3, 4, 5, generator=generator).requires_grad_()
    loss = CrossEntropy(class_weights=(1.0, 2.0, 0.5))
    part = loss(Output(logits, {}), make_batch(label), NOTHING)["cross_entropy"]
    expected = F.cross_entropy(logits, label, torch.tensor([1.0, 2.0, 0.5]), ignore_index=255)
    assert torch.allclose(part, expected)
    part.sum().backward()
    assert logits.grad is not None
    assert logits.grad.abs().sum() > 0


def test_nothing_labelled_costs_nothing(make_batch: Any) -> None:
    logits = torch.ones(1, 3, 2, 2, requires_grad=True)
    batch = make_batch(torch.full((1, 2, 2), 255))
    part = CrossEntropy(class_weights=None)(Output(logits, {}), batch, NOTHING)["cross_entropy"]
    part.sum().backward()
    assert part.item() == 0.0
    assert logits.grad is not None
    assert not logits.grad.any()


def test_raises(make_batch: Any) -> None:
    batch = make_batch(torch.zeros(1, 2, 2, dtype=torch.long))
    plain = CrossEntropy(class_weights=None)
    with pytest.raises(InputError, match="set_criterion"):
        plain(Output(None, {}), batch, NOTHING)
    with pytest.raises(ValueError, match="label"):
        plain(Output(torch.zeros(1, 3, 4, 4), {}), batch, NOTHING)
    with pytest.raises(InputError, match="2 numbers"):
        CrossEntropy(class_weights=(1.0, 2.0))(Output(torch.zeros(1, 3, 2, 2), {}), batch, NOTHING)
    for wrong in [(), (1.0, -1.0)]:
        with pytest.raises(InputError, match="at least 0"):
            CrossEntropy(class_weights=wrong)
