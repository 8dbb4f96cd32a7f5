"""Assign queries to the classes of an image: costs on the device, assignment on the CPU.

Part of the set criterion. All (layer, pass, image) problems of a step are solved together: their
costs are computed where the predictions are and reach the CPU in one transfer.
Letters beyond `rgbt.types`: ``S`` sets, one per (layer, pass), layer-major; ``N`` points; ``G``
targets of the batch: one per class present in an image, by image, then by class.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import RunError
from rgbt.geometry.padding import pad_to
from rgbt.losses.points import EVERY, Points, class_shares, sample
from rgbt.losses.spatial import PointWeights, SpatialMap
from rgbt.processes import num_processes, rank, whole
from rgbt.types import IGNORE

CHUNK_BYTES = 16 * 2**20
"""About what the largest temporary of a step may take. Larger ones leave the processor's cache."""


class Targets(NamedTuple):
    """The targets of one batch.

    Attributes:
        label: (B, H, W) int64, padded with 255. Padded and ignored pixels belong to no class and
            are ordinary negatives of every mask, as released.
        present: (B, K) bool, classes that occur.
        unknown: () bool, whether a label is neither a class nor 255.
        spatial: weights of the pixels; None for the plain loss.
    """

    label: Tensor
    present: Tensor
    unknown: Tensor
    spatial: SpatialMap | None


class Matches(NamedTuple):
    """The assignment, on the CPU.

    Attributes:
        image: (G,) int64, image of each target.
        label: (G,) int64, class of each target.
        query: (S, G) int64, query matched to each target; -1 where targets outnumber queries.
        place: which of the targets of all processes these are: their numbers, (G,) int64.
        num_targets: how many these are.
    """

    image: NDArray[np.int64]
    label: NDArray[np.int64]
    query: NDArray[np.int64]
    place: Tensor | slice
    num_targets: int


def targets_of(
    label: Tensor, padded_hw: tuple[int, int], num_classes: int, spatial: SpatialMap | None
) -> Targets:
    """Targets of labels (B, H, W) int64, padded at the bottom and right to `padded_hw`."""
    # One column per label value -1 (anything below 0) to 256 (anything above 255).
    seen = torch.zeros(len(label), IGNORE + 3, dtype=torch.bool, device=label.device)
    seen.scatter_(1, label.flatten(1).clamp(-1, IGNORE + 1) + 1, True)
    present = seen[:, 1 : num_classes + 1].clone()
    seen[:, 1 : num_classes + 1] = False
    seen[:, IGNORE + 1] = False
    return Targets(pad_to(label, padded_hw, IGNORE), present, seen.any(), spatial)


