from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rgbt.losses.consistency import con, con_acc
from rgbt.losses.dice import Form

FORMS: tuple[Form, ...] = ("paper", "released")
SIGMA = 1e-7


def random_problem(*sizes: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Two logits (B, K, H, W) in double precision and a label, a sixth of it ignored."""
    batch, classes, height, width = sizes
    generator = torch.Generator().manual_seed(seed)
    first, second = torch.randn(2, *sizes, generator=generator, dtype=torch.float64)
    label = torch.randint(0, classes, (batch, height, width), generator=generator)
    ignored = torch.rand(label.shape, generator=generator) < 1 / 6
    return first, second, label.masked_fill(ignored, 255)


def one_hot(label: Tensor, classes: int) -> Tensor:
    return torch.stack([label == c for c in range(classes)], 1).double()


def con_as_printed(p: Tensor, q: Tensor, valid: Tensor, form: Form) -> Tensor:
    """Equation 2, class by class; the release's clamp."""
    score = p.new_zeros(())
    for c in range(p.shape[1]):
        p_c, q_c = p[:, c][valid], q[:, c][valid]
        size = (p_c + q_c + SIGMA * (form == "paper")).sum()
        score = score + 2 * (p_c * q_c).sum() / torch.clamp(size, min=SIGMA)
    return 1 - score / p.shape[1]


def con_acc_as_printed(p: Tensor, q: Tensor, label: Tensor, form: Form) -> Tensor:
    """Equation 3, class by class; the release's factor, mask and absent classes."""
    y, cost = one_hot(label, p.shape[1]), p.new_zeros(())
    counted = label != 255 if form == "paper" else (label != 255) & (label != 0)
    for c in range(p.shape[1]):
        p_c, q_c, y_c = (values[:, c][counted] for values in (p, q, y))
        if form == "paper":
            cost = cost + 1 - 2 * (p_c * q_c * y_c).sum() / (p_c + q_c + y_c + SIGMA).sum()
        elif y_c.any():
            cost = cost + 1 - 3 * (p_c * q_c * y_c).sum() / (p_c + q_c + y_c).sum()
    return cost / p.shape[1]


def two_classes(*of_class_0: float) -> Tensor:
    """(1, 2, 2, 2) probabilities of two classes at four pixels."""
    p = torch.tensor(of_class_0).view(1, 1, 2, 2)
    return torch.cat([p, 1 - p], 1)


P, Q = two_classes(1, 0.5, 0, 0.25), two_classes(0.5, 0.5, 0.25, 1)


@pytest.mark.parametrize("form", FORMS)
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


def test_sigma_is_added_per_pixel_as_printed_and_a_floor_as_released() -> None:
    valid = torch.ones(1, 1, 2, dtype=torch.bool)

    def score(probability: float, form: Form) -> float:
        p = torch.full((1, 1, 1, 2), probability, dtype=torch.float64)  # one class, two pixels
        return 1 - con(p, p, valid, form).item()

    # Twice the products are 4 p^2, the sums 4 p.
    assert score(1e-7, "paper") == pytest.approx(4e-14 / 6e-7, abs=1e-12)
    assert score(1e-7, "released") == pytest.approx(4e-14 / 4e-7, abs=1e-12)
    assert score(1e-9, "released") == pytest.approx(4e-18 / 1e-7, abs=1e-12)


def test_sigma_counts_the_pixels_that_count_and_no_others() -> None:
    p = torch.full((1, 1, 2, 4), 1e-6, dtype=torch.float64)  # one class, eight pixels, three valid
    valid = torch.tensor([[[True, False, False, True], [False, True, False, False]]])
    # 2 * 3 p^2 over 3 (2 p + sigma).
    assert 1 - con(p, p, valid, "paper").item() == pytest.approx(2e-12 / 2.1e-6, abs=1e-13)
    assert 1 - con(p, p, valid, "released").item() == pytest.approx(2e-12 / 2e-6, abs=1e-13)


def test_sigma_of_con_acc_is_added_at_every_labelled_pixel() -> None:
    p = torch.full((1, 1, 2, 4), 1e-6, dtype=torch.float64)
    p[..., 0, 0] = 1
    label = torch.tensor([[[0, 255, 255, 0], [255, 0, 255, 255]]])
    # Three labelled pixels: products 1 + 2 p^2, sums of p, q and y 3 + 2 (2 p + 1), 3 sigma.
    expected = 1 - 2 * (1 + 2e-12) / (3 + 2 * (2e-6 + 1) + 3 * SIGMA)
    assert con_acc(p, p, label, "paper").item() == pytest.approx(expected, abs=1e-12, rel=0)


@pytest.mark.parametrize("form", FORMS)
def test_equal_the_loops_over_classes(form: Form) -> None:
    first, second, label = random_problem(2, 5, 6, 7)
    label[label == 3] = 255  # absent
    p, q = first.softmax(1), second.softmax(1)
    valid = torch.rand(label.shape, generator=torch.Generator().manual_seed(1)) < 0.7
    found, expected = con(p, q, valid, form), con_as_printed(p, q, valid, form)
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)
    found, expected = con_acc(p, q, label, form), con_acc_as_printed(p, q, label, form)
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("form", FORMS)
def test_gradients(form: Form) -> None:
    first, second, label = random_problem(2, 4, 2, 3)
    label[label == 3] = 255  # absent
    both = first.requires_grad_(), second.requires_grad_()
    valid = label != 1
    for loss, counted in ((con, valid), (con_acc, label)):
        assert torch.autograd.gradcheck(
            lambda p, q, loss=loss, counted=counted: loss(
                p.softmax(1), q.softmax(1), counted, form
            ),
            both,
        )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("loss", [con, con_acc])
