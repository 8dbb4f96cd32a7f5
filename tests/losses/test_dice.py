from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.losses.dice import Form, dice

FORMS: tuple[Form, ...] = ("paper", "released")


def random_problem(*sizes: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Logits (B, K, H, W) in double precision and a label, a sixth of it ignored."""
    batch, classes, height, width = sizes
    generator = torch.Generator().manual_seed(seed)
    logits = torch.randn(sizes, generator=generator, dtype=torch.float64)
    label = torch.randint(0, classes, (batch, height, width), generator=generator)
    ignored = torch.rand(label.shape, generator=generator) < 1 / 6
    return logits, label.masked_fill(ignored, 255)


def one_hot(label: Tensor, classes: int) -> Tensor:
    return torch.stack([label == c for c in range(classes)], 1).double()


def as_printed(p: Tensor, label: Tensor, form: Form) -> Tensor:
    """Class by class, with the label as one-hot maps."""
    y, total = one_hot(label, p.shape[1]), p.new_zeros(())
    counted = label != 255 if form == "paper" else (label != 255) & (label != 0)
    for c in range(p.shape[1]):
        p_c, y_c = p[:, c][counted], y[:, c][counted]
        if form == "paper":
            total = total + 1 - 2 * (p_c * y_c).sum() / (p_c**2 + y_c**2).sum()
        elif y_c.any():
            total = total + 1 - 2 * (p_c * y_c).sum() / (p_c + y_c).sum()
    return total / p.shape[1]


def test_values_by_hand() -> None:
    # Classes down, pixels across; the fourth pixel is ignored.
    p = torch.tensor([[0.5, 0.25, 0.0, 1.0], [0.25, 0.5, 0.5, 0.0], [0.25, 0.25, 0.5, 0.0]])
    label = torch.tensor([[[0, 1], [2, 255]]])
    # Sums of squares 5/16, 9/16, 3/8; every class has one pixel, predicted with 1/2.
    paper = 1 - (1 / (21 / 16) + 1 / (25 / 16) + 1 / (11 / 8)) / 3
    # Pixels of classes 1 and 2 count: 1 - 1 / (1 + 1) and 1 - 1 / (3/4 + 1), background 0.
    released = (1 / 2 + 3 / 7 + 0) / 3
    for form, expected in (("paper", paper), ("released", released)):
        assert dice(p.view(1, 3, 2, 2), label, form).item() == pytest.approx(expected)


@pytest.mark.parametrize("form", FORMS)
def test_equals_the_loop_over_one_hot_maps(form: Form) -> None:
    logits, label = random_problem(2, 5, 6, 7)
    label[label == 3] = 255  # absent
    p = logits.softmax(1)
    assert torch.allclose(dice(p, label, form), as_printed(p, label, form), atol=1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_gradient(form: Form) -> None:
    logits, label = random_problem(2, 4, 2, 3)
    label[label == 3] = 255  # absent
    logits.requires_grad_()
    assert torch.autograd.gradcheck(lambda z: dice(z.softmax(1), label, form), logits)


def test_perfect_predictions() -> None:
    label = torch.tensor([[[0, 1, 2], [2, 255, 4]]])
    p = one_hot(label, 9)
    assert dice(p, label, "released") == 0
    # The absent classes cost 1 each.
    assert dice(p, label, "paper").item() == pytest.approx(5 / 9)
    # All wrong: background is left out as released, the absent classes cost nothing.
    wrong = one_hot(torch.full_like(label, 8), 9)
    assert dice(wrong, label, "released").item() == pytest.approx(3 / 9)
    assert dice(wrong, label, "paper") == 1


def test_a_class_without_a_pixel_moves_nothing() -> None:
    label = torch.tensor([[[1, 1]]])
    p = torch.tensor([[0.0, 0.0], [0.5, 0.5], [0.5, 0.5]]).view(1, 3, 1, 2).requires_grad_()
    dice(p, label, "paper").backward()
    assert p.grad is not None
    assert not p.grad[:, [0, 2]].any()
    assert (p.grad[:, 1] < 0).all()


@pytest.mark.parametrize(
    ("label", "expected"),
    [(255, {"paper": 1, "released": 0}), (0, {"paper": None, "released": 0})],
    ids=["nothing labelled", "background alone"],
)
def test_nothing_to_compare(label: int, expected: dict[Form, Any]) -> None:
    for form, value in expected.items():
        logits = torch.ones(2, 3, 2, 2, requires_grad=True)
        found = dice(logits.softmax(1), torch.full((2, 2, 2), label), form)
        found.backward()
        assert logits.grad is not None
        assert logits.grad.isfinite().all()
        if value is None:  # (1 - 2/3 / (1/9 + 1)) for background, 1 for the others
            assert found.item() == pytest.approx((1 - 0.6 + 2) / 3)
        else:
            assert found == value
            assert not logits.grad.any()


@pytest.mark.parametrize("form", FORMS)
def test_half_precision_is_summed_in_float32(form: Form) -> None:
    logits, label = random_problem(1, 3, 64, 64)
    half = logits.bfloat16().softmax(1)
    with torch.autocast("cpu", torch.bfloat16):
        found = dice(half, label, form)
    assert found.dtype == torch.float32
    assert found == dice(half.float(), label, form)


def test_raises() -> None:
    p = torch.ones(1, 3, 2, 2)
    with pytest.raises(ValueError, match="probabilities"):
        dice(p[0], torch.zeros(1, 2, 2, dtype=torch.long), "paper")
    with pytest.raises(ValueError, match="label"):
        dice(p, torch.zeros(1, 2, 3, dtype=torch.long), "paper")
