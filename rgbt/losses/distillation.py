"""Self-distillation between the passes of complementary random masking: L1 of class logits.

Queries are compared index by index, without matching; masks and auxiliary layers are left out.
"""

from __future__ import annotations

from torch import Tensor

from rgbt.checks import check_shape


def sdc(teacher: Tensor, student: Tensor) -> Tensor:
    """Self-distillation of complementary representations: ``mean |stopgrad(teacher) - student|``.

    Source: CRM, Eq. (2).   Released: final layer only, raw logits, mean over all entries including
    the no-object column, teacher without gradient.

    (B, Q, K+1) class logits of the clean and of the masked RGB-T pass -> () float32.

    Raises:
        ValueError: the shapes differ.
    """
    sizes = check_shape("teacher", teacher, "B Q C")
    check_shape("student", student, "B Q C", **sizes)
    return (teacher.detach().float() - student.float()).abs().mean()


def sdn(teacher: Tensor, rgb: Tensor, thermal: Tensor) -> Tensor:
    """Self-distillation of non-local representations: `sdc` of `rgb` plus `sdc` of `thermal`.

    Source: CRM, Eq. (3). `rgb` and `thermal`: the masked pass predicted from one image alone.
    """
    return sdc(teacher, rgb) + sdc(teacher, thermal)
