"""Labels for the auxiliary head of an unlabelled image: what both heads say where one is sure."""

from __future__ import annotations

from torch import Tensor

from rgbt.checks import check_range, check_shape
from rgbt.types import IGNORE


def guidance(probabilities: Tensor, aux_probabilities: Tensor, threshold: float) -> Tensor:
    """Self-produced guidance: the class of the mean of two predictions.

        label = argmax_k (p_k + q_k) / 2   where max_k p_k > t or max_k q_k > t, else 255

    Source: MaxSquareLoss and its release (t = 0.95).

    Args:
        probabilities: p (B, K, H, W) of the main head.
        aux_probabilities: q (B, K, H, W) of the auxiliary head.
        threshold: t in [0, 1].

    Returns:
        (B, H, W) int64; no gradient goes through it.

    Raises:
        InputError: a threshold out of range.
        ValueError: the shapes differ.
    """
    check_range("threshold", threshold, 0.0, 1.0)
    sizes = check_shape("probabilities", probabilities, "B K H W")
    check_shape("aux_probabilities", aux_probabilities, "B K H W", **sizes)
    p, q = probabilities.detach(), aux_probabilities.detach()
    sure = (p.amax(1) > threshold) | (q.amax(1) > threshold)
    return (p + q).argmax(1).where(sure, IGNORE)
