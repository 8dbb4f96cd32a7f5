"""Class scores of a prediction: mirrored images, sliding windows, scales, enlargement."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.engine.prediction import Prediction
from rgbt.types import Batch

ScoresOf = Callable[[Batch], Tensor]
"""Images -> (B, K, H, W) class scores of their size."""


def label_sized(scores_of: ScoresOf, batch: Batch, settings: Prediction) -> Tensor:
    """(B, K, H', W') float32 scores at every pixel of the labels.

    Averaged probabilities are returned as their logarithms, whose softmax they are.

    Args:
        scores_of: the network.
        batch: its labels give the size.
        settings: see `Prediction`.
    """
    label_hw = (batch.label.shape[-2], batch.label.shape[-1])
    if not settings.averages:
        return _enlarged(scores_of(batch).float(), label_hw, settings)
    total = torch.zeros((), device=batch.rgb.device)
    for scale in settings.scales:
        shares = _window_shares(scores_of, _resized(batch, scale), settings)
        total = total + _enlarged(shares, label_hw, settings)
    mean = total / len(settings.scales)
    return mean.clamp(min=torch.finfo(torch.float32).tiny).log()


def _enlarged(scores: Tensor, size: tuple[int, int], settings: Prediction) -> Tensor:
    if scores.shape[-2:] == size:
        return scores
    return F.interpolate(scores, size=size, mode="bilinear", align_corners=settings.align_corners)


def _resized(batch: Batch, scale: float) -> Batch:
    """The images at `scale` times their size, bilinear; labels as they are."""
    if scale == 1.0:
        return batch
    size = tuple(round(scale * side) for side in batch.rgb.shape[-2:])
    rgb, thermal = (
        F.interpolate(each, size=size, mode="bilinear", align_corners=False)
        for each in (batch.rgb, batch.thermal)
    )
    return replace(batch, rgb=rgb, thermal=thermal)


def _window_shares(scores_of: ScoresOf, batch: Batch, settings: Prediction) -> Tensor:
    """(B, K, H, W): mean probabilities of the windows that show a pixel."""
    height, width = batch.rgb.shape[-2:]
    window = settings.window_hw or (height, width)
    total: Tensor | None = None
    count = batch.rgb.new_zeros(height, width)
    for rows in windows(height, window[0], settings.window_stride):
        for columns in windows(width, window[1], settings.window_stride):
            part = replace(
                batch, rgb=batch.rgb[..., rows, columns], thermal=batch.thermal[..., rows, columns]
            )
            shares = _shares(scores_of, part, mirrored=settings.mirrored)
            if total is None:
                total = shares.new_zeros(*shares.shape[:2], height, width)
            total[..., rows, columns] += shares
            count[rows, columns] += 1
    assert total is not None, "there is a window"
    return total / count


def windows(length: int, side: int, stride: float) -> Iterator[slice]:
    """Windows of `side` pixels along an axis; the last one ends at its end.

    Source: semseg, test script: steps of ceil(stride side), at most one more window than fits.

    Example:
        >>> [(each.start, each.stop) for each in windows(10, 6, 2 / 3)]
        [(0, 6), (4, 10)]
    """
    side = min(side, length)
    step = math.ceil(side * stride)
    for index in range(math.ceil((length - side) / step) + 1):
        end = min(index * step + side, length)
        yield slice(end - side, end)


def _shares(scores_of: ScoresOf, batch: Batch, *, mirrored: bool) -> Tensor:
    """(B, K, H, W) float32 probabilities, averaged with those of the mirrored images."""
    shares = scores_of(batch).float().softmax(1)
    if not mirrored:
        return shares
    other = replace(batch, rgb=batch.rgb.flip(-1), thermal=batch.thermal.flip(-1))
    return (shares + scores_of(other).float().softmax(1).flip(-1)) / 2
