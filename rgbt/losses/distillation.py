"""Self-distillation between the passes of complementary random masking: L1 of class logits.

Queries are compared index by index, without matching; masks and auxiliary layers are left out.
"""

from __future__ import annotations

from torch import Tensor

from rgbt.checks import check_shape


def sdc(teacher: Tensor, student: Tensor) -> Tensor:
    """Self-distillation of complementary representations.

        SDC = mean |stopgrad(teacher) - student|

    Source: CRM, Eq. (2).   Released: final layer only, raw logits, mean over all entries including
    the no-object column, teacher without gradient.

    Args:
        teacher: (B, Q, K+1) class logits of the clean RGB-T pass, final layer.
        student: (B, Q, K+1) class logits of the masked RGB-T pass, final layer.

    Returns:
        () float32; no gradient reaches `teacher`.

    Raises:
        ValueError: the shapes differ.
    """
    sizes = check_shape("teacher", teacher, "B Q C")
    check_shape("student", student, "B Q C", **sizes)
    return (teacher.detach().float() - student.float()).abs().mean()


def sdn(teacher: Tensor, rgb: Tensor, thermal: Tensor) -> Tensor:
    """Self-distillation of non-local representations.

        SDN = mean |stopgrad(teacher) - rgb| + mean |stopgrad(teacher) - thermal|

    Source: CRM, Eq. (3); release as in `sdc`.

    `rgb` and `thermal` are the masked pass predicted from one image alone; shapes as in `sdc`.
    """
    return sdc(teacher, rgb) + sdc(teacher, thermal)
