"""Predictions of a network over batches: no gradients, no scores, no logging."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.types import Batch, View


class Prediction(NamedTuple):
    """A batch, on the CPU, and the class index of every pixel of its labels: (B, H', W') uint8."""

    batch: Batch
    classes: Tensor


def predictions(
    model: nn.Module,
    batches: Iterable[Batch],
    fabric: Fabric,
    view: View | None = None,
) -> Iterator[Prediction]:
    """Class maps at the resolution of the labels, batch by batch.

    Class scores are resized (bilinear) to the label before the argmax where the transform resized
    the images, so that scores always count the pixels of the file.

    Args:
        model: a network; put into evaluation mode here and left in it.
        batches: from `rgbt.data.loaders.eval_batches`.
        fabric: device and precision.
        view: what is predicted from; None leaves it to the network.
    """
    model.eval()
    for batch in batches:
        yield Prediction(batch, class_maps(model, batch.to(fabric.device), fabric, view).cpu())


def class_maps(model: nn.Module, batch: Batch, fabric: Fabric, view: View | None = None) -> Tensor:
    """(B, H', W') uint8: class index of every pixel of the labels of one batch.

    Args:
        model: a network in evaluation mode.
        batch: on the device, images in [0, 1].
        fabric: precision.
        view: what is predicted from; None leaves it to the network.
    """
    asked = {} if view is None else {"views": (view,)}
    with torch.inference_mode(), fabric.autocast():
        scores = model(batch.rgb, batch.thermal, **asked).logits.float()
        label_hw = batch.label.shape[-2:]
        if scores.shape[-2:] != label_hw:
            scores = F.interpolate(scores, size=label_hw, mode="bilinear", align_corners=False)
        classes: Tensor = scores.argmax(1).to(torch.uint8)
    return classes
