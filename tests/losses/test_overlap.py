"""Dice and consistency losses: by hand, class by class, gradients, edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.losses.temporal import SIGMA, Form, con, con_acc, dice
from tests.losses.problems import seeded

FORMS: tuple[Form, ...] = ("paper", "released")
BY_FORM = pytest.mark.parametrize("form", FORMS)
LOSSES: dict[str, Callable[..., Tensor]] = {
    "dice": lambda p, q, label, form: dice(q, label, form),
    "con": lambda p, q, label, form: con(p, q, label != 255, form),
    "con_acc": con_acc,
}
BY_LOSS = pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)


def random_problem(*sizes: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Two logits (B, K, H, W) in double precision and a label without 3, a sixth of it ignored."""
    batch, classes, height, width = sizes
    generator = seeded(seed)
    first, second = torch.randn(2, *sizes, generator=generator, dtype=torch.float64)
    label = torch.randint(0, classes, (batch, height, width), generator=generator)
    ignored = torch.rand(label.shape, generator=generator) < 1 / 6
    return first, second, label.masked_fill(ignored | (label == 3), 255)


def one_hot(label: Tensor, classes: int) -> Tensor:
    return torch.stack([label == c for c in range(classes)], 1).double()


def as_printed(name: str, p: Tensor, q: Tensor, label: Tensor, form: Form) -> Tensor:
    """The equations class by class; the release's factors, clamp, mask and absent classes."""
    y, costs = one_hot(label, p.shape[1]), []
    counted = label != 255
    if form == "released" and name != "con":
        counted &= label != 0
    for c in range(p.shape[1]):
        p_c, q_c, y_c = (values[:, c][counted] for values in (p, q, y))
        if name == "con":
            size = (p_c + q_c + SIGMA * (form == "paper")).sum()
            costs.append(1 - 2 * (p_c * q_c).sum() / size.clamp(min=SIGMA))
        elif form == "released" and not y_c.any():
            costs.append(p.new_zeros(()))
        elif name == "dice":
            squared = q_c**2 if form == "paper" else q_c
            costs.append(1 - 2 * (q_c * y_c).sum() / (squared + y_c).sum())
        else:
            sigma, factor = (SIGMA, 2) if form == "paper" else (0, 3)
            costs.append(1 - factor * (p_c * q_c * y_c).sum() / (p_c + q_c + y_c + sigma).sum())
    return torch.stack(costs).mean()


def two_classes(*of_class_0: float) -> Tensor:
    """(1, 2, 2, 2) probabilities of two classes at four pixels."""
    p = torch.tensor(of_class_0).view(1, 1, 2, 2)
    return torch.cat([p, 1 - p], 1)


P, Q = two_classes(1, 0.5, 0, 0.25), two_classes(0.5, 0.5, 0.25, 1)


def test_dice_by_hand() -> None:
    # Classes down, pixels across; the fourth pixel is ignored.
    p = torch.tensor([[0.5, 0.25, 0.0, 1.0], [0.25, 0.5, 0.5, 0.0], [0.25, 0.25, 0.5, 0.0]])
    label = torch.tensor([[[0, 1], [2, 255]]])
    # Sums of squares 5/16, 9/16, 3/8; every class has one pixel, predicted with 1/2.
    paper = 1 - (1 / (21 / 16) + 1 / (25 / 16) + 1 / (11 / 8)) / 3
    # Pixels of classes 1 and 2 count: 1 - 1 / (1 + 1) and 1 - 1 / (3/4 + 1), background 0.
    released = (1 / 2 + 3 / 7 + 0) / 3
    for form, expected in (("paper", paper), ("released", released)):
        assert dice(p.view(1, 3, 2, 2), label, form).item() == pytest.approx(expected)


@BY_FORM
def test_con_by_hand(form: Form) -> None:
    # Three pixels. Class 0: products 1/2 + 1/4 + 0, sums 3/2 + 5/4; class 1: 0 + 1/4 + 3/4 and
    # 3/2 + 7/4.
    valid = torch.tensor([[[True, True], [True, False]]])
    expected = 1 - (2 * 0.75 / 2.75 + 2 * 1.0 / 3.25) / 2
    assert con(P, Q, valid, form).item() == pytest.approx(expected, abs=1e-6)


