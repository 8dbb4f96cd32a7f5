"""The loss of both score maps of a network with an auxiliary head."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from rgbt.config.component import build
from rgbt.losses.auxiliary import WithAuxiliary
from rgbt.losses.cross_entropy import CrossEntropy
from rgbt.requirements import Requirement
from rgbt.types import Output
from tests.losses.problems import NOTHING, batch_of
from tests.models.golden import compose


def with_auxiliary(weight: float = 0.1) -> WithAuxiliary:
    return WithAuxiliary(loss=CrossEntropy(class_weights=None), weight=weight)


def test_value_by_hand() -> None:
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


def test_both_heads_get_a_gradient() -> None:
    main, aux = (torch.zeros(1, 3, 2, 2, requires_grad=True) for _ in range(2))
    batch = batch_of(torch.zeros(1, 2, 2, dtype=torch.long))
    parts = with_auxiliary(0.25)(Output(main, {"aux_logits": aux}), batch, NOTHING)
    torch.stack(list(parts.values())).sum().backward()
    assert main.grad is not None
    assert aux.grad is not None
    assert torch.allclose(aux.grad, 0.25 * main.grad)
    assert main.grad.abs().sum() > 0


def test_record_requires_scores_of_both_heads() -> None:
    assert with_auxiliary().record.requires == (
        Requirement("model", "outputs", "scores"),
        Requirement("model", "auxiliary", True),
    )


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
