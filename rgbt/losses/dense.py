"""Losses of dense class scores beside cross-entropy: hard pixels, focal, Lovász-Softmax.

Each is a mean over pixels or images of all devices together. Pixels labelled 255 are left out; a
batch without a labelled pixel costs 0.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.losses.cross_entropy import TINY, ClassPixels, ClassWeights, Computed, CrossEntropy
from rgbt.processes import mean_count
from rgbt.ranges import NonNegative, Power, Share
from rgbt.requirements import LossRecord, Requirement
from rgbt.types import IGNORE, Batch, Output


def pixel_costs(
    output: Output, label: Tensor, class_weights: tuple[float, ...] | None
) -> tuple[Tensor, Tensor]:
    """Return -log of the probability of the label of each pixel, and the weight of its class.

    (B, H, W) float32 each; 0 where the label (B, H, W) is 255.
    """
    assert output.logits is not None, "the record requires scores"
    logits = output.logits.float()
    costs = F.cross_entropy(logits, label, ignore_index=IGNORE, reduction="none")
    labelled = label != IGNORE
    if class_weights is None:
        return costs, labelled.float()
    weights = torch.tensor(class_weights, device=label.device)
    return costs, weights[label.where(labelled, 0)] * labelled


class OhemCrossEntropy(CrossEntropy):
    """Averages the cross-entropy of hard pixels (online hard example mining).

    Of each image those count whose probability of the label is below `threshold`, but at least
    `min_share` of its labelled pixels, the ones that cost most.

    Source: Shrivastava et al. (CVPR 2016), of regions; of pixels as BiSeNet's training does (0.7,
    a sixteenth). It chooses from the batch of a device; here from each image, so that the number of
    devices changes nothing.
    """

    weighs_confidence = False

    def __init__(
        self,
        *,
        threshold: Share,
        min_share: Share,
        class_weights: ClassWeights | Computed | None,
        class_pixels: ClassPixels | None = None,
    ) -> None:
        super().__init__(class_weights=class_weights, class_pixels=class_pixels)
        self.threshold, self.min_share = threshold, min_share

    def __call__(
        self,
        output: Output,
        batch: Batch,
        generator: torch.Generator,  # noqa: ARG002 - what every loss is called with
    ) -> dict[str, Tensor]:
        """Return the part "ohem": one value, shape (1,), float32, of `logits` and `label`."""
        costs, weights = pixel_costs(output, batch.label, self.class_weights)
        chosen = torch.zeros_like(batch.label, dtype=torch.bool)
        easy = -math.log(self.threshold) if self.threshold else math.inf
        for n, label in enumerate(batch.label):
            labelled = costs[n].detach().where(label != IGNORE, -1).flatten()
            least = math.ceil(self.min_share * int((label != IGNORE).sum()))
            hard = labelled > easy
            hard[labelled.topk(least).indices] = True
            chosen[n] = hard.view_as(label)
        count = mean_count((weights * chosen).sum()).clamp(min=TINY)
        return {"ohem": ((weights * costs * chosen).sum() / count).reshape(1)}


class Focal(CrossEntropy):
    """Averages ``-c_y (1 - p_y)^gamma log p_y`` over labelled pixels; c as in cross-entropy.

    Source: Lin et al. (ICCV 2017), Eq. 5, with softmax for sigmoid; gamma 2 there. As printed it is
    not divided by the weights.
    """

    weighs_confidence = False

    def __init__(
        self,
        *,
        gamma: Power,
        class_weights: ClassWeights | Computed | None,
        class_pixels: ClassPixels | None = None,
    ) -> None:
        super().__init__(class_weights=class_weights, class_pixels=class_pixels)
        self.gamma = gamma

    def __call__(
        self,
        output: Output,
        batch: Batch,
        generator: torch.Generator,  # noqa: ARG002 - what every loss is called with
    ) -> dict[str, Tensor]:
        """Return the part "focal": one value, shape (1,), float32, of `logits` and `label`."""
        costs, weights = pixel_costs(output, batch.label, self.class_weights)
        rest = (-torch.expm1(-costs)).clamp(min=TINY)  # 1 - p
        total = (weights * rest**self.gamma * costs).sum()
        count = mean_count((batch.label != IGNORE).sum().float()).clamp(min=1)
        return {"focal": (total / count).reshape(1)}


class LovaszSoftmax:
    """Averages the Lovász extension of 1 - IoU over the classes of an image, then over images.

    Images without a labelled pixel cost 0 and count; `cross_entropy` is the weight of
    cross-entropy beside it (0: none).

    Source: Berman, Triki and Blaschko (CVPR 2018), Eqs. 8, 9 and 11, classes that are present, per
    image.
    """

    def __init__(self, *, cross_entropy: NonNegative) -> None:
        self.weight, self.other = cross_entropy, CrossEntropy(class_weights=None)
        self.record = LossRecord(requires=(Requirement("model", "outputs", "scores"),))

    def __call__(
        self, output: Output, batch: Batch, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Return the parts "lovasz" and "cross_entropy": one value each, shape (1,), float32."""
        assert output.logits is not None, "the record requires scores"
        shares = output.logits.float().softmax(1)
        costs = [
            self.of_image(share[:, label != IGNORE], label[label != IGNORE])
            for share, label in zip(shares, batch.label, strict=True)
        ]
        count = mean_count(shares.new_tensor(len(costs)))
        parts = {"lovasz": (torch.stack(costs).sum() / count).reshape(1)}
        if self.weight:
            other = self.other(output, batch, generator)
            parts |= {name: self.weight * part for name, part in other.items()}
        return parts

    @staticmethod
    def of_image(shares: Tensor, label: Tensor) -> Tensor:
        """Compute the loss of one image of probabilities (K, P) and labels (P,) of its pixels."""
        costs = []
        for index in torch.unique(label).tolist():
            is_class = (label == index).float()
            errors, order = (is_class - shares[index]).abs().sort(descending=True)
            right = is_class[order]
            missed = right.sum() - right.cumsum(0)
            jaccard = 1 - missed / (right.sum() + (1 - right).cumsum(0))
            steps = torch.cat([jaccard[:1], jaccard[1:] - jaccard[:-1]])
            costs.append((errors * steps).sum())
        return torch.stack(costs).mean() if costs else shares.sum() * 0
