from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.losses.cross_entropy import CrossEntropy, WithAuxiliary
from rgbt.requirements import Record, check_requirements
from rgbt.types import Output
from tests.losses.problems import NOTHING, batch_of, seeded
from tests.models.golden import compose


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


def test_class_weights_of_another_number_are_refused() -> None:
    records = {"dataset": SimpleNamespace(record=Record(num_classes=3))}
    check_requirements({**records, "loss": CrossEntropy(class_weights=(1.0, 2.0, 3.0))})
    with pytest.raises(InputError, match=r"loss.class_weights=\[1.0, 2.0\] requires num_classes=2"):
        check_requirements({**records, "loss": CrossEntropy(class_weights=(1.0, 2.0))})


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


def test_gradient_is_weighted_by_the_confidence() -> None:
    logits = torch.zeros(1, 3, 1, 2, dtype=torch.float64, requires_grad=True)
    confidence = torch.tensor([[[0.25, 0.0]]])
    batch = replace(batch_of(torch.zeros(1, 1, 2, dtype=torch.long)), confidence=confidence)
    CrossEntropy(class_weights=None)(Output(logits, {}), batch, NOTHING)["cross_entropy"].backward()
    assert logits.grad is not None
    assert logits.grad[0, :, 0, 1].abs().sum() == 0
    assert logits.grad[0, :, 0, 0].tolist() == pytest.approx([-0.25 / 3, 0.125 / 3, 0.125 / 3])


def with_auxiliary(weight: float = 0.1) -> WithAuxiliary:
    return WithAuxiliary(loss=CrossEntropy(class_weights=None), weight=weight)


def test_auxiliary_value_by_hand() -> None:
    """Scores for class 1 of (0, 0) and (0, log 3): log 2, and a tenth of log 4/3."""
    output = Output(
        torch.zeros(1, 2, 1, 1),
        {"aux_logits": torch.tensor([0.0, math.log(3)]).view(1, 2, 1, 1), "other": torch.ones(1)},
    )
    batch = batch_of(torch.ones(1, 1, 1, dtype=torch.long))
    parts = with_auxiliary()(output, batch, NOTHING)
    assert list(parts) == ["cross_entropy", "cross_entropy_aux"]
    assert parts["cross_entropy"].item() == pytest.approx(math.log(2))
    assert parts["cross_entropy_aux"].item() == pytest.approx(0.1 * math.log(4 / 3))
    assert all(part.shape == (1,) for part in parts.values())


def test_record_weighs_confidence_where_its_loss_does() -> None:
    assert with_auxiliary().record.weighs_confidence is True
    assert WithAuxiliary(loss=lambda *_: {}, weight=0.1).record.weighs_confidence is False
    assert build(compose("loss=cross_entropy_auxiliary").loss).record.weighs_confidence is True
    # And weighs by it, in both: a half of log 2.
    label = torch.zeros(1, 1, 1, dtype=torch.long)
    batch = replace(batch_of(label), confidence=torch.full((1, 1, 1), 0.5))
    scores = torch.zeros(1, 2, 1, 1)
    parts = with_auxiliary()(Output(scores, {"aux_logits": scores}), batch, NOTHING)
    assert parts["cross_entropy"].item() == pytest.approx(math.log(2) / 2)
    assert parts["cross_entropy_aux"].item() == pytest.approx(0.1 * math.log(2) / 2)
