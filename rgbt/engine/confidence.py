"""How probable a network finds every class at every pixel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.engine.evaluate import label_scores
from rgbt.requirements import record_of
from rgbt.types import Batch, View

FAINTEST = 1e-6
"""Smallest sum of semantic scores that shares are taken of."""


def probabilities(
    model: nn.Module,
    batch: Batch,
    fabric: Fabric,
    view: View | None = None,
    heads: Sequence[str | None] = (),
) -> Tensor:
    """(B, K, H', W') float32: probabilities of the classes at every pixel of the labels.

    Of class scores this is their softmax, taken after they were resized (bilinear) to the label, so
    that the most probable class is the one that an evaluation counts.

    Networks that return masks of queries have no class scores in this sense: theirs are sums over
    queries of probabilities of classes and masks (Mask2Former, semantic inference), >= 0 and not
    normalised, and a softmax of them would hardly differ between classes. Here each is divided by
    the sum over classes. That share is low where queries of several classes claim a pixel; it does
    not tell a pixel that queries of one class hardly claim from one that they claim wholly.

    Args:
        model: a network in evaluation mode.
        batch: on the device, images in [0, 1].
        fabric: precision.
        view: what is predicted from; None leaves it to the network.
        heads: which head predicts each image of the batch; () leaves it to the network.
    """
    with torch.inference_mode():
        scores = label_scores(model, batch, fabric, view, heads)
        if record_of(model).outputs == "masks":
            return scores / scores.sum(1, keepdim=True).clamp(min=FAINTEST)
        return scores.softmax(1)
