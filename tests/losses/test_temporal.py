"""The loss of two frames: by its parts, against the release, and as the configuration builds it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.geometry.warp import halved_label
from rgbt.losses.cross_entropy import CrossEntropy
from rgbt.losses.temporal import TemporalLoss, con, con_acc, dice
from rgbt.requirements import Requirement
from rgbt.types import Frame, Output
from tests.losses.problems import (
    NOTHING,
    batch_of,
    criterion_of,
    problem_of,
    recorded_losses,
    seeded,
)
from tests.models.golden import requires_golden


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


TABLE_1 = {  # Temporal, Table I: alpha, beta, second -> parts beside the two cross-entropies
    "B": (0, 0, "none", []),
    "C": (0, 1, "dice", ["dice_2"]),
    "D": (0, 1, "con", ["con"]),
    "E": (0, 1, "con_acc", ["con_acc"]),
    "F": (1, 0, "none", ["dice_1"]),
    "G": (1, 1, "dice", ["dice_1", "dice_2"]),
    "H": (1, 1, "con", ["dice_1", "con"]),
    "I": (1, 1, "con_acc", ["dice_1", "con_acc"]),
}


@pytest.mark.parametrize("variant", TABLE_1)
def test_the_variants_of_table_1(variant: str, frames: Any) -> None:
    alpha, beta, second, names = TABLE_1[variant]
    loss = loss_of(alpha=alpha, beta=beta, second=second)
    assert loss.record.reads_warped == (second in ("con", "con_acc"))
    first, other, warped, valid = frames
    parts = loss(first, other, warped if loss.record.reads_warped else None, valid, NOTHING)
    assert list(parts) == ["cross_entropy_1", "cross_entropy_2", *names]
    for part in parts.values():
        assert part.shape == ()
        assert part > 0
    torch.stack(list(parts.values())).sum().backward()
    for frame in (first, other):
        assert frame.logits.grad is not None
        assert frame.logits.grad.any()


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


@pytest.mark.parametrize("second", ["con", "con_acc"])
def test_means_of_two_by_two_pixels_are_compared_where_so_many_are_given(
    second: Any, frames: Any
) -> None:
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
    with pytest.raises(ValueError, match="warped: expected shape"):
        loss_of(second=second)(first, other, warped[..., :3], valid, NOTHING)


def test_masks_of_queries() -> None:
    criterion, generator = criterion_of(), seeded(3)
    frames = []
    for seed in (0, 1):
        output, batch = problem_of(3, 1, 2, seed=seed)
        logits = torch.randn(2, 5, *batch.label.shape[1:], generator=generator)
        frames.append(Frame(output, batch, logits))
    valid = torch.ones_like(frames[0].batch.label, dtype=torch.bool)
    loss = loss_of(segmentation=criterion)
    assert Requirement("model", "outputs", "masks") in loss.record.requires
    warped = frames[0].logits.softmax(1)
    parts = loss(*frames, warped, valid, seeded(5))
    # The set criterion has a dice of its own.
    segmentation = ["class_1", "mask_1", "seg_dice_1", "class_2", "mask_2", "seg_dice_2"]
    assert list(parts) == [*segmentation, "dice_1", "con"]
    generator = seeded(5)
    alone = [criterion(frame.output, frame.batch, generator) for frame in frames]
    expected = [values.sum() for each in alone for values in each.values()]
    assert torch.equal(torch.stack([parts[name] for name in segmentation]), torch.stack(expected))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"second": "none"}, r"^loss\.second=none does not fit loss\.beta=1"),
        ({"beta": 0.0}, r"^loss\.second=con does not fit loss\.beta=0"),
    ],
)
def test_settings_that_do_not_fit(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        loss_of(**changes)


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


@pytest.mark.parametrize(
    ("changes", "requires"),
    [
        ({}, False),
        ({"form": "released", "alpha": 0.0}, False),  # con reads no label
        ({"form": "released", "alpha": 0.0, "second": "con_acc"}, True),
        ({"form": "released"}, True),
    ],
)
def test_released_sums_require_class_0_to_be_the_background(
    changes: dict[str, Any], requires: bool
) -> None:
    keys = [each.key for each in loss_of(**changes).record.requires]
    assert ("first_class" in keys) == requires
