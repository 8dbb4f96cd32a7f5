"""Dice loss between class probabilities and a label, and the sums that it is made of.

Not here: the dice term of matched queries (`rgbt.losses.masks`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rgbt.checks import check_shape
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
        count: (K,) float, pixels that count, by class.
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

    Args:
        probabilities: (B, K, H, W) in [0, 1], summing to 1 over K; any float dtype.
        label: (B, H, W) int64; 255 is left out.
        form: see above.

    Returns:
        () in [0, 1], float32 for half precision too. Where no pixel counts: 1 (paper), 0
        (released), with a gradient of 0.

    Raises:
        ValueError: shapes that do not fit.
    """
    sizes = check_shape("probabilities", probabilities, "B K H W")
    check_shape("label", label, "B H W", **{letter: sizes[letter] for letter in "BHW"})
    probabilities = single(probabilities)
    target = target_of(label, probabilities, form)
    overlap = sum_by_class(at_label(probabilities, target), target.label, sizes["K"])
    size = sum_of_counted(probabilities.square() if form == "paper" else probabilities, target)
    cost = 1 - 2 * overlap / (size + target.count).clamp(min=SIGMA)
    return averaged(cost, target, form)


def averaged(cost: Tensor, target: Target, form: Form) -> Tensor:
    """Mean of K costs; as released, classes without a pixel cost 0."""
    return cost.mean() if form == "paper" else cost.where(target.count > 0, 0.0).mean()


def single(values: Tensor) -> Tensor:
    """At least float32: sums over millions of pixels are kept in it under autocast too."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def target_of(label: Tensor, probabilities: Tensor, form: Form) -> Target:
    """Which pixels count, and as what: all labelled ones; as released, none of the background.

    Args:
        label: (B, H, W) int64, 255 = ignore.
        probabilities: (B, K, H, W), for number of classes and dtype.
        form: see `dice`.
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
    """(K,): sums of (B, H, W) values over the pixels of each class."""
    rows = values.new_zeros(*values.shape[:2], num_classes)
    return rows.scatter_add(2, label, values).sum((0, 1))


def sum_of_counted(values: Tensor, target: Target) -> Tensor:
    """(K,): sums of (B, K, H, W) values over the pixels that count."""
    return (values * target.weight[:, None]).sum((0, 2, 3))
