"""The class of every pixel from class scores: the one place where scores become classes."""

from __future__ import annotations

from torch import Tensor


def best_of(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Return the highest of the K scores of every pixel, and its class.

    Of equal scores the first class is taken, as `torch.argmax` takes it: PyTorch documents the
    first index for `argmax` and for `max` along a dimension, on every device. `max` is used because
    on the CPU it takes a quarter to a fifth of the time of `argmax`.

    Args:
        scores: (B, K, H, W), any dtype with an order. A pixel with a NaN gets the class of its
            first NaN.

    Returns:
        (B, H, W) scores of the same dtype, and (B, H, W) int64 classes.
    """
    highest, classes = scores.max(1)
    return highest, classes


def classes_of(scores: Tensor) -> Tensor:
    """Return the class with the highest score of every pixel, (B, H, W) int64 (see `best_of`)."""
    return best_of(scores)[1]
