"""Soft overlaps: class probabilities with a label (Dice), and of two frames of one scene.

Temporal, Eqs. 2 and 3. The caller warps the prediction of the first frame to the second. A ratio is
one of sums over the batch, so that the sums are those of all processes. Not here: the dice term of
matched queries (`rgbt.losses.masks`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rgbt.checks import check_shape
from rgbt.processes import total
from rgbt.types import IGNORE

Form = Literal["paper", "released"]
"""Which of two printed sets of choices: those of Temporal's paper, or those of its release."""

SIGMA = 1e-7
"""Keeps denominators above 0 (Temporal, Eq. 2; release)."""


@dataclass(frozen=True)
class Target:
    """A label as the sums below read it.

    Attributes:
        label: (B, H, W) int64, the class of a pixel that counts, 0 elsewhere.
        weight: (B, H, W) float, 1 where a pixel counts, 0 elsewhere.
        count: (K,) float, pixels of all processes that count, by class.
    """

    label: Tensor
    weight: Tensor
    count: Tensor


def dice(probabilities: Tensor, label: Tensor, form: Form) -> Tensor:
    """Dice loss over all pixels of the batch that count, averaged over the K classes.

        paper      1 - mean_c  2 sum p_c y_c / sum (p_c^2 + y_c^2)
        released   mean_c of  1 - 2 sum p_c y_c / sum (p_c + y_c),  0 for a class without a pixel

    Source: Temporal, Sec. III-C, which cites V-Net and prints nothing more; V-Net's squares.
    Paper: background is a class like the others; a class without a pixel costs 1, without
    gradient, so that agreement costs the share of absent classes.   Released: pixels labelled 0
    are left out, yet K still divides: the range ends at the share of foreground classes present.

    p (B, K, H, W) in [0, 1] sums to 1 over K, any float dtype; y (B, H, W) int64, 255 is left
    out. () in [0, 1], float32 for half precision too. Where no pixel counts: 1 (paper), 0
    (released), with a gradient of 0. ValueError: shapes that do not fit.
    """
    sizes = check_shape("probabilities", probabilities, "B K H W")
    check_shape("label", label, "B H W", **{letter: sizes[letter] for letter in "BHW"})
    probabilities = single(probabilities)
    target = target_of(label, probabilities, form)
    overlap = sum_by_class(at_label(probabilities, target), target.label, sizes["K"])
    size = sum_of_counted(probabilities.square() if form == "paper" else probabilities, target)
    cost = 1 - 2 * overlap / (size + target.count).clamp(min=SIGMA)
    return averaged(cost, target, form)


def con(warped: Tensor, second: Tensor, valid: Tensor, form: Form) -> Tensor:
    """Consistency loss: soft overlap of two predictions, no label.

        1 - 1/K sum_c  2 sum p_c q_c / sum (p_c + q_c + sigma)

    Source: Temporal, Eq. (2), there over the pixels of one pair of images, here of the batch.
    Paper: sigma inside the sum.   Released: a denominator below sigma is sigma.
    In both forms, a class that neither frame predicts costs 1 (agreement of m classes of K costs
    1 - m / K) and agreement in doubt costs more than agreement without.

    p and q (B, K, H, W): probabilities of the first frame, warped to the second, and of the
    second; `valid` (B, H, W) bool: pixels that count, labelled or not. () in [0, 1], float32 for
    half precision too; 1, with a gradient of 0, where no pixel is valid. It can be differentiated
    once. ValueError: shapes that do not fit.
    """
    _check(second, valid=valid, warped=warped)
    pairs = single(warped), single(second), valid
    sums: tuple[Tensor, Tensor] = _PairSums.apply(*pairs)  # type: ignore[no-untyped-call]
    overlap, size = (total(each) for each in sums)
    if form == "paper":
        size = size + SIGMA * total(valid.sum())
    # With sigma inside, no sum over at least one pixel lies below this.
    return (1 - 2 * overlap / size.clamp(min=SIGMA)).mean()


def con_acc(warped: Tensor, second: Tensor, label: Tensor, form: Form) -> Tensor:
    """Consistency and accuracy loss: soft overlap of two predictions and the label, y one-hot.

        1 - 1/K sum_c  f sum p_c q_c y_c / sum (p_c + q_c + y_c + sigma)

    Source: Temporal, Eq. (3); see `con`.
    Paper: f = 2, so that full agreement costs 1/3; a class without a pixel costs 1.   Released:
    f = 3; pixels labelled 0 are left out, a class without a pixel costs 0, K still divides.

    p and q as in `con`; y (B, H, W) int64 of the second frame, 255 is left out. () float32 for
    half precision too, in [1/3, 1] (paper) or [0, 1] (released). Where no pixel counts: 1 (paper),
    0 (released), with a gradient of 0. ValueError: shapes that do not fit.
    """
    num_classes = _check(second, label=label, warped=warped)
    warped, second = single(warped), single(second)
    target = target_of(label, second, form)
    overlap = at_label(warped, target) * at_label(second, target)
    size = sum_of_counted(warped + second, target) + target.count
    if form == "paper":
        size = size + SIGMA * total(target.weight.sum())
    factor = 2 if form == "paper" else 3
    score = factor * sum_by_class(overlap, target.label, num_classes) / size.clamp(min=SIGMA)
    return averaged(1 - score, target, form)


def _check(second: Tensor, *, warped: Tensor, **of_pixels: Tensor) -> int:
    """The number of classes."""
    sizes = check_shape("second", second, "B K H W")
    check_shape("warped", warped, "B K H W", **sizes)
    for name, each in of_pixels.items():
        check_shape(name, each, "B H W", **{letter: sizes[letter] for letter in "BHW"})
    return sizes["K"]


def averaged(cost: Tensor, target: Target, form: Form) -> Tensor:
    """Mean of K costs; as released, classes without a pixel cost 0."""
    return cost.mean() if form == "paper" else cost.where(target.count > 0, 0.0).mean()


def single(values: Tensor) -> Tensor:
    """At least float32: sums over millions of pixels are kept in it under autocast too."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def target_of(label: Tensor, probabilities: Tensor, form: Form) -> Target:
    """Which pixels count, and as what: all labelled ones; as released, none of the background.

    (B, H, W) int64, 255 = ignore; `probabilities` (B, K, H, W) give the number of classes and
    dtype.
    """
    counted = label != IGNORE
    if form == "released":
        counted &= label != 0
    weight = counted.to(probabilities.dtype)
    label = label.where(counted, 0)
    return Target(label, weight, sum_by_class(weight, label, probabilities.shape[1]))


def at_label(probabilities: Tensor, target: Target) -> Tensor:
    """(B, H, W): the probability of the labelled class, 0 where a pixel does not count."""
    return probabilities.gather(1, target.label[:, None])[:, 0] * target.weight


def sum_by_class(values: Tensor, label: Tensor, num_classes: int) -> Tensor:
    """(K,): sums of (B, H, W) values over the pixels of each class, of all processes."""
    rows = values.new_zeros(*values.shape[:2], num_classes)
    return total(rows.scatter_add(2, label, values).sum((0, 1)))


def sum_of_counted(values: Tensor, target: Target) -> Tensor:
    """(K,): sums of (B, K, H, W) values over the pixels that count, of all processes."""
    return total((values * target.weight[:, None]).sum((0, 2, 3)))


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
