"""Losses without labels, which reward confident predictions, and labels made of predictions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rgbt.checks import check_shape
from rgbt.class_scores import classes_of
from rgbt.losses.overlap import single
from rgbt.ranges import NonNegative, Share
from rgbt.types import IGNORE

Normalisation = Literal["pixels", "entries"]

LEAST = 1e-30
"""Smallest probability that a logarithm is taken of (ADVENT release)."""


@dataclass(frozen=True, kw_only=True)
class MaxSquares:
    """Negative sum of squared probabilities.

        pixels     -1 / (2 N)   sum_n sum_k p_nk^2
        entries    -1 / (2 N K) sum_n sum_k p_nk^2

    over the N pixels of a batch. With an image-wise ratio r, 1 / N becomes w_n / B, where pixel n
    of an image of H pixels is predicted to be of a class that h of them are predicted to be of:

        w_n = 1 / max(h^r H^(1 - r), 1)

    so that small classes count for more; with "entries", the 1/2 is then left out, as released.

    Source: MaxSquareLoss; thesis (J. Sun), Eq. 2: "pixels".   Released: "entries", by both. The
    released weights belong to it: 0.1 (both), and 0.09 with r = 0.2 (MaxSquareLoss, K = 19).

    Attributes:
        weight: factor of the loss, >= 0.
        normalisation: see above.
        image_wise_ratio: r in [0, 1]; null weighs all pixels alike.
    """

    weight: NonNegative
    normalisation: Normalisation
    image_wise_ratio: Share | None

    def __call__(self, probabilities: Tensor) -> dict[str, Tensor]:
        """The part "max_squares", () <= 0, float32 for half precision too.

        `probabilities` (B, K, H, W) in [0, 1] sum to 1 over K; any float dtype.
        """
        probabilities = single(probabilities)
        squares = probabilities.square().sum(1)
        entries = self.normalisation == "entries"
        if self.image_wise_ratio is None:
            value = squares.mean() / 2
        else:
            p, ratio = probabilities.detach(), self.image_wise_ratio
            classes = classes_of(p).flatten(1)
            sizes = p.new_zeros(p.shape[:2])
            sizes.scatter_add_(1, classes, torch.ones_like(classes, dtype=sizes.dtype))
            total = classes.shape[1]
            of_class = 1 / (sizes**ratio * total ** (1 - ratio)).clamp(min=1)
            weights = of_class.gather(1, classes).view_as(squares)
            value = (weights * squares).sum((1, 2)).mean() / (1 if entries else 2)
        return {"max_squares": -self.weight * value / (probabilities.shape[1] if entries else 1)}


@dataclass(frozen=True, kw_only=True)
class Entropy:
    """Mean over pixels of ``-sum_k p_k log p_k / log K``, in [0, 1].

    Source: ADVENT, Eqs. 2 and 3; thesis (J. Sun), Eq. 1, which does not print the mean.
    Released: ADVENT, with weight 0.001.

    Attributes:
        weight: factor of the loss, >= 0.
    """

    weight: NonNegative

    def __call__(self, probabilities: Tensor) -> dict[str, Tensor]:
        """The part "entropy", () float32 for half precision too; the gradient is finite at 0 too.

        `probabilities` (B, K, H, W) in [0, 1] sum to 1 over K; any float dtype.
        """
        probabilities = single(probabilities)
        surprise = -probabilities * probabilities.clamp(min=LEAST).log()
        highest = math.log(max(probabilities.shape[1], 2))  # of one class, the entropy is 0
        return {"entropy": self.weight * surprise.sum(1).mean() / highest}


def guidance(probabilities: Tensor, aux_probabilities: Tensor, threshold: float) -> Tensor:
    """Self-produced guidance: the class of the mean of two predictions.

        label = argmax_k (p_k + q_k) / 2   where max_k p_k > t or max_k q_k > t, else 255

    Source: MaxSquareLoss and its release (t = 0.95).

    p and q, (B, K, H, W), are those of the main and of the auxiliary head, t in [0, 1] is
    `threshold`; (B, H, W) int64, through which no gradient goes.

    Raises:
        ValueError: the shapes differ.
    """
    sizes = check_shape("probabilities", probabilities, "B K H W")
    check_shape("aux_probabilities", aux_probabilities, "B K H W", **sizes)
    p, q = probabilities.detach(), aux_probabilities.detach()
    sure = (p.amax(1) > threshold) | (q.amax(1) > threshold)
    return classes_of(p + q).where(sure, IGNORE)
