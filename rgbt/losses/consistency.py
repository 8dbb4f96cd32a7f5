"""How far the predictions for two frames of one scene differ (Temporal, Eqs. 2 and 3).

The prediction of the first frame is given as the second frame sees it: how it got there is the
business of whoever warped it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rgbt.checks import check_shape
from rgbt.losses.dice import (
    SIGMA,
    Form,
    at_label,
    averaged,
    single,
    sum_by_class,
    sum_of_counted,
    target_of,
)


def con(warped: Tensor, second: Tensor, valid: Tensor, form: Form) -> Tensor:
    """Consistency loss: soft overlap of two predictions, no label.

        1 - 1/K sum_c  2 sum p_c q_c / sum (p_c + q_c + sigma)

    Source: Temporal, Eq. (2), there over the pixels of one pair of images, here of the batch.
    Paper: sigma inside the sum.   Released: a denominator below sigma is sigma.
    In both forms, a class that neither frame predicts costs 1 (agreement of m classes of K costs
    1 - m / K) and agreement in doubt costs more than agreement without.

    Args:
        warped: p, (B, K, H, W) probabilities of the first frame, brought into the second.
        second: q, (B, K, H, W) probabilities of the second frame.
        valid: (B, H, W) bool, pixels that count; a pixel needs no label to count.
        form: see above.

    Returns:
        () in [0, 1], float32 for half precision too; 1, with a gradient of 0, where no pixel is
        valid. It can be differentiated once.

    Raises:
        ValueError: shapes that do not fit.
    """
    _check(warped, second, "valid", valid)
    pairs = single(warped), single(second), valid
    sums: tuple[Tensor, Tensor] = _PairSums.apply(*pairs)  # type: ignore[no-untyped-call]
    overlap, size = sums
    if form == "paper":
        size = size + SIGMA * valid.sum()
    # With sigma inside, no sum over at least one pixel lies below this.
    return (1 - 2 * overlap / size.clamp(min=SIGMA)).mean()


def con_acc(warped: Tensor, second: Tensor, label: Tensor, form: Form) -> Tensor:
    """Consistency and accuracy loss: soft overlap of two predictions and the label, y one-hot.

        1 - 1/K sum_c  f sum p_c q_c y_c / sum (p_c + q_c + y_c + sigma)

    Source: Temporal, Eq. (3); see `con`.
    Paper: f = 2, so that full agreement costs 1/3; a class without a pixel costs 1.   Released:
    f = 3; pixels labelled 0 are left out, a class without a pixel costs 0, K still divides.

    Args:
        warped: p, (B, K, H, W) probabilities of the first frame, brought into the second.
        second: q, (B, K, H, W) probabilities of the second frame.
        label: (B, H, W) int64, of the second frame; 255 is left out.
        form: see above.

    Returns:
        () float32 for half precision too, in [1/3, 1] (paper) or [0, 1] (released). Where no pixel
        counts: 1 (paper), 0 (released), with a gradient of 0.

    Raises:
        ValueError: shapes that do not fit.
    """
    num_classes = _check(warped, second, "label", label)
    warped, second = single(warped), single(second)
    target = target_of(label, second, form)
    overlap = at_label(warped, target) * at_label(second, target)
    size = sum_of_counted(warped + second, target) + target.count
    if form == "paper":
        size = size + SIGMA * target.weight.sum()
    factor = 2 if form == "paper" else 3
    score = factor * sum_by_class(overlap, target.label, num_classes) / size.clamp(min=SIGMA)
    return averaged(1 - score, target, form)


def _check(warped: Tensor, second: Tensor, name: str, map_BHW: Tensor) -> int:
    sizes = check_shape("second", second, "B K H W")
    check_shape("warped", warped, "B K H W", **sizes)
    check_shape(name, map_BHW, "B H W", **{letter: sizes[letter] for letter in "BHW"})
    return sizes["K"]


class _PairSums(torch.autograd.Function):
    """(K,) sums of p q and (K,) sums of p + q over the pixels that count.

    The gradients are what automatic differentiation gives, without keeping masked copies: one pass
    for each of them.
    """

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(first, second, counted)
        weight = counted.to(first.dtype)
        products, sums = [], []
        for p, q in zip(first.unbind(1), second.unbind(1), strict=True):
            p = p * weight  # noqa: PLW2901
            products.append((p * q).sum())
            sums.append((p + q * weight).sum())
        return torch.stack(products), torch.stack(sums)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        first, second, counted = ctx.saved_tensors
        by_product, by_sum = (gradient[:, None, None] for gradient in gradients)
        weight = counted[:, None].to(first.dtype)

        def of(needed: bool, other: Tensor) -> Tensor | None:
            return torch.addcmul(by_sum, by_product, other).mul_(weight) if needed else None

        return of(ctx.needs_input_grad[0], second), of(ctx.needs_input_grad[1], first), None
