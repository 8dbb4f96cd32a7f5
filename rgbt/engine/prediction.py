"""Settings of a prediction: mirrored images, sliding windows, scales, enlargement of scores."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import torch
from annotated_types import Interval, Len
from torch import Tensor
from torch.nn import functional as F

from rgbt.ranges import Size
from rgbt.requirements import Record, Requirement
from rgbt.types import Batch

ScoresOf = Callable[[Batch], Tensor]
"""Images -> (B, K, H, W) class scores of their size."""

Scales = Annotated[tuple[Annotated[float, Interval(ge=0.1, le=4)], ...], Len(1, 16)]
"""Factors of the size of an image."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """How an image is predicted in evaluation, and the size at which its classes are counted.

    Source: thesis (J. Sun), its code, for everything named "released"; semseg (PSPNet), its test
    script, for windows, scales and mirrored images.

    Attributes:
        align_corners: whether class scores are enlarged to the label with corners aligned.
            Released (networks with two heads): true.
        mirrored: whether class probabilities are averaged with those of the mirrored image.
            Released (maximum squares) and semseg: true.
        scales: sizes of the image relative to that of the transform; the probabilities of all are
            enlarged to the label and averaged. semseg: (1.0,).
        window_hw: rows and columns of sliding windows in pixels, at most those of the image; null
            predicts the whole image at once. semseg: the size of its training crops.
        window_stride: step between windows as a share of their side, in (0, 1]. semseg: 2/3.
        enlarged: what is enlarged to the size of the label: "scores", or "released": the class
            numbers, bilinearly and rounded, so that a border may get a third class (maximum
            squares).
        counted: where classes are compared with labels: at the size of the "label" file; or at that
            of the "image" that the network sees, with the label made smaller by `label_resize`.
            Released (port of HeatNet): "image".
        label_resize: "nearest" (HeatNet's release) or "bilinear" (thesis' port, mixes class
            numbers); used with counted="image".
    """

    align_corners: bool = False
    mirrored: bool = False
    scales: Scales = (1.0,)
    window_hw: Size | None = None
    window_stride: Annotated[float, Interval(ge=0.05, le=1)] = 2 / 3
    enlarged: Literal["scores", "released"] = "scores"
    counted: Literal["label", "image"] = "label"
    label_resize: Literal["nearest", "bilinear"] = "nearest"

    @property
    def averages(self) -> bool:
        """Whether a prediction is the mean of the probabilities of several passes."""
        return self.mirrored or self.window_hw is not None or self.scales != (1.0,)

    @property
    def record(self) -> Record:
        """Class scores where probabilities are averaged."""
        keys = {"mirrored": self.mirrored, "window_hw": self.window_hw, "scales": self.averages}
        cause = f"prediction.{next((key for key, value in keys.items() if value), '')}"
        needed = (Requirement("model", "outputs", "scores", cause),) if self.averages else ()
        return Record(requires=needed)


WHOLE = Prediction()
"""One pass over the whole image; classes are counted at the size of the label."""


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
