"""The class of every pixel from class scores: the one place where scores become classes."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Best(NamedTuple):
    """The highest score of every pixel and its class.

    Attributes:
        score: (B, H, W), dtype of the scores.
        classes: (B, H, W) int64.
    """

    score: Tensor
    classes: Tensor


def best_of(scores: Tensor) -> Best:
    """The highest of the K scores of every pixel, and its class.

    Of equal scores the first class is taken, as `torch.argmax` takes it: PyTorch documents the
    first index for `argmax` and for `max` along a dimension, on every device. `max` is used because
    on the CPU it takes a quarter to a fifth of the time of `argmax`.

    Args:
        scores: (B, K, H, W), any dtype with an order. A pixel with a NaN gets the class of its
            first NaN.
    """
    return Best(*scores.max(1))


def classes_of(scores: Tensor) -> Tensor:
    """(B, H, W) int64: the class with the highest score of every pixel (see `best_of`)."""
    return best_of(scores).classes
