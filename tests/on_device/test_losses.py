"""Losses and their gradients on the device: those of the CPU, at the same points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rgbt.losses.cross_entropy import CrossEntropy
from rgbt.losses.distances import sdc
from rgbt.losses.points import Points
from rgbt.losses.set_criterion import targets_of
from rgbt.losses.spatial import PLAIN
from rgbt.losses.temporal import con, con_acc, dice
from rgbt.losses.unlabelled import VERDICT_LOSSES, Entropy, MaxSquares, guidance, judged
from rgbt.types import Batch, Output
from tests.losses.problems import batch_of, criterion_of, problem_of, seeded
from tests.on_device.places import ON_DEVICE, device, exact

__all__ = ["exact"]  # a fixture

pytestmark = [*ON_DEVICE, pytest.mark.usefixtures("exact")]
CPU = torch.device("cpu")
CLASSES = 5
CLOSE = {"rtol": 1e-5, "atol": 1e-6}


def placed(batch: Batch, to: torch.device) -> Batch:
    """The batch with its images as they are."""
    tensors = {k: v.to(to) for k, v in vars(batch).items() if isinstance(v, Tensor)}
    return replace(batch, **tensors)


def maps(seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Two maps of scores, a label with ignored pixels, and which pixels count."""
    generator = seeded(seed)
    one, other = (torch.randn(2, CLASSES, 20, 30, generator=generator) for _ in range(2))
    label = torch.randint(0, CLASSES + 1, (2, 20, 30), generator=generator)
    valid = torch.rand(2, 20, 30, generator=generator) < 0.9
    return one, other, label.where(label < CLASSES, 255), valid


def assert_same_with_gradient(loss: Callable[..., Tensor], *inputs: Tensor) -> None:
    """The value and the gradients of floating inputs are those of the CPU."""
    found = []
    for to in (CPU, device()):
        moved = [each.detach().to(to) for each in inputs]
        leaves = [each.requires_grad_() for each in moved if each.is_floating_point()]
        value = loss(*moved)
        assert value.device.type == to.type
        gradients = torch.autograd.grad(value, leaves, allow_unused=True)
        found.append([value.detach(), *(each for each in gradients if each is not None)])
    assert len(found[0]) == len(found[1]) > 1
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(other.cpu(), one, **CLOSE)


SPATIAL: dict[str, dict[str, Any]] = {
    "plain": {},
    "weighted": {"alpha": 2.0, "focus": "edge", "match": "weighted", "passes": "fused"},
    "crop": {"alpha": 1.0, "focus": "center", "centre": "crop", "d_max": "crop"},
}


@pytest.mark.parametrize("name", SPATIAL)
def test_set_criterion(name: str) -> None:
    criterion = criterion_of(spatial=replace(PLAIN, **SPATIAL[name]))
    output, batch = problem_of(2, 4, 2)
    names = list(output.aux)

    def loss(*tensors: Tensor) -> Tensor:
        to = tensors[0].device
        aux = dict(zip(names, tensors, strict=True))
        parts = criterion.compare(
            Output(None, aux), placed(batch, to), Points(seeded(1), device=to)
        )
        return torch.stack(list(parts.values())).sum()

    assert_same_with_gradient(loss, *output.aux.values())


def test_matches() -> None:
    output, batch = problem_of(2, 3, 2)
    criterion = criterion_of()
    found = []
    for to in (CPU, device()):
        label = batch.label.to(to)
        targets = targets_of(label, (24, 32), CLASSES, None)
        logits = (each.detach().to(to) for each in output.aux.values())
        found.append(criterion.match(*logits, targets, Points(seeded(2), device=to)))
    for one, other in zip(*found, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("weights", [None, (1.0, 2.0, 0.5, 3.0, 1.0)])
@pytest.mark.parametrize("confident", [False, True])
def test_cross_entropy(weights: tuple[float, ...] | None, confident: bool) -> None:
    scores, _, label, _ = maps()
    confidence = torch.rand(label.shape, generator=seeded(3)) if confident else None
    batch = replace(batch_of(label), confidence=confidence)
    cost = CrossEntropy(class_weights=weights)

    def loss(logits: Tensor) -> Tensor:
        to = logits.device
        return cost(Output(logits, {}), placed(batch, to), torch.Generator(device=to))[
            "cross_entropy"
        ].sum()

    assert_same_with_gradient(loss, scores)


@pytest.mark.parametrize("form", ["paper", "released"])
def test_overlaps(form: Any) -> None:
    one, other, label, valid = maps()
    assert_same_with_gradient(lambda p, y: dice(p.softmax(1), y, form), one, label)
    assert_same_with_gradient(
        lambda p, q, v: con(p.softmax(1), q.softmax(1), v, form), one, other, valid
    )
    assert_same_with_gradient(
        lambda p, q, y: con_acc(p.softmax(1), q.softmax(1), y, form), one, other, label
    )


@pytest.mark.parametrize("ratio", [None, 0.2])
def test_losses_without_labels(ratio: float | None) -> None:
    scores, other, _, _ = maps()
    squares = MaxSquares(weight=0.1, normalisation="entries", image_wise_ratio=ratio)
    for cost in (squares, Entropy(weight=0.5)):
        assert_same_with_gradient(lambda s, c=cost: sum(c(s.softmax(1)).values()), scores)
    labels = [
        guidance(*(3 * each.to(to)).softmax(1).split(1), 0.6).cpu()
        for to in (CPU, device())
        for each in (scores,)
    ]
    assert torch.equal(*labels)
    assert_same_with_gradient(lambda a, b: sdc(a.flatten(2).mT, b.flatten(2).mT), scores, other)


@pytest.mark.parametrize("how", ["probabilities", "logits", "self_information"])
@pytest.mark.parametrize("verdict", VERDICT_LOSSES)
def test_adversarial_losses(how: Any, verdict: str) -> None:
    scores, *_ = maps()
    assert_same_with_gradient(lambda s: VERDICT_LOSSES[verdict](judged(s, how), 1.0), scores)
