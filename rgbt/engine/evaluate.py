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
from rgbt.class_scores import classes_of
from rgbt.engine.prediction import WHOLE, Prediction
from rgbt.requirements import NetworkRecord, record_of
from rgbt.types import Batch, View

FAINTEST = 1e-6  # smallest sum of scores of masks that is a denominator


@torch.inference_mode()
def class_maps(model: nn.Module, batch: Batch, *how: Any, **settings: Any) -> Tensor:
    """Predict the class of every label pixel, (B, H', W') uint8; arguments of `label_scores`."""
    return classes_of(label_scores(model, batch, *how, **settings)).to(torch.uint8)


def shares(scores: Tensor, model: nn.Module) -> Tensor:
    """Turn scores of `label_scores` into probabilities of the classes, (B, K, H', W') float32.

    That is their softmax. Scores of networks that return masks are sums over queries (Mask2Former,
    semantic inference), whose softmax would hardly differ; each is divided by the sum over classes.
    """
    if record_of(model, NetworkRecord).outputs == "masks":
        return scores / scores.sum(1, keepdim=True).clamp(min=FAINTEST)
    return scores.softmax(1)


@torch.inference_mode()
def label_scores(
    model: nn.Module,
    batch: Batch,
    precision: Any,
    view: View | None = None,
    heads: Sequence[str | None] = (),
    settings: Prediction = WHOLE,
) -> Tensor:
    """Predict (B, K, H', W') float32 scores at every label pixel; averaged ones as logarithms.

    Args:
        model: a network in evaluation mode.
        batch: on the device, images in [0, 1].
        precision: object with the context `autocast()` of a forward pass, such as a session.
        view: input images of the prediction; None leaves the choice to the network.
        heads: which head predicts each image of the batch; () leaves it to the network.
        settings: see `Prediction`.

    Raises:
        RunError: a score is NaN or infinite.
    """

    def scores_of(images: Batch) -> Tensor:
        return class_scores(model, images, view, heads)

    def enlarged(scores: Tensor) -> Tensor:
        size, aligned = batch.label.shape[-2:], settings.align_corners
        if scores.shape[-2:] == size:
            return scores
        return F.interpolate(scores, size, mode="bilinear", align_corners=aligned)

    with precision.autocast():
        if settings.averages:
            total = torch.zeros((), device=batch.rgb.device)
            for scale in settings.scales:
                shares = _window_shares(scores_of, _resized(batch, scale), settings)
                total = total + enlarged(shares)
            mean = total / len(settings.scales)
            scores = mean.clamp(min=torch.finfo(torch.float32).tiny).log()
        else:
            scores = enlarged(scores_of(batch).float())
    # One fast pass: a sum is not finite if any score is not. Only then each image is checked.
    suspects = () if scores.sum().isfinite() else zip(batch.name, scores, strict=True)
    for name, of_image in suspects:
        if not of_image.isfinite().all():
            raise RunError(
                f"image '{name}': the network's class scores are NaN or infinite. Use other "
                "weights, or train with a lower optimizer.lr."
            )
    return scores


def class_scores(
    model: nn.Module, batch: Batch, view: View | None = None, heads: Sequence[str | None] = ()
) -> Tensor:
    """Predict (B, K, H, W) scores at the size of the images; arguments as in `label_scores`."""
    options: dict[str, Any] = {} if view is None else {"views": (view,)}
    distinct = tuple(dict.fromkeys(heads))
    if len(distinct) < 2:
        options |= {} if distinct in ((), (None,)) else {"head": distinct[0]}
        scores: Tensor = model(batch.rgb, batch.thermal, **options).logits
        return scores
    # One pass per head over the images that are its own; normalisations do not look at the batch.
    found: dict[str | None, Iterator[Tensor]] = {}
    for head in distinct:
        own = torch.tensor([other == head for other in heads], device=batch.rgb.device)
        output = model(batch.rgb[own], batch.thermal[own], head=head, **options)
        found[head] = iter(output.logits)
    return torch.stack([next(found[head]) for head in heads])


def _resized(batch: Batch, scale: float) -> Batch:
    if scale == 1.0:
        return batch
    height, width = batch.rgb.shape[-2:]
    size = (round(scale * height), round(scale * width))
    rgb = F.interpolate(batch.rgb, size, mode="bilinear")
    return replace(batch, rgb=rgb, thermal=F.interpolate(batch.thermal, size, mode="bilinear"))


def _window_shares(
    scores_of: Callable[[Batch], Tensor], batch: Batch, settings: Prediction
) -> Tensor:
    """Average probabilities of the windows that show a pixel, and of mirrors: (B, K, H, W)."""
    height, width = batch.rgb.shape[-2:]
    window = settings.window_hw or (height, width)
    total: Tensor | None = None
    count = batch.rgb.new_zeros(height, width)
    for rows in windows(height, window[0], settings.window_stride):
        for columns in windows(width, window[1], settings.window_stride):
            rgb, thermal = batch.rgb[..., rows, columns], batch.thermal[..., rows, columns]
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
    """Yield windows of `side` pixels along an axis to its end; source: semseg, test script."""
    side = min(side, length)
    step = math.ceil(side * stride)
    for index in range(math.ceil((length - side) / step) + 1):
        end = min(index * step + side, length)
        yield slice(end - side, end)
