from __future__ import annotations

import pytest
import torch

from rgbt.checks import InputError
from rgbt.losses.distances import FeatureDistance, feature_distance, sdc, sdn, thing_cells

CLASSES = ("road", "person", "car")


def test_cells_by_hand() -> None:
    """Cells of 2 x 2 pixels; three of four are enough, two of each of two things are not."""
    label = torch.tensor([[[1, 1, 2, 1], [1, 0, 2, 1], [0, 0, 2, 2], [0, 255, 2, 255]]])
    assert thing_cells(label, (2, 2), (1, 2), 0.75).tolist() == [[[True, False], [False, True]]]
    assert thing_cells(label, (2, 2), (1,), 0.75).tolist() == [[[True, False], [False, False]]]
    assert not thing_cells(label, (2, 2), (1, 2), 1.0).any()


def test_cells_beyond_the_label_are_of_no_class() -> None:
    """3 x 3 pixels padded to 4 x 4: a corner has one pixel in its cell, a side two."""
    label = torch.ones(1, 3, 3, dtype=torch.int64)
    assert thing_cells(label, (2, 2), (1,), 0.75).tolist() == [[[True, False], [False, False]]]


def test_value_and_gradient_by_hand() -> None:
    """Differences (3, 4), (0, 0) and (6, 8) in three cells, (9, 9) in one that does not count."""
    initial = torch.ones(1, 2, 2, 2)
    apart = torch.tensor([[[3.0, 0.0], [6.0, 9.0]], [[4.0, 0.0], [8.0, 9.0]]])[None]
    features = (initial + apart).requires_grad_()
    cells = torch.tensor([[[True, True], [True, False]]])
    found = feature_distance(features, initial, cells)
    assert found.item() == pytest.approx((5 + 0 + 10) / 3)
    found.backward()
    expected = torch.tensor([[[0.6, 0.0], [0.6, 0.0]], [[0.8, 0.0], [0.8, 0.0]]])[None] / 3
    assert features.grad is not None
    torch.testing.assert_close(features.grad, expected)


def test_value_is_of_single_precision_and_of_the_cells_of_all_processes(
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


def test_without_a_thing_it_costs_nothing() -> None:
    features = torch.ones(1, 2, 2, 2, requires_grad=True)
    found = feature_distance(features, torch.zeros(1, 2, 2, 2), torch.zeros(1, 2, 2) > 0)
    found.backward()
    assert found.item() == 0
    assert features.grad is not None
    assert not features.grad.any()


def test_things_are_named() -> None:
    """The half of the image that shows persons; the distance is 2 there."""
    distance = FeatureDistance(weight=0.005, things=("person",), min_share=0.75)
    label = torch.tensor([[[1, 1, 0, 0], [1, 1, 0, 0]]])
    features = torch.tensor([[[[2.0, 7.0]]]])
    found = distance(features, torch.zeros(1, 1, 1, 2), label, CLASSES)
    assert found.item() == pytest.approx(0.01)
    wrong = FeatureDistance(weight=0.005, things=("bike",), min_share=0.75)
    with pytest.raises(InputError, match="no class 'bike'"):
        wrong.indices(CLASSES)


def test_values_by_hand() -> None:
    teacher = torch.tensor([[[1.0, 2.0]]])
    # |1 - 0| and |2 - 4|: mean 1.5; |1 - 1| and |2 - 1|: mean 0.5.
    assert sdc(teacher, torch.tensor([[[0.0, 4.0]]])) == 1.5
    assert sdn(teacher, torch.tensor([[[0.0, 4.0]]]), torch.tensor([[[1.0, 1.0]]])) == 2.0


def test_only_the_student_gets_a_gradient() -> None:
    teacher = torch.zeros(1, 1, 2, requires_grad=True)
    student = torch.tensor([[[3.0, -1.0]]], requires_grad=True)
    sdc(teacher, student).backward()
    assert teacher.grad is None
    assert student.grad is not None
    assert student.grad.tolist() == [[[0.5, -0.5]]]