def test_con_acc_by_hand() -> None:
    label = torch.tensor([[[0, 0], [1, 255]]])
    # Three pixels. Class 0: products 1/2 + 1/4, sums 3/2 + 5/4 + 2; class 1: 3/4, 3/2 + 7/4 + 1.
    paper = 1 - (2 * 0.75 / 4.75 + 2 * 0.75 / 4.25) / 2
    # The pixel of class 1 alone: 1 - 3 * 3/4 / (1 + 3/4 + 1), halved by the background's 0.
    released = (1 - 9 / 11) / 2
    assert con_acc(P, Q, label, "paper").item() == pytest.approx(paper, abs=1e-6)
    assert con_acc(P, Q, label, "released").item() == pytest.approx(released, abs=1e-6)


def test_sigma_is_added_per_pixel_that_counts_or_a_floor() -> None:
    p = torch.full((1, 1, 2, 4), 1e-6, dtype=torch.float64)  # one class, eight pixels, three valid
    valid = torch.tensor([[[True, False, False, True], [False, True, False, False]]])
    # 2 * 3 p^2 over 3 (2 p + sigma).
    assert 1 - con(p, p, valid, "paper").item() == pytest.approx(2e-12 / 2.1e-6, abs=1e-13)
    assert 1 - con(p, p, valid, "released").item() == pytest.approx(2e-12 / 2e-6, abs=1e-13)
    faint = torch.full_like(p, 1e-9)  # 6 p^2 over sigma, not over 6 p
    assert 1 - con(faint, faint, valid, "released").item() == pytest.approx(6e-11, abs=1e-13)
    p[..., 0, 0] = 1
    label = torch.where(valid, 0, 255)
    # Three labelled pixels: products 1 + 2 p^2, sums of p, q and y 3 + 2 (2 p + 1), 3 sigma.
    expected = 1 - 2 * (1 + 2e-12) / (3 + 2 * (2e-6 + 1) + 3 * SIGMA)
    assert con_acc(p, p, label, "paper").item() == pytest.approx(expected, abs=1e-12, rel=0)


@BY_FORM
@pytest.mark.parametrize("name", LOSSES)
def test_values_equal_the_loop_over_classes(name: str, form: Form) -> None:
    first, second, label = random_problem(2, 5, 6, 7)
    p, q = first.softmax(1), second.softmax(1)
    found, expected = LOSSES[name](p, q, label, form), as_printed(name, p, q, label, form)
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)


@BY_FORM
@BY_LOSS
def test_gradients(loss: Any, form: Form) -> None:
    first, second, label = random_problem(2, 4, 2, 3)
    both = first.requires_grad_(), second.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p, q: loss(p.softmax(1), q.softmax(1), label, form), both
    )
    # The same where the first frame has none.
    q = second.detach().softmax(1).requires_grad_()
    (alone,) = torch.autograd.grad(loss(first.detach().softmax(1), q, label, form), q)
    p = first.detach().softmax(1).requires_grad_()
    assert torch.equal(torch.autograd.grad(loss(p, q, label, form), q)[0], alone)


def test_perfect_predictions() -> None:
    label = torch.tensor([[[0, 1, 2], [2, 255, 4]]])
    p, valid = one_hot(label, 9), label != 255
    assert dice(p, label, "released") == con_acc(p, p, label, "released") == 0
    # Of the nine classes four are there; each of the others costs 1.
    assert dice(p, label, "paper").item() == pytest.approx(5 / 9)
    for form in FORMS:
        assert con(p, p, valid, form).item() == pytest.approx(5 / 9, abs=1e-6)
    assert con_acc(p, p, label, "paper").item() == pytest.approx((4 / 3 + 5) / 9, abs=1e-6)
    # All wrong: background is left out as released, the absent classes cost nothing.
    wrong = one_hot(torch.full_like(label, 8), 9)
    assert dice(wrong, label, "released").item() == pytest.approx(3 / 9)
    assert dice(wrong, label, "paper") == 1


@pytest.mark.parametrize(
    ("name", "form", "label", "expected"),
    [
        *((name, "paper", 255, 1.0) for name in LOSSES),
        *((name, "released", 255, 1.0 if name == "con" else 0.0) for name in LOSSES),
        *((name, "released", 0, 0.0) for name in ("dice", "con_acc")),  # background alone
    ],
)
def test_nothing_to_compare_has_no_gradient(
    name: str, form: Form, label: int, expected: float
) -> None:
    first, second = torch.ones(2, 2, 3, 2, 2, requires_grad=True)
    both = first.softmax(1), second.softmax(1)
    found = LOSSES[name](*both, torch.full((2, 2, 2), label), form)
    assert found == expected
    gradients = torch.autograd.grad(found, (first, second), allow_unused=True)
    assert not any(each is not None and each.any() for each in gradients)
