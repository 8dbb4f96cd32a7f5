"""Verdicts and what is judged: values by hand, gradients, edges of the range."""

from __future__ import annotations

import math
from typing import get_args

import pytest
import torch

from rgbt.losses.adversarial import Judged, cross_entropy, judged, least_squares
from tests.losses.problems import seeded


def test_least_squares_by_hand() -> None:
    verdicts = torch.tensor([[[[2.0, -1.0], [0.0, 1.0]]]])
    assert least_squares(verdicts, 1).item() == (1 + 4 + 1 + 0) / 4
    assert least_squares(verdicts, 0).item() == (4 + 1 + 0 + 1) / 4
    assert least_squares(verdicts, 1).shape == ()


def test_cross_entropy_by_hand() -> None:
    verdicts = torch.tensor([[[[0.0, math.log(3)]]]])  # logistic function: 1/2 and 3/4
    assert cross_entropy(verdicts, 1).item() == pytest.approx((math.log(2) + math.log(4 / 3)) / 2)
    assert cross_entropy(verdicts, 0).item() == pytest.approx((math.log(2) + math.log(4)) / 2)
    assert cross_entropy(verdicts, 0.5).item() == pytest.approx(
        (math.log(2) + math.log(4) / 2 + math.log(4 / 3) / 2) / 2
    )


@pytest.mark.parametrize("loss", [least_squares, cross_entropy])
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_gradients_of_verdicts(loss, value: float) -> None:  # noqa: ANN001
    generator = seeded(0)
    verdicts = torch.randn(2, 1, 3, 2, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: loss(d, value), (verdicts,))


def test_large_verdicts_cost_finite_values() -> None:
    verdicts = torch.tensor([3e4, -3e4]).half().requires_grad_()
    for loss in (least_squares, cross_entropy):
        for value in (0, 1):
            found = loss(verdicts, value)
            assert found.dtype == torch.float32
            assert found.isfinite()
    assert cross_entropy(torch.tensor([1e4]), 0).item() == 1e4
    assert cross_entropy(torch.tensor([1e4]), 1).item() == 0


def test_what_is_judged_by_hand() -> None:
    logits = torch.tensor([0.7, 0.2, 0.1]).log().view(1, 3, 1, 1) + 5
    assert torch.equal(judged(logits, "logits"), logits)
    assert judged(logits, "probabilities").flatten().tolist() == pytest.approx([0.7, 0.2, 0.1])
    found = judged(logits, "self_information").flatten().tolist()
    expected = [-p * math.log2(p) / math.log2(3) for p in (0.7, 0.2, 0.1)]
    assert found == pytest.approx(expected, rel=1e-5)
    assert sum(found) == pytest.approx(0.729847, abs=1e-6)


@pytest.mark.parametrize("how", get_args(Judged))
def test_gradients_of_what_is_judged(how: Judged) -> None:
    generator = seeded(2)
    logits = torch.randn(2, 3, 2, 2, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: judged(s, how), (logits,))


@pytest.mark.parametrize("how", get_args(Judged))
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_large_scores_are_judged_with_finite_gradients(how: Judged, dtype: torch.dtype) -> None:
    logits = torch.tensor([1e5, -1e5, 0.0]).to(dtype).view(1, 3, 1, 1).requires_grad_()
    found = judged(logits, how)
    assert found.dtype == torch.float32
    assert found.isfinite().all()
    least_squares(found, 0.5).backward()
    assert logits.grad is not None
    assert logits.grad.isfinite().all()
    if how != "logits":
        assert found.min() >= 0
        assert found.max() <= 1


def test_scores_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="logits: expected shape"):
        judged(torch.zeros(3, 2, 2), "logits")


def test_one_class_is_judged_without_dividing_by_nothing() -> None:
    logits = torch.randn(2, 1, 3, 5, generator=seeded(0))
    assert torch.equal(judged(logits, "self_information"), torch.zeros(2, 1, 3, 5))
    assert torch.equal(judged(logits, "probabilities"), torch.ones(2, 1, 3, 5))
