from __future__ import annotations

import math
from typing import Any

import torch

from rgbt.losses import masks, matcher
from rgbt.losses.masks import mask_and_dice
from rgbt.losses.points import Points
from rgbt.losses.spatial import PointWeights
from tests.losses.problems import criterion_of, problem_of, seeded


def test_plain_losses_by_hand() -> None:
    # s = 1/2 and 3/4 against t = 1 and 0: BCE = (log 2 + log 4) / 2,
    # dice = 1 - (2 * 1/2 + 1) / (5/4 + 1 + 1) = 1 - 8/13.
    x, t = torch.tensor([[0.0, math.log(3)]]), torch.tensor([[1.0, 0.0]])
    bce, dice = mask_and_dice(x, t, None)
    assert torch.allclose(bce, torch.tensor([1.5 * math.log(2)]))
    assert torch.allclose(dice, torch.tensor([5 / 13]))


def test_weighted_losses_by_hand() -> None:
    # The same with weights 1 and 3, divided by two points: BCE = (log 2 + 3 log 4) / 2;
    # dice without smoothing = 1 - (2 * 1/2) / (1/2 + 9/4 + 1) = 1 - 4/15.
    x, t = torch.tensor([[0.0, math.log(3)]]), torch.tensor([[1.0, 0.0]])
    w = PointWeights(torch.tensor([[1.0, 3.0]]), torch.tensor([2.0]), torch.tensor([0.0]))
    bce, dice = mask_and_dice(x, t, w)
    assert torch.allclose(bce, torch.tensor([3.5 * math.log(2)]))
    assert torch.allclose(dice, torch.tensor([11 / 15]))


def test_large_logits_stay_finite() -> None:
    x = torch.tensor([[200.0, -200.0]], requires_grad=True)
    bce, dice = mask_and_dice(x, torch.tensor([[0.0, 1.0]]), None)
    assert bce.item() == 200.0
    (bce + dice).sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()


def test_gradients() -> None:
    generator = seeded(0)
    x = torch.randn(3, 6, dtype=torch.float64, generator=generator, requires_grad=True)
    t = torch.rand(3, 6, dtype=torch.float64, generator=generator)
    w = PointWeights(1 + t, (1 + t).sum(-1), torch.zeros(3, dtype=torch.float64))
    assert torch.autograd.gradcheck(lambda x: mask_and_dice(x, t, None), x)
    assert torch.autograd.gradcheck(lambda x: mask_and_dice(x, t, w), x)


def test_losses_do_not_depend_on_the_chunks(monkeypatch: Any) -> None:
    output, batch = problem_of(3, 4, 2)
    criterion = criterion_of()

    def losses() -> torch.Tensor:
        points = Points(seeded(0), device=torch.device("cpu"))
        return torch.stack(list(criterion.compare(output, batch, points).values()))

    whole = losses()
    for module in (masks, matcher):
        monkeypatch.setattr(module, "CHUNK_BYTES", 1)
    assert torch.allclose(whole, losses(), rtol=1e-6)
