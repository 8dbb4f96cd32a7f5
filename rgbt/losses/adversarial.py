"""Losses of a discriminator's verdicts, and the maps that it judges."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import check_shape
from rgbt.losses.overlap import single

Judged = Literal["probabilities", "logits", "self_information"]
"""Input of a discriminator, derived from a prediction."""


def least_squares(verdicts: Tensor, value: float) -> Tensor:
    """Mean of ``(value - D)^2`` over verdicts D of any shape and float dtype; () float32.

    Source: LSGAN; thesis (J. Sun), Eqs. 5 and 6 (source 0, target 1); HeatNet (day 1, night 0).
    """
    return (value - single(verdicts)).square().mean()


def cross_entropy(verdicts: Tensor, value: float) -> Tensor:
    """Mean of ``-value log s(D) - (1 - value) log (1 - s(D))`` with the logistic function s.

    Source: AdaptSegNet, Eqs. 2 and 4; ADVENT (releases of both: source 0, target 1).

    As `least_squares`, verdicts not squashed and `value` in [0, 1]; finite for finite verdicts.
    """
    verdicts = single(verdicts)
    return F.binary_cross_entropy_with_logits(verdicts, torch.full_like(verdicts, value))


VERDICT_LOSSES: dict[str, Callable[[Tensor, float], Tensor]] = {
    "least_squares": least_squares,
    "cross_entropy": cross_entropy,
}
"""By their names in the configuration."""


def judged(logits: Tensor, how: Judged) -> Tensor:
    """The input map of a discriminator.

        probabilities       p = softmax of the class scores    AdaptSegNet, thesis (J. Sun)
        logits              the class scores                   HeatNet
        self_information    -p log p / log K                   ADVENT, Sec. 3.2

    (B, K, H, W) class scores, any float dtype -> the same shape, float32 for half precision too.
    """
    sizes = check_shape("logits", logits, "B K H W")
    logits = single(logits)
    if how == "logits":
        return logits
    if how == "probabilities":
        return logits.softmax(1)
    log_p = logits.log_softmax(1)  # finite where p is too small to differ from 0
    return -log_p.exp() * log_p / math.log(max(sizes["K"], 2))  # of one class: 0
