"""Losses without labels, and labels that are made of predictions.

Losses that reward confident predictions, those of a discriminator's verdicts with the maps that it
judges, and the labels that a teacher or two heads predict in the step. All take any float dtype and
compute in float32 at least.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.class_scores import best_of, classes_of
from rgbt.losses.cross_entropy import single
from rgbt.processes import mean_count
from rgbt.ranges import NonNegative, Share
from rgbt.types import IGNORE

LEAST = 1e-30  # the smallest probability that a logarithm is taken of (ADVENT release)


@dataclass(frozen=True, kw_only=True)
class MaxSquares:
    """Computes the negative sum of squared probabilities.

        pixels     -1 / (2 N)   sum_n sum_k p_nk^2
        entries    -1 / (2 N K) sum_n sum_k p_nk^2

    over the N pixels of a batch. With an image-wise ratio r, 1 / N becomes w_n / B, where pixel n
    of an image of H pixels is predicted to be of a class that h of them are predicted to be of:

        w_n = 1 / max(h^r H^(1 - r), 1)

    so that small classes count for more; with "entries", the 1/2 is then left out, as released.
    Without a ratio all pixels weigh alike.

    Source: MaxSquareLoss; thesis (J. Sun), Eq. 2: "pixels".   Released: "entries", by both. The
    released weights belong to it: 0.1 (both), and 0.09 with r = 0.2 (MaxSquareLoss, K = 19).
    """

    weight: NonNegative
    normalisation: Literal["pixels", "entries"]
    image_wise_ratio: Share | None

    def __call__(self, probabilities: Tensor) -> dict[str, Tensor]:
        """Return the part "max_squares", () <= 0, of (B, K, H, W) whose sums over K are 1."""
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
    """Averages ``-sum_k p_k log p_k / log K`` over pixels, in [0, 1].

    Source: ADVENT, Eqs. 2 and 3; thesis (J. Sun), Eq. 1, which does not print the mean.
    Released: ADVENT, with weight 0.001.
    """

    weight: NonNegative

    def __call__(self, probabilities: Tensor) -> dict[str, Tensor]:
        """Return the part "entropy", (), of (B, K, H, W) in [0, 1] that sum to 1 over K."""
        probabilities = single(probabilities)
        surprise = -probabilities * probabilities.clamp(min=LEAST).log()
        return {"entropy": self.weight * surprise.sum(1).mean() / _most(probabilities)}


def _most(scores: Tensor) -> float:
    """Return the highest entropy of K classes, log K; of one class, whose entropy is 0, log 2."""
    return math.log(max(scores.shape[1], 2))


def guidance(probabilities: Tensor, aux_probabilities: Tensor, threshold: float) -> Tensor:
    """Return self-produced guidance: the class of the mean of two predictions.

        label = argmax_k (p_k + q_k) / 2   where max_k p_k > t or max_k q_k > t, else 255

    Source: MaxSquareLoss and its release (t = 0.95).

    p and q, (B, K, H, W), are those of the main and of the auxiliary head, t in [0, 1] is
    `threshold`; (B, H, W) int64, through which no gradient goes.
    """
    p, q = probabilities.detach(), aux_probabilities.detach()
    sure = (p.amax(1) > threshold) | (q.amax(1) > threshold)
    return classes_of(p + q).where(sure, IGNORE)


WeightedBy = Literal["batch", "image"]


class WeightedLabels(NamedTuple):
    """Holds labels of a batch, and what is logged of them; float32 in [0, 1]."""

    label: Tensor  # (B, H, W) int64, every pixel has a class
    weight: Tensor  # (B, H, W)
    confident: Tensor  # (), share of the confident pixels of the batch
    confidence: Tensor  # (), mean of the highest probabilities of the batch


def pseudo_labels(
    scores: Tensor, threshold: float, weighted_by: WeightedBy, ignored: tuple[float, float]
) -> WeightedLabels:
    """Label every pixel with its class, weighted by the share of confident pixels.

        y = argmax_k p_k,   q = mean over pixels of [max_k p_k >= threshold]

    q weighs every pixel, confident or not. It is a number of the batch, or of each image. Rows at
    the top and bottom of the image have weight 0.

    Source: DACS; DAFormer, Sec. 3.1 (of each image).   Released: of the batch.

    Of scores (B, K, H, W), through which no gradient goes. `threshold` is 0.968 in the releases of
    DACS, DAFormer, HRDA and MIC; `ignored` are the shares of the rows at the top and bottom.
    """
    confidence, label = best_of(single(scores.detach()).softmax(1))
    of_image = (confidence >= threshold).float().mean((1, 2))
    of_batch = mean_count(of_image.mean())
    weight = of_image if weighted_by == "image" else of_batch.expand_as(of_image)
    height = scores.shape[2]
    rows = torch.arange(height, device=scores.device)
    top, bottom = (round(share * height) for share in ignored)
    counted = (rows >= top) & (rows < height - bottom)
    weights = (weight[:, None, None] * counted[:, None]).expand(label.shape)
    return WeightedLabels(label, weights.contiguous(), of_batch, mean_count(confidence.mean()))


# Input of a discriminator, derived from a prediction.
Judged = Literal["probabilities", "logits", "self_information"]


def least_squares(verdicts: Tensor, value: float) -> Tensor:
    """Average ``(value - D)^2`` over verdicts D of any shape; ().

    Source: LSGAN; thesis (J. Sun), Eqs. 5 and 6 (source 0, target 1); HeatNet (day 1, night 0).
    """
    return (value - single(verdicts)).square().mean()


def logistic(verdicts: Tensor, value: float) -> Tensor:
    """Average ``-value log s(D) - (1 - value) log (1 - s(D))`` with the logistic function s.

    Source: AdaptSegNet, Eqs. 2 and 4; ADVENT (releases of both: source 0, target 1).
    """
    verdicts = single(verdicts)
    return F.binary_cross_entropy_with_logits(verdicts, torch.full_like(verdicts, value))


VERDICT_LOSSES = {"least_squares": least_squares, "cross_entropy": logistic}


def judged(logits: Tensor, how: Judged) -> Tensor:
    """Return the input map of a discriminator.

        probabilities       p = softmax of the class scores    AdaptSegNet, thesis (J. Sun)
        logits              the class scores                   HeatNet
        self_information    -p log p / log K                   ADVENT, Sec. 3.2

    (B, K, H, W) class scores, any float dtype -> the same shape, float32 for half precision too.
    """
    logits = single(logits)
    if how == "logits":
        return logits
    if how == "probabilities":
        return logits.softmax(1)
    log_p = logits.log_softmax(1)  # finite where p is too small to differ from 0
    return -log_p.exp() * log_p / _most(logits)
