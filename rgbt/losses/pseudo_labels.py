"""Labels that a teacher predicts in the step, and the weights of their pixels."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from rgbt.checks import check_shape
from rgbt.class_scores import best_of
from rgbt.losses.overlap import single
from rgbt.processes import mean_count

WeightedBy = Literal["batch", "image"]
"""The images whose share of confident pixels weighs a pixel: all of the batch, or its own."""


class PseudoLabels(NamedTuple):
    """Labels of a batch.

    Attributes:
        label: (B, H, W) int64, every pixel has a class.
        weight: (B, H, W) float32 in [0, 1].
        confident: () float32, share of the confident pixels of the batch, in [0, 1].
        confidence: () float32, mean of the highest probabilities of the batch, in [0, 1].
    """

    label: Tensor
    weight: Tensor
    confident: Tensor
    confidence: Tensor


def pseudo_labels(
    scores: Tensor, threshold: float, weighted_by: WeightedBy, ignored: tuple[float, float]
) -> PseudoLabels:
    """The class of every pixel, weighted by the share of confident pixels.

        y = argmax_k p_k,   q = mean over pixels of [max_k p_k >= threshold]

    q weighs every pixel, confident or not. It is a number of the batch, or of each image. Rows at
    the top and bottom of the image have weight 0.

    Source: DACS; DAFormer, Sec. 3.1 (of each image).   Released: of the batch.

    Args:
        scores: (B, K, H, W), any float dtype; no gradient passes.
        threshold: in [0, 1]; 0.968 in the releases of DACS, DAFormer, HRDA and MIC.
        weighted_by: see above.
        ignored: shares of the rows at the top and at the bottom, in [0, 1], rounded to rows.
    """
    height = check_shape("scores", scores, "B K H W")["H"]
    confidence, label = best_of(single(scores.detach()).softmax(1))
    of_image = (confidence >= threshold).float().mean((1, 2))
    of_batch = mean_count(of_image.mean())
    weight = of_image if weighted_by == "image" else of_batch.expand_as(of_image)
    rows = torch.arange(height, device=scores.device)
    top, bottom = (round(share * height) for share in ignored)
    counted = (rows >= top) & (rows < height - bottom)
    weights = (weight[:, None, None] * counted[:, None]).expand(label.shape)
    return PseudoLabels(label, weights.contiguous(), of_batch, mean_count(confidence.mean()))
