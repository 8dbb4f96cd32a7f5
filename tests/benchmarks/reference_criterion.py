"""The set criterion as the releases run it: pass by pass, layer by layer, image by image.

Independent of `rgbt.losses.set_criterion` in everything but the settings and the weight map; it is
what the batched criterion is compared with, in value (tests) and in time (benchmarks).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn import functional as F

from rgbt.geometry.padding import pad_to
from rgbt.losses.set_criterion import SetCriterion
from rgbt.losses.spatial import PLAIN, SpatialWeight, weight_map
from rgbt.types import IGNORE, Batch, Output


class Replayed:
    """Stated draws: in order for the batched criterion, by (layer, pass) for the reference.

    Args:
        matcher: (L * P, B, N, 2) in [-1, 1], layer-major.
        loss: (L * P, G, N', 2) in [-1, 1]; candidates, then random remainder.
        passes: P.
    """

    def __init__(self, matcher: Tensor, loss: Tensor, passes: int) -> None:
        self._matcher, self._loss, self._passes = matcher, loss, passes
        self._next = {"matcher": 0, "loss": 0}

    def matcher(self, num_sets: int, num_images: int, num_points: int) -> Tensor:
        return self._take("matcher", self._matcher, (num_sets, num_images, num_points, 2))

    def loss(self, num_sets: int, num_masks: int, num_points: int, kept: object = None) -> Tensor:
        del kept  # of one process: all of them
        return self._take("loss", self._loss, (num_sets, num_masks, num_points, 2))

    def matcher_of(self, layer: int, one_pass: int) -> Tensor:
        return self._matcher[layer * self._passes + one_pass]

    def loss_of(self, layer: int, one_pass: int) -> Tensor:
        return self._loss[layer * self._passes + one_pass]

    def one_pass(self, index: int) -> Replayed:
        """The draws of pass `index` alone."""
        one = slice(index, None, self._passes)
        return Replayed(self._matcher[one], self._loss[one], 1)

    def _take(self, name: str, draws: Tensor, shape: tuple[int, ...]) -> Tensor:
        start = self._next[name]
        self._next[name] += shape[0]
        taken = draws[start : start + shape[0]]
        assert taken.shape == shape, f"{name}: asked for {shape}, got {tuple(taken.shape)}"
        return taken


@dataclass(frozen=True)
class _Image:
    """One image's targets and, for the weighted loss, the weights of its pixels."""

    labels: Tensor
    masks: Tensor
    weights: Tensor | None


def reference_criterion(
    criterion: SetCriterion, output: Output, batch: Batch, draws: Replayed
) -> dict[str, Tensor]:
    """The weighted parts "class", "mask", "dice", each (P,), as `criterion` returns them."""
    class_logits, mask_logits = output.aux["class_logits"], output.aux["mask_logits"]
    layers, passes = class_logits.shape[:2]
    padded_hw = (4 * mask_logits.shape[-2], 4 * mask_logits.shape[-1])
    images = _images(criterion, batch, padded_hw)
    totals = []
    for one_pass in range(passes):
        spatial = _spatial_of_pass(criterion.spatial, one_pass, passes)
        parts = torch.zeros(3)
        for layer in range(0 if criterion.deep_supervision else layers - 1, layers):
            prediction = (class_logits[layer, one_pass], mask_logits[layer, one_pass])
            points = draws.matcher_of(layer, one_pass), draws.loss_of(layer, one_pass)
            parts = parts + _layer(criterion, prediction, images, points, spatial)
        totals.append(parts)
    total = torch.stack(totals)
    return {
        name: weight * total[:, i]
        for i, (name, weight) in enumerate(criterion.part_weights.items())
    }


def _images(criterion: SetCriterion, batch: Batch, padded_hw: tuple[int, int]) -> list[_Image]:
    weights = None
    if criterion.spatial.active:
        weights = weight_map(batch, padded_hw, criterion.spatial)
    images = []
    for index, label in enumerate(pad_to(batch.label, padded_hw, IGNORE)):
        labels = torch.tensor([v for v in label.unique().tolist() if v != IGNORE], dtype=torch.long)
        masks = (
            torch.stack([label == v for v in labels]) if len(labels) else torch.zeros(0, *padded_hw)
        )
        images.append(_Image(labels, masks.float(), None if weights is None else weights[index]))
    return images


def _spatial_of_pass(spatial: SpatialWeight, one_pass: int, passes: int) -> SpatialWeight:
    fused = {1: [0], 2: [0, 1], 3: [0], 4: [0, 3]}
    if spatial.passes == "fused" and one_pass not in fused[passes]:
        return PLAIN
    return spatial


def _layer(
    criterion: SetCriterion,
    prediction: tuple[Tensor, Tensor],
    images: list[_Image],
    points: tuple[Tensor, Tensor],
    spatial: SpatialWeight,
) -> Tensor:
    """Class, mask and dice loss of one layer of one pass, not weighted."""
    class_BQC, mask_BQhw = prediction
    matcher_points, loss_points = points
    target_classes = torch.full(class_BQC.shape[:2], criterion.num_classes)
    logits, masks, maps, rows, first = [], [], [], [], 0
    for b, image in enumerate(images):
        match_spatial = spatial if spatial.match == "weighted" else PLAIN
        cost = _costs(
            criterion, class_BQC[b], mask_BQhw[b], image, matcher_points[b], match_spatial
        )
        queries, targets = map(torch.as_tensor, linear_sum_assignment(cost.cpu()))
        target_classes[b, queries] = image.labels[targets]
        logits.append(mask_BQhw[b, queries])
        masks.append(image.masks[targets])
        maps += [image.weights] * len(targets)
        rows.append(first + targets)
        first += len(image.labels)
    class_weights = torch.ones(criterion.num_classes + 1)
    class_weights[-1] = criterion.no_object_weight
    class_loss = F.cross_entropy(class_BQC.transpose(1, 2), target_classes, class_weights)
    if not maps:
        return torch.stack([class_loss, 0 * mask_BQhw.sum(), 0 * mask_BQhw.sum()])
    chosen = torch.cat(logits)
    where = _loss_points(criterion, chosen.detach(), loss_points[torch.cat(rows)])
    x, t = _at(chosen[:, None], where)[:, 0], _at(torch.cat(masks)[:, None], where)[:, 0]
    w = _weights_at(maps, where, spatial)
    mask, dice = _mask_and_dice(x, t, w, spatial)
    count = max(first, 1)
    return torch.stack([class_loss, mask.sum() / count, dice.sum() / count])


def _at(maps: Tensor, points: Tensor, outside: str = "zeros") -> Tensor:
    return F.grid_sample(maps, points[:, :, None], padding_mode=outside, align_corners=False)[
        ..., 0
    ]


def _weights_at(maps: list[Tensor], points: Tensor, spatial: SpatialWeight) -> Tensor:
    if not spatial.active:
        return torch.ones(points.shape[:2])
    return _at(torch.stack(maps), points, "border")[:, 0]


@torch.no_grad()
def _costs(
    criterion: SetCriterion,
    class_QC: Tensor,
    mask_Qhw: Tensor,
    image: _Image,
    points: Tensor,
    spatial: SpatialWeight,
) -> Tensor:
    """(Q, M) matching costs of one image."""
    x = _at(mask_Qhw[None], points[None])[0]
    t = (
        _at(image.masks[None], points[None])[0]
        if len(image.labels)
        else torch.zeros(0, len(points))
    )
    w = _weights_at([image.weights], points[None], spatial)[0]
    total = w.sum() if spatial.normaliser == "weights" else len(w)
    positive = F.binary_cross_entropy_with_logits(x, torch.ones_like(x), reduction="none")
    negative = F.binary_cross_entropy_with_logits(x, torch.zeros_like(x), reduction="none")
    bce = ((w * positive) @ t.T + (w * negative) @ (1 - t).T) / total
    s = x.sigmoid()
    e = 0.0 if spatial.active and spatial.dice_smoothing == "none" else 1.0
    dice = 1 - (2 * (w * s) @ t.T + e) / ((w * s).sum(1)[:, None] + (w * t).sum(1) + e)
    probability = class_QC.softmax(-1)[:, image.labels]
    weights = criterion.part_weights
    return weights["mask"] * bce + weights["dice"] * dice - weights["class"] * probability


@torch.no_grad()
def _loss_points(criterion: SetCriterion, logits_Mhw: Tensor, drawn: Tensor) -> Tensor:
    number = criterion.num_candidates
    candidates, fresh = drawn[:, :number], drawn[:, number:]
    uncertainty = -_at(logits_Mhw[:, None], candidates)[:, 0].abs()
    index = uncertainty.topk(criterion.num_kept, dim=1).indices
    kept = torch.stack([row[i] for row, i in zip(candidates, index, strict=True)])
    return torch.cat([kept, fresh], dim=1)


def _mask_and_dice(
    x: Tensor, t: Tensor, w: Tensor, spatial: SpatialWeight
) -> tuple[Tensor, Tensor]:
    total = w.sum(1) if spatial.normaliser == "weights" else float(x.shape[1])
    e = 0.0 if spatial.active and spatial.dice_smoothing == "none" else 1.0
    bce = (w * F.binary_cross_entropy_with_logits(x, t, reduction="none")).sum(1) / total
    s = x.sigmoid()
    dice = 1 - (2 * (w * s * t).sum(1) + e) / ((w * s).sum(1) + (w * t).sum(1) + e)
    return bce, dice
