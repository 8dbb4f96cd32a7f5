"""Cross-entropy, distances, losses without labels, and labels that predictions make."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.losses.cross_entropy import CrossEntropy, WithAuxiliary
from rgbt.losses.distances import FeatureDistance, feature_distance, sdc, sdn, thing_cells
from rgbt.losses.unlabelled import (
    Entropy,
    MaxSquares,
    guidance,
    judged,
    least_squares,
    logistic,
    pseudo_labels,
)
from rgbt.requirements import DatasetRecord, check_requirements
from rgbt.types import Output
from tests.losses.problems import NOTHING, batch_of, seeded

PLAIN = CrossEntropy(class_weights=None)


def part_of(loss: CrossEntropy, logits: Tensor, batch: Any) -> Tensor:
    return loss(Output(logits, {}), batch, NOTHING)["cross_entropy"]


# ---- cross-entropy -------------------------------------------------------------------------------


def test_value_by_hand() -> None:
    # Two pixels with scores (0, 0): log 2 each; the ignored one counts nowhere.
    batch = batch_of(torch.tensor([[[0, 1, 255]]]))
    logits = torch.tensor([[[[0.0, 0.0, 9.0]], [[0.0, 0.0, -9.0]]]], requires_grad=True)
    assert torch.allclose(part_of(PLAIN, logits, batch), torch.tensor([2.0]).log())
    # Where nothing is labelled, nothing costs.
    part = part_of(PLAIN, logits, batch_of(torch.full((1, 1, 3), 255)))
    part.sum().backward()
    assert part.tolist() == [0.0]
    assert not logits.grad.any()


def test_class_weights() -> None:
    generator = seeded(0)
    label = torch.randint(0, 3, (2, 4, 5), generator=generator)
    logits = torch.randn(2, 3, 4, 5, generator=generator)
    part = part_of(CrossEntropy(class_weights=(1.0, 2.0, 0.5)), logits, batch_of(label))
    expected = F.cross_entropy(logits, label, torch.tensor([1.0, 2.0, 0.5]), ignore_index=255)
    assert torch.allclose(part, expected)
    records = {"dataset": SimpleNamespace(record=DatasetRecord(num_classes=3))}
    check_requirements({**records, "loss": CrossEntropy(class_weights=(1.0, 2.0, 3.0))})
    with pytest.raises(InputError, match=r"loss.class_weights=\[1.0, 2.0\] requires num_classes=2"):
        check_requirements({**records, "loss": CrossEntropy(class_weights=(1.0, 2.0))})


def test_confidences_by_hand() -> None:
    """Costs log 2, log 2, log 4 of confidence 1, 0.5, 0.25; the ignored pixel counts nowhere."""
    label = torch.tensor([[[0, 1, 1, 255]]])
    logits = torch.zeros(1, 2, 1, 4)
    logits[0, 0, 0, 2] = torch.tensor(3.0).log()  # the probability of class 1 is 1/4
    batch = replace(batch_of(label), confidence=torch.tensor([[[1.0, 0.5, 0.25, 1.0]]]))
    log2 = torch.tensor(2.0).log()
    assert torch.allclose(part_of(PLAIN, logits, batch), (1 + 0.5 + 0.25 * 2) * log2 / 3)
    # Class weights enter the mean that is divided by, confidences do not.
    part = part_of(CrossEntropy(class_weights=(2.0, 0.5)), logits, batch)
    assert torch.allclose(part, (2 * 1 + 0.5 * 0.5 + 0.5 * 0.25 * 2) * log2 / (2 + 0.5 + 0.5))


def test_auxiliary_value_by_hand() -> None:
    """Scores for class 1 of (0, 0) and (0, log 3): log 2, and a tenth of log 4/3."""
    aux = {"aux_logits": torch.tensor([0.0, math.log(3)]).view(1, 2, 1, 1), "x": torch.ones(1)}
    batch = batch_of(torch.ones(1, 1, 1, dtype=torch.long))
    loss = WithAuxiliary(loss=PLAIN, weight=0.1)
    parts = loss(Output(torch.zeros(1, 2, 1, 1), aux), batch, NOTHING)
    assert list(parts) == ["cross_entropy", "cross_entropy_aux"]
    assert parts["cross_entropy"].item() == pytest.approx(math.log(2))
    assert parts["cross_entropy_aux"].item() == pytest.approx(0.1 * math.log(4 / 3))
    assert loss.record.weighs_confidence is True
    assert WithAuxiliary(loss=lambda *_: {}, weight=0.1).record.weighs_confidence is False


# ---- distances -----------------------------------------------------------------------------------


def test_cells_by_hand() -> None:
    """Cells of 2 x 2 pixels; three of four are enough, two of each of two things are not."""
    label = torch.tensor([[[1, 1, 2, 1], [1, 0, 2, 1], [0, 0, 2, 2], [0, 255, 2, 255]]])
    assert thing_cells(label, (2, 2), (1, 2), 0.75).tolist() == [[[True, False], [False, True]]]
    assert thing_cells(label, (2, 2), (1,), 0.75).tolist() == [[[True, False], [False, False]]]
    assert not thing_cells(label, (2, 2), (1, 2), 1.0).any()
    # 3 x 3 pixels padded to 4 x 4: a corner has one pixel in its cell, a side two.
    label = torch.ones(1, 3, 3, dtype=torch.int64)
    assert thing_cells(label, (2, 2), (1,), 0.75).tolist() == [[[True, False], [False, False]]]


def test_feature_distance_and_gradient_by_hand() -> None:
    """Differences (3, 4), (0, 0) and (6, 8) in three cells, (9, 9) in one that does not count."""
    initial = torch.ones(1, 2, 2, 2)
    apart = torch.tensor([[[3.0, 0.0], [6.0, 9.0]], [[4.0, 0.0], [8.0, 9.0]]])[None]
    features = (initial + apart).requires_grad_()
    cells = torch.tensor([[[True, True], [True, False]]])
    found = feature_distance(features, initial, cells)
    assert found.item() == pytest.approx((5 + 0 + 10) / 3)
    found.backward()
    expected = torch.tensor([[[0.6, 0.0], [0.6, 0.0]], [[0.8, 0.0], [0.8, 0.0]]])[None] / 3
    torch.testing.assert_close(features.grad, expected)
    assert feature_distance(features, initial, cells & False).item() == 0


def test_value_has_single_precision_and_cells_of_all_processes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """256 - 0.25 is rounded to 256 in bfloat16; the other process has three cells."""
    features, initial = (
        torch.full((1, 1, 1, 1), value, dtype=torch.bfloat16) for value in (256.0, 0.25)
    )
    cells = torch.ones(1, 1, 1, dtype=torch.bool)
    assert feature_distance(features, initial, cells).item() == 255.75
    monkeypatch.setattr("rgbt.losses.distances.mean_count", lambda count: 2 * count)
    assert feature_distance(features, initial, cells).item() == 255.75 / 2


def test_things_are_named() -> None:
    """The half of the image that shows persons; the distance is 2 there."""
    classes = ("road", "person", "car")
    distance = FeatureDistance(weight=0.005, things=("person",), min_share=0.75)
    label = torch.tensor([[[1, 1, 0, 0], [1, 1, 0, 0]]])
    found = distance(torch.tensor([[[[2.0, 7.0]]]]), torch.zeros(1, 1, 1, 2), label, classes)
    assert found.item() == pytest.approx(0.01)
    wrong = FeatureDistance(weight=0.005, things=("bike",), min_share=0.75)
    with pytest.raises(InputError, match="no class 'bike'"):
        wrong.indices(classes)


def test_distillation_by_hand() -> None:
    teacher = torch.tensor([[[1.0, 2.0]]])
    # |1 - 0| and |2 - 4|: mean 1.5; |1 - 1| and |2 - 1|: mean 0.5.
    assert sdc(teacher, torch.tensor([[[0.0, 4.0]]])) == 1.5
    assert sdn(teacher, torch.tensor([[[0.0, 4.0]]]), torch.tensor([[[1.0, 1.0]]])) == 2.0


def test_only_the_student_gets_a_gradient() -> None:
    teacher = torch.zeros(1, 1, 2, requires_grad=True)
    student = torch.tensor([[[3.0, -1.0]]], requires_grad=True)
    sdc(teacher, student).backward()
    assert teacher.grad is None
    assert student.grad.tolist() == [[[0.5, -0.5]]]


# ---- without labels ------------------------------------------------------------------------------


def squares(p: Tensor, normalisation: Any = "pixels", ratio: Any = None, weight: float = 1) -> Any:
    loss = MaxSquares(weight=weight, normalisation=normalisation, image_wise_ratio=ratio)
    return loss(p)["max_squares"]


def entropy(p: Tensor, weight: float = 1.0) -> Tensor:
    return Entropy(weight=weight)(p)["entropy"]


@pytest.mark.parametrize(
    ("values", "pixels", "entries", "surprise"),
    [
        ((1 / 14,) * 14, -0.0357143, -0.00255102, 1.0),  # 14 / 14^2 / 2; 1 / 14 of that
        ((0.0,) * 3 + (1.0,) + (0.0,) * 10, -0.5, -0.0357143, 0.0),
        ((0.7, 0.2, 0.1), -0.27, -0.09, 0.729847),  # 0.54 / 2; 0.8018186 nats of 1.0986123
    ],
)
def test_values_by_hand(
    values: tuple[float, ...], pixels: float, entries: float, surprise: float
) -> None:
    p = torch.tensor(values).view(1, -1, 1, 1).expand(2, len(values), 3, 5)
    assert squares(p).item() == pytest.approx(pixels, abs=1e-7)
    assert squares(p, "entries").item() == pytest.approx(entries, abs=1e-7)
    assert entropy(p).item() == pytest.approx(surprise, abs=1e-6)
    assert squares(p, weight=0.1).item() == pytest.approx(0.1 * pixels, abs=1e-7)
    assert entropy(p, weight=0.25).item() == pytest.approx(0.25 * surprise, abs=1e-6)
    assert squares(p).shape == entropy(p).shape == ()


@pytest.mark.parametrize("ratio", [0.0, 0.2, 1.0])
def test_image_wise_weights_against_loops(ratio: float) -> None:
    generator, total = seeded(0), 0.0
    p = (2 * torch.randn(3, 4, 5, 6, generator=generator, dtype=torch.float64)).softmax(1)
    for image in p.tolist():
        pixels = list(zip(*(sum(rows, []) for rows in image), strict=True))
        predicted = [max(range(len(pixel)), key=pixel.__getitem__) for pixel in pixels]
        for pixel, k in zip(pixels, predicted, strict=True):
            size = predicted.count(k) ** ratio * len(pixels) ** (1 - ratio)
            total -= sum(value**2 for value in pixel) / max(size, 1)
    assert squares(p, "pixels", ratio).item() == pytest.approx(total / (2 * 3), rel=1e-9)
    assert squares(p, "entries", ratio).item() == pytest.approx(total / (3 * 4), rel=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_large_scores_give_finite_values_and_gradients(dtype: torch.dtype) -> None:
    scores = torch.tensor([1e4, -1e4, 0.0, 1e4]).to(dtype).view(1, 4, 1, 1).repeat(1, 1, 2, 2)
    for loss in (squares, entropy, lambda p: squares(p, "entries", 0.2)):
        leaf = scores.clone().requires_grad_()
        value = loss(leaf.softmax(1))
        assert value.dtype == torch.float32
        assert value.isfinite()
        value.backward()
        assert leaf.grad.isfinite().all()


def test_guidance_by_hand() -> None:
    main = [(0.96, 0.04), (0.5, 0.5), (0.6, 0.4), (0.95, 0.05), (0.03, 0.97)]
    other = [(0.60, 0.40), (0.01, 0.99), (0.7, 0.3), (0.95, 0.05), (0.98, 0.02)]
    found = guidance(*(torch.tensor(shares).T[None, :, None] for shares in (main, other)), 0.95)
    # Sure p; sure q; nobody; not above the threshold; both, and the mean is (0.505, 0.495).
    assert found.tolist() == [[[0, 1, 255, 255, 0]]]
    assert found.dtype == torch.int64


def test_least_squares_by_hand() -> None:
    verdicts = torch.tensor([[[[2.0, -1.0], [0.0, 1.0]]]])
    assert least_squares(verdicts, 1).item() == (1 + 4 + 1 + 0) / 4
    assert least_squares(verdicts, 0).item() == (4 + 1 + 0 + 1) / 4


def test_cross_entropy_of_verdicts_by_hand() -> None:
    verdicts = torch.tensor([[[[0.0, math.log(3)]]]])  # logistic function: 1/2 and 3/4
    assert logistic(verdicts, 1).item() == pytest.approx((math.log(2) + math.log(4 / 3)) / 2)
    assert logistic(verdicts, 0).item() == pytest.approx((math.log(2) + math.log(4)) / 2)


def test_what_is_judged_by_hand() -> None:
    logits = torch.tensor([0.7, 0.2, 0.1]).log().view(1, 3, 1, 1) + 5
    assert torch.equal(judged(logits, "logits"), logits)
    assert judged(logits, "probabilities").flatten().tolist() == pytest.approx([0.7, 0.2, 0.1])
    found = judged(logits, "self_information").flatten().tolist()
    expected = [-p * math.log2(p) / math.log2(3) for p in (0.7, 0.2, 0.1)]
    assert found == pytest.approx(expected, rel=1e-5)
    assert not judged(logits[:, :1], "self_information").any()  # of one class


# ---- labels of a teacher -------------------------------------------------------------------------


def scores() -> Tensor:
    """(2, 2, 2, 2): highest probabilities of the first image 0.9, 0.8, 0.6, 0.6; then 0.9 once."""
    first = torch.tensor([[[0.9, 0.2], [0.4, 0.6]], [[0.9, 0.5], [0.5, 0.5]]], dtype=torch.float64)
    return torch.stack([first, 1 - first], dim=1).log()


def test_classes_and_share_of_confident_pixels() -> None:
    found = pseudo_labels(scores().requires_grad_(), 0.8, "batch", (0.0, 0.0))
    assert not any(labels.requires_grad for labels in found)
    assert found.label.tolist() == [[[0, 1], [1, 0]], [[0, 0], [0, 0]]]
    # 0.9 and 0.8 of the first image, 0.9 of the second: 3 of 8 pixels.
    assert found.confident.item() == 3 / 8
    torch.testing.assert_close(found.weight, torch.full((2, 2, 2), 3 / 8))
    means = (0.9 + 0.8 + 0.6 + 0.6 + 0.9 + 0.5 + 0.5 + 0.5) / 8
    assert found.confidence.item() == pytest.approx(means)


def test_share_of_each_image() -> None:
    found = pseudo_labels(scores(), 0.8, "image", (0.0, 0.0))
    assert found.weight[0].unique().tolist() == [0.5]
    assert found.weight[1].unique().tolist() == [0.25]
    assert found.confident.item() == 3 / 8


@pytest.mark.parametrize("weighted_by", ["batch", "image"])
def test_rows_at_the_borders_have_no_weight(weighted_by: Any) -> None:
    tall = scores().repeat(1, 1, 5, 1)  # ten rows
    plain = pseudo_labels(tall, 0.8, weighted_by, (0.0, 0.0))
    found = pseudo_labels(tall, 0.8, weighted_by, (0.1, 0.3))
    assert not found.weight[:, :1].any()
    assert not found.weight[:, 7:].any()
    assert torch.equal(found.weight[:, 1:7], plain.weight[:, 1:7])
    # The share is that of all rows, as released.
    assert torch.equal(found.confident, plain.confident)
    # Of ten rows, 0.17 are two, and 0.26 are three.
    found = pseudo_labels(tall, 0.8, weighted_by, (0.17, 0.26))
    assert found.weight.bool().any((0, 2)).tolist() == [False] * 2 + [True] * 5 + [False] * 3
