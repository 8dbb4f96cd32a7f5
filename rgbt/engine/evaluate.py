"""Predict batches with a network, without gradients: heads, mirrored images, windows, scales."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import RunError
from rgbt.class_scores import best_of, classes_of
from rgbt.engine.device import Autocast
from rgbt.engine.prediction import WHOLE, Prediction
from rgbt.requirements import record_of
from rgbt.types import Batch, View

FAINTEST = 1e-6
"""Smallest sum of semantic scores used as a denominator."""

ScoresOf = Callable[[Batch], Tensor]
"""Images -> (B, K, H, W) class scores of their size."""


def class_maps(
    model: nn.Module,
    batch: Batch,
    precision: Autocast,
    view: View | None = None,
    heads: Sequence[str | None] = (),
    settings: Prediction = WHOLE,
) -> Tensor:
    """(B, H', W') uint8: class index of every pixel of the labels of one batch.

    Where the transform resized the images, their class scores are resized (bilinear) to the label
    before classes are taken, so that scores always count the pixels of the file.

    Args:
        model: a network in evaluation mode.
        batch: on the device, images in [0, 1].
        precision: of the forward pass, such as a session.
        view: input images of the prediction; None leaves the choice to the network.
        heads: which head predicts each image of the batch; () leaves it to the network.
        settings: mirrored images, windows and the enlargement of the scores.
    """
    with torch.inference_mode():
        scores = label_scores(model, batch, precision, view, heads, settings)
        return classes_of(scores).to(torch.uint8)


def probabilities(model: nn.Module, batch: Batch, *how: Any, **settings: Any) -> Tensor:
    """(B, K, H', W') float32: probabilities of the classes; arguments as in `class_maps`.

    Of class scores this is their softmax, taken after they were resized (bilinear) to the label, so
    that the most probable class is the one that an evaluation counts.

    Networks that return masks of queries have no class scores in this sense: theirs are sums over
    queries of probabilities of classes and masks (Mask2Former, semantic inference), >= 0 and not
    normalised, and a softmax of them would hardly differ between classes. Here each is divided by
    the sum over classes. That share is low where queries of several classes claim a pixel; it does
    not tell a pixel that queries of one class hardly claim from one that they claim wholly.
    """
    with torch.inference_mode():
        return _shares(label_scores(model, batch, *how, **settings), model)


def confident_class_maps(
    model: nn.Module, batch: Batch, *how: Any, **settings: Any
) -> tuple[Tensor, Tensor]:
    """`class_maps`, and the probability (B, H', W') float32 of each of these classes.

    Both are of one pass; see `probabilities` for networks that return masks. Arguments as in
    `class_maps`.
    """
    with torch.inference_mode():
        scores = label_scores(model, batch, *how, **settings)
        # The class with the highest score has the highest probability.
        return classes_of(scores).to(torch.uint8), best_of(_shares(scores, model)).score


def _shares(scores: Tensor, model: nn.Module) -> Tensor:
    """Class scores (B, K, H, W) as probabilities, see `probabilities`."""
    if record_of(model).outputs == "masks":
        return scores / scores.sum(1, keepdim=True).clamp(min=FAINTEST)
    return scores.softmax(1)


def label_scores(
    model: nn.Module,
    batch: Batch,
    precision: Autocast,
    view: View | None = None,
    heads: Sequence[str | None] = (),
    settings: Prediction = WHOLE,
) -> Tensor:
    """(B, K, H', W') float32 scores at every pixel of the labels; arguments as in `class_maps`.

    Averaged probabilities are returned as their logarithms, whose softmax they are.

    Raises:
        RunError: a score is NaN or infinite.
    """

    def scores_of(images: Batch) -> Tensor:
        return class_scores(model, images, view, heads)

    label_hw = (batch.label.shape[-2], batch.label.shape[-1])
    with torch.inference_mode(), precision.autocast():
        if settings.averages:
            total = torch.zeros((), device=batch.rgb.device)
            for scale in settings.scales:
                shares = _window_shares(scores_of, _resized(batch, scale), settings)
                total = total + _enlarged(shares, label_hw, settings)
            mean = total / len(settings.scales)
            scores = mean.clamp(min=torch.finfo(torch.float32).tiny).log()
        else:
            scores = _enlarged(scores_of(batch).float(), label_hw, settings)
        # One fast pass: a sum is not finite if any score is not. Only then each image is checked.
        if bool(scores.sum().isfinite()):
            return scores
        finite = scores.isfinite().flatten(1).all(1).tolist()
    for name, is_finite in zip(batch.name, finite, strict=True):
        if not is_finite:
            raise RunError(
                f"image '{name}': the network's class scores are NaN or infinite, so the image "
                "cannot be counted. Use a checkpoint of an earlier step or other weights, or "
                "train again with a lower optimizer.lr."
            )
    return scores


def class_scores(
    model: nn.Module, batch: Batch, view: View | None = None, heads: Sequence[str | None] = ()
) -> Tensor:
    """(B, K, H, W) scores at the size of the images; arguments as in `class_maps`."""
    options: dict[str, Any] = {} if view is None else {"views": (view,)}
    distinct = tuple(dict.fromkeys(heads))
    if len(distinct) < 2:
        options |= {} if distinct in ((), (None,)) else {"head": distinct[0]}
        scores: Tensor = model(batch.rgb, batch.thermal, **options).logits
        return scores
    # One pass per head over the images that are its own; normalisations do not look at the batch.
    found: dict[str | None, Iterator[Tensor]] = {}
    for head in distinct:
        own = torch.tensor([each == head for each in heads], device=batch.rgb.device)
        output = model(batch.rgb[own], batch.thermal[own], head=head, **options)
        found[head] = iter(output.logits)
    return torch.stack([next(found[head]) for head in heads])


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
    """(B, K, H, W) float32: mean probabilities of the windows that show a pixel, and of mirrors."""
    height, width = batch.rgb.shape[-2:]
    window = settings.window_hw or (height, width)
    total: Tensor | None = None
    count = batch.rgb.new_zeros(height, width)
    for rows in windows(height, window[0], settings.window_stride):
        for columns in windows(width, window[1], settings.window_stride):
            rgb, thermal = (each[..., rows, columns] for each in (batch.rgb, batch.thermal))
            shares = scores_of(replace(batch, rgb=rgb, thermal=thermal)).float().softmax(1)
            if settings.mirrored:
                mirrored = replace(batch, rgb=rgb.flip(-1), thermal=thermal.flip(-1))
                shares = (shares + scores_of(mirrored).float().softmax(1).flip(-1)) / 2
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
