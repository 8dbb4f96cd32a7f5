"""Weights by distance from the image centre for the mask losses (SpatialSeg, Eqs. 14-17).

Also the edge-weighted loss that SpatialSeg, Table I compares with: by the boundaries of objects.

Part of the set criterion. The SpatialSeg release holds no code for this loss; every choice that
the paper leaves open is a named setting here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.geometry.padding import pad_to
from rgbt.losses.points import sample
from rgbt.ranges import NonNegative
from rgbt.types import IGNORE, Batch


@dataclass(frozen=True, kw_only=True)
class SpatialWeight:
    """Holds the settings of the spatial-weighted mask losses; the default is the plain loss.

        w = 1 + alpha d / d_max            focus "edge"    (Eqs. 14, 15)
        w = 1 + alpha (1 - d / d_max)      focus "center"  (Table VI, reversed)
        w = 1 + alpha b                    focus "boundary" (Table I, edge-weighted loss)

    b is 1 on the boundaries of objects (`boundaries`), and 0 elsewhere; the paper names this loss
    ("conventional"), and prints neither formula nor numbers. It reads no position: `centre` and
    `d_max` have no effect.

    d is the distance in pixels of the original image from pixel (rows // 2, columns // 2) of it,
    followed through resizing, cropping and flipping, or of the crop. Paper: alpha is 2, everything
    below `focus` is open; the default of each is the choice nearest to the text or to Mask2Former.
    With ``alpha: 0`` or ``focus: none`` the loss is the plain one whatever the other settings are.
    """

    alpha: NonNegative = 0.0
    focus: Literal["none", "edge", "center", "boundary"] = "none"
    centre: Literal["tracked", "crop"] = "tracked"
    d_max: Literal["original", "crop"] = "original"
    padding: Literal["map", "one", "zero"] = "map"
    normaliser: Literal["points", "weights"] = "points"  # Eq. 16 divides by W x H
    dice_smoothing: Literal["one", "none"] = "one"  # Eq. 17 has none
    match: Literal["unweighted", "weighted"] = "unweighted"
    passes: Literal["all", "fused"] = "all"

    @property
    def active(self) -> bool:
        """Say whether the loss differs from the plain one at all."""
        return self.alpha > 0 and self.focus != "none"


PLAIN = SpatialWeight()


class PointWeights(NamedTuple):
    """Holds weights of the points of some masks, and what the losses need beside them."""

    values: Tensor  # (..., N)
    total: Tensor  # (...), what the weighted cross-entropy is divided by
    smoothing: Tensor  # (...), added to numerator and denominator of the dice term


def weight_map(batch: Batch, padded_hw: tuple[int, int], settings: SpatialWeight) -> Tensor:
    """Compute the weight of every pixel of a crop padded at the bottom and right.

    (B, 1, *padded_hw) float32; the settings are active. SpatialSeg, Eqs. 14 and 15; see
    `SpatialWeight`.

    Raises:
        InputError: the batch does not say where its pixels come from.
    """
    if settings.focus == "boundary":
        relative = boundaries(batch.label).float()
    elif batch.position is None:
        raise InputError(
            "loss.spatial weights pixels by their position in the original image, which this "
            "transform does not track. Set transform.track_position=true or loss.spatial.alpha=0."
        )
    else:
        original = batch.original_hw.to(batch.position)
        centre = torch.div(original, 2, rounding_mode="floor")
        if settings.centre == "crop":
            height, width = batch.position.shape[2:]
            centre = batch.position[:, :, height // 2, width // 2]
        distance = torch.linalg.vector_norm(batch.position - centre[:, :, None, None], dim=1)
        farthest = torch.maximum(centre, original - 1 - centre).norm(dim=1)
        if settings.d_max == "crop":
            farthest = distance.amax((1, 2))
        relative = distance / farthest[:, None, None]
        if settings.focus == "center":
            relative = 1 - relative
    far = 1.0 + settings.alpha if settings.focus == "edge" else 1.0
    padding = {"map": far, "one": 1.0, "zero": 0.0}[settings.padding]
    return pad_to(1 + settings.alpha * relative, padded_hw, padding)[:, None]


def boundaries(label: Tensor) -> Tensor:
    """Find labelled pixels of (B, H, W) int64 with another class beside them: (B, H, W) bool.

    Eight neighbours count. Both sides of a boundary do, so it is two pixels wide. The border of the
    image and pixels without a label (255) make no boundary.
    """
    known = label != IGNORE
    # Where nothing is known, the largest neighbour is below and the smallest above every class.
    values = label.float()[:, None]
    low = values.masked_fill(~known[:, None], torch.inf)
    high = values.masked_fill(~known[:, None], -torch.inf)
    largest = F.max_pool2d(high, 3, stride=1, padding=1)[:, 0]
    smallest = -F.max_pool2d(-low, 3, stride=1, padding=1)[:, 0]
    return known & (largest > smallest)


class SpatialMap:
    """Reads the weights of one batch at points; see `weight_map`.

    `num_passes` is P, stacked passes of the batch, for `passes: fused`: the clean RGB-T pass is the
    first; a masked RGB-T pass, if any, is the last, after one or three clean ones.
    """

    def __init__(
        self, batch: Batch, padded_hw: tuple[int, int], *, settings: SpatialWeight, num_passes: int
    ) -> None:
        self.map_B1HW = weight_map(batch, padded_hw, settings)
        self.settings = settings
        weighted_P = torch.ones(num_passes, dtype=torch.bool)
        if settings.passes == "fused":
            weighted_P[1:] = False
            weighted_P[-1] = num_passes % 2 == 0 or num_passes == 1
        self.weighted_P = weighted_P.to(self.map_B1HW.device)

    def at(self, points: Tensor, image: Tensor, first_set: int) -> PointWeights:
        """Read weights at points (S, G, N, 2), see `rgbt.losses.points`.

        `image` (G,) int64 says which image of the batch each of the G columns belongs to;
        `first_set` is the number of the first of the S sets; pass = set modulo P.
        """
        maps = self.map_B1HW[image]
        values = sample(maps, points.transpose(0, 1), outside="border")[:, 0].transpose(0, 1)
        sets = torch.arange(first_set, first_set + len(points), device=points.device)
        weighted = self.weighted_P[sets % len(self.weighted_P)][:, None]
        values = torch.where(weighted[..., None], values, 1.0)
        count = torch.full_like(values[..., 0], values.shape[-1])
        total = values.sum(-1) if self.settings.normaliser == "weights" else count
        smoothing = torch.ones_like(count)
        if self.settings.dice_smoothing == "none":
            smoothing = smoothing.masked_fill(weighted, 0.0)
        return PointWeights(values, total, smoothing)
