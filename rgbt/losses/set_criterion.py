"""The set criterion of Mask2Former with SpatialSeg's weights, for all layers and passes at once.

Not here: how passes are weighted against each other (`rgbt.schemes`).
Letters beyond `rgbt.types`: ``S`` sets, one per (layer, pass), layer-major; ``N`` points; ``G``
targets of the batch: one per class present in an image, by image, then by class; ``R`` = S x G.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import check_shape
from rgbt.losses import matcher
from rgbt.losses.matcher import Matcher, Matches, Targets, targets_of
from rgbt.losses.points import Points, most_uncertain, sample
from rgbt.losses.spatial import PLAIN, PointWeights, SpatialMap, SpatialWeight
from rgbt.processes import mean_count, num_processes
from rgbt.ranges import NonNegative, NumClasses, NumPoints, Share
from rgbt.requirements import Record, Requirement
from rgbt.types import Batch, Output


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How the points of a mask are drawn (PointRend, Sec. 3.2; Mask2Former, Sec. 3.3).

    Attributes:
        candidates: uniform points drawn.
        kept: of them, how many are kept: those where the prediction is least certain.
        fresh: uniform points added.
    """

    candidates: int
    kept: int
    fresh: int


@dataclass(kw_only=True, eq=False)
class SetCriterion:
    """Class, mask and dice loss of queries matched to classes.

        L = a CE + b BCE + d (1 - dice),  each summed over the prediction layers

    CE is the mean over all queries, weighted by 1 or, where nothing is matched, `no_object_weight`.
    BCE and dice are means over the N points of a matched mask, summed over masks and divided by the
    number of targets of the batch over all processes (at least 1). Points: of `oversample_ratio` N
    random ones the `importance_ratio` N nearest to the predicted border, the rest fresh.

    Source: Mask2Former, Sec. 3.3 and 4.1; CRM, Eq. (4); `spatial`: SpatialSeg, Eqs. (14) to (17).
    Paper: CRM gives 2.0 and 0.1 as two class coefficients.   Released: 0.1 is a class weight inside
    the term that 2.0 multiplies, as here.

    Attributes:
        num_classes: K.
        num_points: N, for matching and for the losses.
        oversample_ratio: >= 1.
        importance_ratio: in [0, 1].
        class_weight: a.
        mask_weight: b.
        dice_weight: d.
        no_object_weight: >= 0.
        deep_supervision: whether the auxiliary layers count, or the last one alone.
        spatial: weights of the pixels in BCE and dice.
    """

    num_classes: NumClasses
    num_points: NumPoints
    oversample_ratio: Annotated[float, Interval(ge=1, le=100)]
    importance_ratio: Share
    class_weight: NonNegative
    mask_weight: NonNegative
    dice_weight: NonNegative
    no_object_weight: NonNegative
    deep_supervision: bool
    spatial: SpatialWeight = PLAIN

    def __post_init__(self) -> None:
        kept = int(self.num_points * self.importance_ratio)
        candidates = int(self.num_points * self.oversample_ratio)
        self.sampling = Sampling(candidates=candidates, kept=kept, fresh=self.num_points - kept)
        costs = {"class": self.class_weight, "mask": self.mask_weight, "dice": self.dice_weight}
        self.part_weights = costs
        named = {f"{name}_weight": weight for name, weight in costs.items()}
        self.matcher = Matcher(num_points=self.num_points, **named)

    @property
    def record(self) -> Record:
        """Masks of as many classes."""
        setting = f"loss.num_classes={self.num_classes}"
        return Record(
            requires=(
                Requirement("model", "outputs", "masks"),
                Requirement("dataset", "num_classes", self.num_classes, setting),
            )
        )

    def __call__(
        self, output: Output, batch: Batch, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """The parts "class", "mask" and "dice", weighted and summed over the layers.

        Args:
            output: `aux` holds "class_logits" (L, P, B, Q, K+1) and "mask_logits"
                (L, P, B, Q, h, w) of P passes over the same B images; the last of the L layers is
                the prediction.
            batch: with `label` (B, H, W), H <= 4h and W <= 4w; some weights read `position`.
            generator: draws the points (order: `rgbt.losses.points.Points`).

        Returns:
            name -> (P,) float32.

        Raises:
            InputError: positions missing for the weighted loss.
            RunError: predictions that are not finite.
            ValueError: shapes or labels that do not fit.
        """
        return self.compare(output, batch, Points(generator, device=batch.label.device))

    def compare(self, output: Output, batch: Batch, points: Points) -> dict[str, Tensor]:
        """As `__call__`, at given points."""
        layers = self.layers(output, batch, points)
        return {name: weight * layers[name].sum(0) for name, weight in self.part_weights.items()}

    def layers(self, output: Output, batch: Batch, points: Points) -> dict[str, Tensor]:
        """The parts of every layer, not weighted.

        Returns:
            name -> (L, P) float32; L = 1 without deep supervision.
        """
        class_logits, mask_logits = self._predictions(output, batch)
        passes = class_logits.shape[1]
        padded_hw = (4 * mask_logits.shape[-2], 4 * mask_logits.shape[-1])
        # Costs and sums over thousands of points are kept in float32 under autocast too.
        with torch.autocast(mask_logits.device.type, enabled=False):
            spatial = None
            if self.spatial.active:
                spatial = SpatialMap(batch, padded_hw, settings=self.spatial, num_passes=passes)
            targets = targets_of(batch.label, padded_hw, self.num_classes, spatial)
            matches = self.matcher(class_logits, mask_logits, targets, points)
            mask, dice = mask_losses(mask_logits, targets, matches, points, self.sampling)
            # At least 1 target, averaged over the processes as the losses are.
            count = max(matches.num_targets, 1) / num_processes()
            parts = {"mask": mask / count, "dice": dice / count}
            parts["class"] = self._class_loss(class_logits, matches)
        return {name: values.reshape(-1, passes) for name, values in parts.items()}

    def _predictions(self, output: Output, batch: Batch) -> tuple[Tensor, Tensor]:
        class_logits, mask_logits = output.aux["class_logits"], output.aux["mask_logits"]
        sizes = check_shape("class_logits", class_logits, "L P B Q C", C=self.num_classes + 1)
        sizes = {letter: sizes[letter] for letter in "LPBQ"}
        sizes = check_shape("mask_logits", mask_logits, "L P B Q h w", **sizes)
        label = check_shape("label", batch.label, "B H W", B=sizes["B"])
        if label["H"] > 4 * sizes["h"] or label["W"] > 4 * sizes["w"]:
            raise ValueError(f"label: {label} does not fit into four times the masks, {sizes}.")
        # Not `[0:]`: its backward would copy the gradient of all masks.
        if self.deep_supervision:
            return class_logits, mask_logits
        return class_logits[-1:], mask_logits[-1:]

    def _class_loss(self, logits_LPBQC: Tensor, matches: Matches) -> Tensor:
        """(S,): cross-entropy of all queries, divided by the sum of their weights."""
        layers, passes, images, queries = logits_LPBQC.shape[:4]
        labels = np.full((layers * passes, images, queries), self.num_classes)
        sets, columns = np.nonzero(matches.query >= 0)
        labels[sets, matches.image[columns], matches.query[sets, columns]] = matches.label[columns]
        label_SQ = torch.from_numpy(labels).to(logits_LPBQC.device).flatten(1)
        weights = torch.ones(self.num_classes + 1, device=logits_LPBQC.device)
        weights[-1] = self.no_object_weight
        logits = logits_LPBQC.float().reshape(layers * passes, images * queries, -1)
        each = F.cross_entropy(logits.transpose(1, 2), label_SQ, weights, reduction="none")
        return each.sum(1) / mean_count(weights[label_SQ].sum(1))


def mask_losses(
    logits_LPBQhw: Tensor, targets: Targets, matches: Matches, points: Points, sampling: Sampling
) -> tuple[Tensor, Tensor]:
    """Cross-entropy and dice, each a sum over the matched masks of a set: two of (S,) float32."""
    device = logits_LPBQhw.device
    image, label, query = (torch.from_numpy(each).to(device) for each in matches[:3])
    masks = (targets.label[image] == label[:, None, None])[:, None].float()
    num_drawn = sampling.candidates + sampling.fresh
    bytes_per_set = 8 * len(image) * num_drawn
    step = max(1, matcher.CHUNK_BYTES // max(1, bytes_per_set))

    parts = []
    first = 0
    # (S, G, h, w) float32 mask logits of the matched queries.
    layers, passes = logits_LPBQhw.shape[:2]
    layer = torch.arange(layers, device=device)[:, None, None]
    stacked = torch.arange(passes, device=device)[:, None]
    index = query.clamp(min=0).reshape(layers, passes, -1)
    matched_SGhw = logits_LPBQhw[layer, stacked, image, index].flatten(0, 1).float()
    for logits in torch.split(matched_SGhw, step):
        # (S, G, kept + fresh, 2) points: the least certain candidates, then fresh ones.
        drawn = points.loss(len(logits), matches.num_targets, num_drawn, matches.place)
        candidates, fresh = torch.split(drawn, [sampling.candidates, sampling.fresh], dim=2)
        with torch.no_grad():
            values = _read(logits, candidates).flatten(0, 1)
            kept = most_uncertain(values, candidates.flatten(0, 1), sampling.kept)
        drawn = torch.cat([kept.reshape(*fresh.shape[:2], sampling.kept, 2), fresh], dim=2)
        t = sample(masks, drawn.transpose(0, 1))[:, 0].transpose(0, 1)
        x = _read(logits, drawn)
        weights = None if targets.spatial is None else targets.spatial.at(drawn, image, first)
        parts.append(torch.stack(mask_and_dice(x, t, weights)))
        first += len(logits)
    matched = query >= 0  # where targets outnumber queries, some are matched to none
    mask, dice = torch.cat(parts, 1).where(matched, 0.0).sum(-1)
    return mask, dice


def mask_and_dice(x: Tensor, t: Tensor, weights: PointWeights | None) -> tuple[Tensor, Tensor]:
    """Binary cross-entropy and dice loss of masks at points.

        BCE  = sum w (softplus(x) - x t) / total
        dice = 1 - (2 sum w s t + e) / (sum w s + sum w t + e),  s = sigmoid(x)

    Without weights w = 1, total = N, e = 1.

    Source: Mask2Former, criterion.py; weighted: SpatialSeg, Eqs. (16) and (17).
    Paper: Eq. (16) is printed without its minus sign.

    (..., N) float32 logits x, (..., N) targets t in [0, 1] -> two of (...).
    """
    bce = F.softplus(x) - x * t
    s = x.sigmoid()
    if weights is None:
        return bce.mean(-1), 1 - (2 * (s * t).sum(-1) + 1) / (s.sum(-1) + t.sum(-1) + 1)
    w, total, e = weights
    t = w * t
    both = (w * s).sum(-1) + t.sum(-1)
    return (w * bce).sum(-1) / total, 1 - (2 * (s * t).sum(-1) + e) / (both + e)


def _read(logits_SGhw: Tensor, points_SGN2: Tensor) -> Tensor:
    """(S, G, N) every mask at its own points."""
    values = sample(logits_SGhw.flatten(0, 1)[:, None], points_SGN2.flatten(0, 1)[:, None])
    return values.reshape(points_SGN2.shape[:-1])
