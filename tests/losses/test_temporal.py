"""The loss of two frames and its soft overlaps: by hand, class by class, against the release."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.geometry.warp import halved_label
from rgbt.losses.cross_entropy import CrossEntropy
from rgbt.losses.temporal import SIGMA, Form, TemporalLoss, con, con_acc, dice
from rgbt.types import Frame, Output
from tests.losses.problems import (
    NOTHING,
    batch_of,
    recorded_losses,
    seeded,
)
from tests.models.golden import requires_golden

# ---- overlaps ----
FORMS: tuple[Form, ...] = ("paper", "released")
BY_FORM = pytest.mark.parametrize("form", FORMS)
OVERLAPS: dict[str, Callable[..., Tensor]] = {
    "dice": lambda p, q, label, form: dice(q, label, form),
    "con": lambda p, q, label, form: con(p, q, label != 255, form),
    "con_acc": con_acc,
}
BY_LOSS = pytest.mark.parametrize("loss", OVERLAPS.values(), ids=OVERLAPS)


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


def test_con_acc_by_hand() -> None:
    label = torch.tensor([[[0, 0], [1, 255]]])
    # Three pixels. Class 0: products 1/2 + 1/4, sums 3/2 + 5/4 + 2; class 1: 3/4, 3/2 + 7/4 + 1.
    paper = 1 - (2 * 0.75 / 4.75 + 2 * 0.75 / 4.25) / 2
    # The pixel of class 1 alone: 1 - 3 * 3/4 / (1 + 3/4 + 1), halved by the background's 0.
    released = (1 - 9 / 11) / 2
    assert con_acc(P, Q, label, "paper").item() == pytest.approx(paper, abs=1e-6)
    assert con_acc(P, Q, label, "released").item() == pytest.approx(released, abs=1e-6)


def test_sigma_is_added_per_counted_pixel_or_a_floor() -> None:
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
@pytest.mark.parametrize("name", OVERLAPS)
def test_values_equal_the_loop_over_classes(name: str, form: Form) -> None:
    first, second, label = random_problem(2, 5, 6, 7)
    p, q = first.softmax(1), second.softmax(1)
    found, expected = OVERLAPS[name](p, q, label, form), as_printed(name, p, q, label, form)
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


@pytest.mark.parametrize(
    ("name", "form", "label", "expected"),
    [
        *((name, "paper", 255, 1.0) for name in OVERLAPS),
        *((name, "released", 255, 1.0 if name == "con" else 0.0) for name in OVERLAPS),
        *((name, "released", 0, 0.0) for name in ("dice", "con_acc")),  # background alone
    ],
)
def test_nothing_to_compare_has_no_gradient(
    name: str, form: Form, label: int, expected: float
) -> None:
    first, second = torch.ones(2, 2, 3, 2, 2, requires_grad=True)
    both = first.softmax(1), second.softmax(1)
    found = OVERLAPS[name](*both, torch.full((2, 2, 2), label), form)
    assert found == expected
    gradients = torch.autograd.grad(found, (first, second), allow_unused=True)
    assert not any(gradient is not None and gradient.any() for gradient in gradients)


# ---- two frames ----


def loss_of(**changes: Any) -> TemporalLoss:
    settings: dict[str, Any] = {
        "segmentation": CrossEntropy(class_weights=None),
        "alpha": 1.0,
        "beta": 1.0,
        "second": "con",
        "form": "paper",
    }
    return TemporalLoss(**(settings | changes))


@pytest.fixture
def frames() -> tuple[Frame, Frame, Tensor, Tensor]:
    """Two frames of two images and four classes, the first as the second sees it, what it sees."""
    generator = seeded(0)
    logits = torch.randn(3, 2, 4, 6, 7, generator=generator)
    labels = torch.randint(0, 4, (2, 2, 6, 7), generator=generator)
    labels[:, 0, 0] = 255

    def frame(i: int) -> Frame:
        scores = logits[i].clone().requires_grad_()
        return Frame(Output(scores, {}), batch_of(labels[i]), scores)

    valid = torch.rand(2, 6, 7, generator=generator) < 0.8
    return frame(0), frame(1), logits[2].softmax(1), valid


@pytest.mark.parametrize("form", ["paper", "released"])
def test_values(form: Any, frames: Any) -> None:
    first, second, warped, valid = frames
    p1, p2 = first.logits.softmax(1), second.logits.softmax(1)
    label = second.batch.label.masked_fill(~valid, 255)  # what frame 1 does not show
    expected = {
        "dice": dice(p2, second.batch.label, form),
        "con": con(warped, p2, valid, form),
        "con_acc": con_acc(warped, p2, label, form),
    }
    for name, value in expected.items():
        loss = loss_of(alpha=0.5, beta=2.0, second=name, form=form)
        parts = loss(first, second, warped, valid, NOTHING)
        assert torch.equal(parts["dice_2" if name == "dice" else name], 2 * value)
        assert torch.equal(parts["dice_1"], 0.5 * dice(p1, first.batch.label, form))
        for number, frame in ((1, first), (2, second)):
            seg = F.cross_entropy(frame.logits, frame.batch.label, ignore_index=255)
            assert torch.allclose(parts[f"cross_entropy_{number}"], seg)


def test_losses_of_weight_0_are_neither_computed_nor_required(frames: Any) -> None:
    """Without alpha no dice_1, without beta no second loss: only dice needs a background."""
    segmentation = {"cross_entropy_1", "cross_entropy_2"}
    for changes, own, needs in (
        ({"alpha": 0.0, "second": "con"}, {"con"}, 1),
        ({"beta": 0.0, "second": "none"}, {"dice_1"}, 2),
    ):
        loss = loss_of(form="released", **changes)
        assert loss(*frames, NOTHING).keys() == segmentation | own
        assert len(loss.record.requires) == len(loss_of().record.requires) - 1 + needs


@pytest.mark.parametrize("second", ["con", "con_acc"])
def test_full_resolution_is_compared_in_two_by_two_means(second: Any, frames: Any) -> None:
    """Frames of 6 x 7: three rows and four columns, the last one of single pixels."""
    first, other, warped, valid = frames
    warped, valid = warped[..., ::2, ::2], valid[:, ::2, ::2]
    assert warped.shape[2:] == (3, 4)
    other.batch.label[:, 2:] = 3
    parts = loss_of(second=second)(first, other, warped, valid, NOTHING)
    p = F.avg_pool2d(other.logits, 2, ceil_mode=True).softmax(1)
    label = halved_label(other.batch.label)
    assert bool((label[:, 1:] == 3).all())
    assert bool((label[:, 0] == 255).any())  # pixels that do not agree
    label = label.masked_fill(~valid, 255)
    forms = {"con": lambda: con(warped, p, valid, "paper")}
    forms["con_acc"] = lambda: con_acc(warped, p, label, "paper")
    torch.testing.assert_close(parts[second], forms[second]())


class Recorded:
    """One case of the release: inputs by recipe, stored results."""

    def __init__(self, name: str) -> None:
        self.fill, recipes, self.about, self.arrays = recorded_losses("temporal_loss")
        recipe, self.name = recipes[name], name
        logits = [
            torch.from_numpy(recipe["logit_scale"] * self.fill.normal(seed, recipe["shape"]))
            for seed in recipe["logit_seeds"]
        ]
        hw = recipe["shape"][2:]
        self.frames = []
        for number, seeds in enumerate(recipe["label_seeds"]):
            both = zip(seeds, recipe["classes"], strict=True)
            label = np.stack([self.fill.labels(s, *hw, k, recipe["cell"]) for s, k in both])
            assert self.deviation(f"labels{number + 1}", label) == 0
            scores = logits[number].requires_grad_()
            frame = Frame(Output(scores, {}), batch_of(torch.from_numpy(label)), scores)
            self.frames.append(frame)
        self.warped = logits[2].softmax(1)

    def deviation(self, key: str, values: Any) -> float:
        """Largest difference from what is stored."""
        key = f"temporal_loss.{self.name}.{key}"
        value = np.asarray(values)
        if self.about[key]["stored"] == "sampled":
            count = self.about[key]["count"]
            value = value.ravel()[self.fill.sample_positions(key, value.size, count)]
        return float(np.abs(value - self.arrays[key].astype(value.dtype)).max())


@requires_golden
@pytest.mark.parametrize("name", ["soft", "peaked", "background_only"])
def test_released_values_and_gradients(name: str) -> None:
    case = Recorded(name)
    first, second = case.frames
    valid = torch.ones_like(second.batch.label, dtype=torch.bool)
    for which in ("dice", "con", "con_acc"):
        loss = loss_of(second=which, form="released")
        parts = loss(first, second, case.warped.detach(), valid, NOTHING)
        own = "dice_2" if which == "dice" else which
        values = {"ce1": "cross_entropy_1", "ce2": "cross_entropy_2", "dice1": "dice_1"}
        values[own.replace("_2", "2")] = own
        if which != "dice":
            values[f"{which}_from_probabilities"] = which
        for key, part in values.items():
            assert case.deviation(key, parts[part].detach()) <= 1e-5, key
        part, frame = ("dice_1", first) if which == "dice" else (which, second)
        (gradient,) = torch.autograd.grad(parts[part], frame.logits)
        assert case.deviation(f"grad.{part.replace('_1', '1')}", gradient) <= 5e-10