@dataclass(frozen=True, kw_only=True)
class Matcher:
    """Hungarian matching on class, mask and dice costs at random points.

        cost = -a softmax(class)[c] + b BCE + d (1 - (2 sum(s t) + e) / (sum(s) + sum(t) + e))

    with s the sigmoid of the mask logits and e = 1. BCE is the mean over points of
    ``softplus(x) - x t``. One set of points per image, shared by its queries and targets, is drawn
    for every layer and pass.

    Source: Mask2Former, Sec. 3.3 and matcher.py.

    Attributes:
        num_points: N.
        class_weight: a.
        mask_weight: b.
        dice_weight: d.
    """

    num_points: int
    class_weight: float
    mask_weight: float
    dice_weight: float

    @torch.no_grad()
    def __call__(
        self, class_logits: Tensor, mask_logits: Tensor, targets: Targets, points: Points
    ) -> Matches:
        """Match every layer, pass and image.

        (L, P, B, Q, K+1) class and (L, P, B, Q, h, w) mask logits against the targets of the B
        images, at points from `points`. Errors as of `assign`.
        """
        layers, passes, images, queries = class_logits.shape[:4]
        step = max(1, CHUNK_BYTES // (4 * images * queries * self.num_points))
        costs = []
        for layer, start in product(range(layers), range(0, passes, step)):
            block = slice(start, start + step)
            probability = class_logits[layer, block].float().softmax(-1)[..., :-1]
            masks = mask_logits[layer, block]
            drawn = points.matcher(len(masks), images, self.num_points)
            cost = self._mask_costs(masks, targets, drawn, layer * passes + start)
            costs.append(cost - self.class_weight * probability)
        return assign(torch.cat(costs), targets)

    def _mask_costs(
        self, logits_SBQhw: Tensor, targets: Targets, points: Tensor, first: int
    ) -> Tensor:
        """(S, B, Q, K) costs of mask and dice."""
        x = sample(logits_SBQhw.flatten(0, 1).float(), points.flatten(0, 1)[:, None])[:, :, 0]
        t = class_shares(targets.label, points, targets.present.shape[1]).flatten(0, 1)
        weights = None
        if targets.spatial is not None and targets.spatial.settings.match == "weighted":
            every_image = torch.arange(points.shape[1], device=points.device)
            weights = targets.spatial.at(points, every_image, first)
            weights = PointWeights(*(part.flatten(0, 1) for part in weights))
            t = t * weights.values[:, None]
        cost = pairwise_costs(x, t, weights, self.mask_weight, self.dice_weight)
        return cost.reshape(*points.shape[:2], *cost.shape[1:])


def pairwise_costs(
    x: Tensor, t: Tensor, weights: PointWeights | None, mask_weight: float, dice_weight: float
) -> Tensor:
    """(R, Q, K): mask and dice cost of every query against every target (formula: `Matcher`).

    Args:
        x: (R, Q, N) float32 mask logits at points; overwritten.
        t: (R, K, N) float32 targets there, already weighted where `weights` is given.
        weights: (R, N) weights of the points and their sums; None for the plain cost.
        mask_weight: b.
        dice_weight: d.
    """
    total: Tensor | float = x.shape[-1]
    smoothing: Tensor | float = 1.0
    if weights is not None:
        total, smoothing = weights.total[:, None, None], weights.smoothing[:, None, None]

    def over_points(values: Tensor) -> Tensor:
        if weights is None:
            return values.sum(-1, keepdim=True)
        return values @ weights.values[..., None]

    bce = (over_points(F.softplus(x)) - x @ t.mT) / total
    s = x.sigmoid_()
    dice = (2 * (s @ t.mT) + smoothing) / (over_points(s) + t.sum(-1)[:, None] + smoothing)
    return mask_weight * bce + dice_weight * (1 - dice)


def assign(cost: Tensor, targets: Targets) -> Matches:
    """Cheapest assignment of queries to the classes present, for every set and image.

    `cost` is (S, B, Q, K) float32 on any device.

    Raises:
        RunError: a cost that is not finite.
        ValueError: a label that is neither a class nor 255.
    """
    parts = [cost.flatten(), whole(targets.present).flatten(), targets.unknown.reshape(1)]
    numbers = torch.cat([part.float() for part in parts]).cpu().numpy()
    cost_SBQK = numbers[: cost.numel()].reshape(cost.shape)
    # Of the images of all processes.
    present_BK = numbers[cost.numel() : -1].reshape(-1, targets.present.shape[1]) > 0
    if numbers[-1]:
        raise ValueError(
            f"label: expected 0 to {present_BK.shape[1] - 1} or {IGNORE}, got another value."
        )
    if not np.isfinite(cost_SBQK).all():
        raise RunError(
            "the matching cost is not finite, because the predictions hold NaN or infinity."
        )

    image, label = np.nonzero(present_BK)
    num_targets = len(image)
    place: Tensor | slice = EVERY
    if num_processes() > 1:
        own_targets = np.flatnonzero(image % num_processes() == rank())
        image, label = image[own_targets] // num_processes(), label[own_targets]
        place = torch.from_numpy(own_targets).to(cost.device)
    from scipy.optimize import linear_sum_assignment  # half a second, and only training matches

    query = np.full((len(cost_SBQK), len(image)), -1)
    for one_image in np.unique(image):
        columns = np.flatnonzero(image == one_image)
        for one_set, cost_QK in enumerate(cost_SBQK[:, one_image]):
            rows, chosen = linear_sum_assignment(cost_QK[:, label[columns]])
            query[one_set, columns[chosen]] = rows
    return Matches(image, label, query, place, num_targets)
