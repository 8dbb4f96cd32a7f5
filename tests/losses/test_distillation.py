from __future__ import annotations

import pytest
import torch

from rgbt.losses.distillation import sdc, sdn


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


def test_half_precision_is_compared_in_float32() -> None:
    assert (
        sdc(torch.ones(1, 2, 3).bfloat16(), torch.zeros(1, 2, 3).bfloat16()).dtype == torch.float32
    )


def test_raises() -> None:
    with pytest.raises(ValueError, match="student"):
        sdc(torch.zeros(1, 2, 3), torch.zeros(1, 2, 4))
