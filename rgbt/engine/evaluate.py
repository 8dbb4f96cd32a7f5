"""Predict batches with a network, without gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.checks import RunError
from rgbt.class_scores import best_of, classes_of
from rgbt.engine.device import Autocast
from rgbt.engine.predicted_scores import label_sized
from rgbt.engine.prediction import WHOLE, Prediction
from rgbt.requirements import record_of
from rgbt.types import Batch, View

FAINTEST = 1e-6
"""Smallest sum of semantic scores used as a denominator."""


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
        return classes_of(label_scores(model, batch, precision, view, heads, settings)).to(
            torch.uint8
        )


def probabilities(
    model: nn.Module,
    batch: Batch,
    precision: Autocast,
    view: View | None = None,
    heads: Sequence[str | None] = (),
    settings: Prediction = WHOLE,
) -> Tensor:
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
        return _shares(label_scores(model, batch, precision, view, heads, settings), model)


def confident_class_maps(
    model: nn.Module,
    batch: Batch,
    precision: Autocast,
    view: View | None = None,
    heads: Sequence[str | None] = (),
    settings: Prediction = WHOLE,
) -> tuple[Tensor, Tensor]:
    """`class_maps`, and the probability (B, H', W') float32 of each of these classes.

    Both are of one pass; see `probabilities` for networks that return masks. Arguments as in
    `class_maps`.
    """
    with torch.inference_mode():
        scores = label_scores(model, batch, precision, view, heads, settings)
        classes = classes_of(scores).to(torch.uint8)
        # The class with the highest score has the highest probability.
        return classes, best_of(_shares(scores, model)).score


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

    Raises:
        RunError: a score is NaN or infinite.
    """
    with torch.inference_mode(), precision.autocast():
        scores = label_sized(
            lambda images: class_scores(model, images, view, heads), batch, settings
        )
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
    found: dict[str | None, Tensor] = {}
    for head in distinct:
        own = torch.tensor([each == head for each in heads], device=batch.rgb.device)
        found[head] = model(batch.rgb[own], batch.thermal[own], head=head, **options).logits
    taken = {head: iter(scores) for head, scores in found.items()}
    return torch.stack([next(taken[head]) for head in heads])