def test_a_first_frame_without_gradient(loss: object, form: Form) -> None:
    assert callable(loss)
    first, second, label = random_problem(1, 3, 4, 4)
    counted = label != 1 if loss is con else label
    p, q = first.softmax(1), second.softmax(1).requires_grad_()
    loss(p, q, counted, form).backward()
    assert q.grad is not None
    with_both = p.clone().requires_grad_(), q.detach().clone().requires_grad_()
    loss(*with_both, counted, form).backward()
    assert torch.equal(q.grad, with_both[1].grad)


def test_perfect_agreement() -> None:
    label = torch.tensor([[[0, 1, 2], [2, 0, 4]]])
    p, valid = one_hot(label, 9), torch.ones_like(label, dtype=torch.bool)
    assert con_acc(p, p, label, "released") == 0
    # Of the nine classes four are there; each of the others costs 1.
    for form in FORMS:
        assert con(p, p, valid, form).item() == pytest.approx(5 / 9, abs=1e-6)
    assert con_acc(p, p, label, "paper").item() == pytest.approx((4 / 3 + 5) / 9, abs=1e-6)
    # Without absent classes nothing is left of con; of con_acc as printed, a third.
    label = label[:, :, :2] % 2
    p, valid = one_hot(label, 2), valid[:, :, :2]
    for form in FORMS:
        assert con(p, p, valid, form).item() == pytest.approx(0, abs=1e-6)
    assert con_acc(p, p, label, "paper").item() == pytest.approx(1 / 3, abs=1e-6)


def test_con_acc_as_printed_never_lies_below_a_third() -> None:
    for seed in range(20):
        first, second, label = random_problem(1, 3, 4, 4, seed=seed)
        for sharpness in (0, 1, 100):
            near = 10 * sharpness * one_hot(label, 3)
            p, q = (sharpness * first + near).softmax(1), (sharpness * second + near).softmax(1)
            assert con_acc(p, q, label, "paper") > 1 / 3


def test_agreement_in_doubt_costs_more_than_agreement_without() -> None:
    valid = torch.ones(1, 2, 2, dtype=torch.bool)
    sure, unsure = two_classes(0, 1, 0, 1), two_classes(0.25, 0.75, 0.25, 0.75)
    # 1 - sum p^2 / sum p.
    assert con(unsure, unsure, valid, "released").item() == pytest.approx(1 - 5 / 8)
    assert con(sure, sure, valid, "released") == 0


@pytest.mark.parametrize("form", FORMS)
def test_nothing_to_compare(form: Form) -> None:
    nothing = 1.0 if form == "paper" else 0.0
    for loss, counted, expected in (
        (con, torch.zeros(2, 2, 2, dtype=torch.bool), 1.0),
        (con_acc, torch.full((2, 2, 2), 255), nothing),
    ):
        first, second = torch.ones(2, 2, 3, 2, 2, requires_grad=True)
        gradients = torch.autograd.grad(
            found := loss(first.softmax(1), second.softmax(1), counted, form), (first, second)
        )
        assert found == expected
        assert not any(gradient.any() for gradient in gradients)


def test_background_alone() -> None:
    label = torch.zeros(1, 2, 2, dtype=torch.long)
    logits = torch.ones(1, 2, 2, 2, requires_grad=True)
    found = con_acc(P, logits.softmax(1), label, "released")
    found.backward()
    assert found == 0
    assert logits.grad is not None
    assert not logits.grad.any()
    # As printed it is a class like the others: products with y 7/4 / 2, sums 7/4 + 2 + 4.
    paper = con_acc(P, torch.full_like(P, 0.5), label, "paper").item()
    assert paper == pytest.approx(1 - 2 * 0.875 / 7.75 / 2)


@pytest.mark.parametrize("form", FORMS)
def test_half_precision_is_summed_in_float32(form: Form) -> None:
    first, second, label = random_problem(1, 3, 64, 64)
    p, q, valid = first.bfloat16().softmax(1), second.bfloat16().softmax(1), label != 255
    with torch.autocast("cpu", torch.bfloat16):
        found = con(p, q, valid, form), con_acc(p, q, label, form)
    assert found[0].dtype == found[1].dtype == torch.float32
    assert found[0] == con(p.float(), q.float(), valid, form)
    assert found[1] == con_acc(p.float(), q.float(), label, form)


def test_raises() -> None:
    valid, label = torch.ones(1, 2, 2, dtype=torch.bool), torch.zeros(1, 2, 2, dtype=torch.long)
    with pytest.raises(ValueError, match="second"):
        con(P, Q[0], valid, "paper")
    with pytest.raises(ValueError, match="warped"):
        con_acc(P[:, :1], Q, label, "paper")
    with pytest.raises(ValueError, match="valid"):
        con(P, Q, valid[:, :1], "paper")
    with pytest.raises(ValueError, match="label"):
        con_acc(P, Q, label[:, :1], "paper")
