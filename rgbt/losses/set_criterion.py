"""The set criterion of Mask2Former with SpatialSeg's weights, for all layers and passes at once.

All (layer, pass, image) problems of a step are matched together: their costs are computed where the
predictions are and reach the CPU in one transfer. Not here: how passes are weighted against each
other (`rgbt.schemes`).
Letters beyond `rgbt.types`: ``S`` sets, one per (layer, pass), layer-major; ``N`` points; ``G``
targets of the batch: one per class present in an image, by image, then by class.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
from annotated_types import Interval
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import RunError
from rgbt.fusion import fused
from rgbt.geometry.padding import pad_to
from rgbt.losses.points import EVERY, Points, class_shares, most_uncertain, sample
from rgbt.losses.spatial import PLAIN, PointWeights, SpatialMap, SpatialWeight
from rgbt.processes import mean_count, num_processes, rank, whole
from rgbt.ranges import NonNegative, NumClasses, NumPoints, Share
from rgbt.requirements import LossRecord, Requirement
from rgbt.types import IGNORE, Batch, Output

# Size of the largest temporary of a step on a CPU, whose cache a larger one does not fit, and on a
# GPU, where fewer and larger kernels are faster.
CHUNK_BYTES, CHUNK_BYTES_GPU = 16 * 2**20, 256 * 2**20


@dataclass(kw_only=True, eq=False)
class SetCriterion:
    """Computes the class, mask and dice loss of queries matched to classes.

        L = a CE + b BCE + d (1 - dice),  each summed over the prediction layers

    CE is the mean over all queries, weighted by 1 or, where nothing is matched, `no_object_weight`.
    BCE and dice are means over the N points of a matched mask, summed over masks and divided by the
    number of targets of the batch over all processes (at least 1). Points: of `oversample_ratio` N
    random ones the `importance_ratio` N nearest to the predicted border, the rest fresh.

    Source: Mask2Former, Sec. 3.3 and 4.1; CRM, Eq. (4); `spatial`: SpatialSeg, Eqs. (14) to (17).
    Paper: CRM gives 2.0 and 0.1 as two class coefficients.   Released: 0.1 is a class weight inside
    the term that 2.0 multiplies, as here.
    """

    num_classes: NumClasses
    num_points: NumPoints  # N, for matching and for the losses
    oversample_ratio: Annotated[float, Interval(ge=1, le=100)]
    importance_ratio: Share
    class_weight: NonNegative  # a
    mask_weight: NonNegative  # b
    dice_weight: NonNegative  # d
    no_object_weight: NonNegative
    deep_supervision: bool  # whether the auxiliary layers count, or the last one alone
    spatial: SpatialWeight = PLAIN  # weights of the pixels in BCE and dice

    def __post_init__(self) -> None:
        self.num_candidates = int(self.num_points * self.oversample_ratio)
        self.num_kept = int(self.num_points * self.importance_ratio)
        self.num_drawn = self.num_candidates + self.num_points - self.num_kept
        self.part_weights = {
            "class": self.class_weight,
            "mask": self.mask_weight,
            "dice": self.dice_weight,
        }

    @property
    def record(self) -> LossRecord:
        """Require masks, and a data set of as many classes."""
        setting = f"loss.num_classes={self.num_classes}"
        return LossRecord(
            requires=(
                Requirement("model", "outputs", "masks"),
                Requirement("dataset", "num_classes", self.num_classes, setting),
            )
        )

    def __call__(
        self, output: Output, batch: Batch, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Return the parts "class", "mask" and "dice", (P,) float32, weighted, summed over layers.

        `output.aux` holds "class_logits" (L, P, B, Q, K+1) and "mask_logits" (L, P, B, Q, h, w) of
        P passes over the same B images; the last of the L layers is the prediction. The label is
        (B, H, W), H <= 4h and W <= 4w. The generator draws the points.

        Raises:
            InputError: positions missing for the weighted loss.
            RunError: predictions that are not finite.
            ValueError: shapes or labels that do not fit.
        """
        return self.compare(output, batch, Points(generator, device=batch.label.device))

    def compare(self, output: Output, batch: Batch, points: Points) -> dict[str, Tensor]:
        """Compare as `__call__` does, at given points."""
        layers = self.layers(output, batch, points)
        return {name: weight * layers[name].sum(0) for name, weight in self.part_weights.items()}

    def layers(self, output: Output, batch: Batch, points: Points) -> dict[str, Tensor]:
        """Return the parts of every layer, not weighted, (L, P); L = 1 without deep supervision."""
        class_logits, mask_logits = output.aux["class_logits"], output.aux["mask_logits"]
        (_, passes, images, _, channels), (*of_masks, h, w) = class_logits.shape, mask_logits.shape
        num_labels, height, width = batch.label.shape
        # Larger labels would be cut without an error.
        fits = channels == self.num_classes + 1 and of_masks == [*class_logits.shape[:4]]
        if not fits or num_labels != images or height > 4 * h or width > 4 * w:
            shapes = [tuple(x.shape) for x in (class_logits, mask_logits, batch.label)]
            raise ValueError(f"class_logits, mask_logits and label do not fit: {shapes}.")
        padded_hw = (4 * h, 4 * w)
        if not self.deep_supervision:  # not `[0:]`: its backward would copy all gradients
            class_logits, mask_logits = class_logits[-1:], mask_logits[-1:]
        # Costs and sums over thousands of points are kept in float32 under autocast too.
        with torch.autocast(mask_logits.device.type, enabled=False):
            spatial = None
            if self.spatial.active:
                spatial = SpatialMap(batch, padded_hw, settings=self.spatial, num_passes=passes)
            targets = targets_of(batch.label, padded_hw, self.num_classes, spatial)
            matches = self.match(class_logits, mask_logits, targets, points)
            mask, dice = self._mask_losses(mask_logits, targets, matches, points)
            # At least 1 target, averaged over the processes as the losses are.
            count = max(matches.num_targets, 1) / num_processes()
            parts = {"mask": mask / count, "dice": dice / count}
            parts["class"] = self._class_loss(class_logits, matches)
        return {name: values.reshape(-1, passes) for name, values in parts.items()}

    @torch.no_grad()
    def match(
        self, class_logits: Tensor, mask_logits: Tensor, targets: Targets, points: Points
    ) -> Matches:
        """Match by class, mask and dice costs at random points (Hungarian method).

            cost = -a softmax(class)[c] + b BCE + d (1 - (2 sum(s t) + e) / (sum(s) + sum(t) + e))

        with s the sigmoid of the mask logits and e = 1. BCE is the mean over points of
        ``softplus(x) - x t``. One set of points per image, shared by its queries and targets, is
        drawn for every layer and pass.   Source: Mask2Former, Sec. 3.3 and matcher.py.

        (L, P, B, Q, K+1) class and (L, P, B, Q, h, w) mask logits against the targets of the B
        images. Errors as of `assign`.
        """
        layers, passes, images, queries = class_logits.shape[:4]
        probabilities = class_logits.float().softmax(-1)[..., :-1].flatten(0, 1)
        sets = _chunk_bytes(mask_logits) // (4 * images * queries * self.num_points)
        # At a time, passes of one layer, or all passes of layers.
        step, layer_step = max(1, min(sets, passes)), max(1, sets // passes)
        costs = []
        for layer in range(0, layers, layer_step):
            of_layers = mask_logits[layer : layer + layer_step]
            for start in range(0, passes, step):
                masks = of_layers[:, start : start + step]
                drawn = points.matcher(len(masks) * masks.shape[1], images, self.num_points)
                x = sample(masks.flatten(0, 2).float(), drawn.flatten(0, 1)[:, None])[:, :, 0]
                t = class_shares(targets.label, drawn, targets.present.shape[1]).flatten(0, 1)
                weights = None
                if targets.spatial is not None and self.spatial.match == "weighted":
                    every = torch.arange(images, device=drawn.device)
                    weights = targets.spatial.at(drawn, every, layer * passes + start)
                    weights = PointWeights(*(part.flatten(0, 1) for part in weights))
                    t = t * weights.values[:, None]
                costs.append(pairwise_costs(x, t, weights, self.mask_weight, self.dice_weight))
        cost = torch.cat(costs).reshape(probabilities.shape)
        return assign(cost - self.class_weight * probabilities, targets)

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
        costs = F.cross_entropy(logits.transpose(1, 2), label_SQ, weights, reduction="none")
        return costs.sum(1) / mean_count(weights[label_SQ].sum(1))

    def _mask_losses(
        self, logits_LPBQhw: Tensor, targets: Targets, matches: Matches, points: Points
    ) -> tuple[Tensor, Tensor]:
        """Cross-entropy and dice, each a sum over the matched masks of a set: two of (S,)."""
        device = logits_LPBQhw.device
        image = torch.from_numpy(matches.image).to(device)
        label = torch.from_numpy(matches.label).to(device)
        query = torch.from_numpy(matches.query).to(device)
        masks = (targets.label[image] == label[:, None, None])[:, None].float()
        of_set = 8 * len(image) * self.num_drawn
        step = max(1, _chunk_bytes(logits_LPBQhw) // max(1, of_set))

        # (S, G, h, w) float32 mask logits of the matched queries.
        layers, passes = logits_LPBQhw.shape[:2]
        layer = torch.arange(layers, device=device)[:, None, None]
        stacked = torch.arange(passes, device=device)[:, None]
        index = query.clamp(min=0).reshape(layers, passes, -1)
        matched_SGhw = logits_LPBQhw[layer, stacked, image, index].flatten(0, 1).float()
        parts, first = [], 0
        for logits in torch.split(matched_SGhw, step):
            # (S, G, kept + fresh, 2) points: the least certain candidates, then fresh ones.
            drawn = points.loss(len(logits), matches.num_targets, self.num_drawn, matches.place)
            candidates, fresh = drawn.tensor_split([self.num_candidates], dim=2)
            with torch.no_grad():
                values = _read(logits, candidates).flatten(0, 1)
                kept = most_uncertain(values, candidates.flatten(0, 1), self.num_kept)
            drawn = torch.cat([kept.reshape(*fresh.shape[:2], self.num_kept, 2), fresh], dim=2)
            t = sample(masks, drawn.transpose(0, 1))[:, 0].transpose(0, 1)
            x = _read(logits, drawn)
            weights = None if targets.spatial is None else targets.spatial.at(drawn, image, first)
            parts.append(torch.stack(mask_and_dice(x, t, weights)))
            first += len(logits)
        matched = query >= 0  # where targets outnumber queries, some are matched to none
        mask, dice = torch.cat(parts, 1).where(matched, 0.0).sum(-1)
        return mask, dice


class Targets(NamedTuple):
    """Holds the targets of one batch. Padded and ignored pixels are negatives of every mask."""

    label: Tensor  # (B, H, W) int64, padded with 255
    present: Tensor  # (B, K) bool, classes that occur
    unknown: Tensor  # () bool, whether a label is neither a class nor 255
    spatial: SpatialMap | None  # weights of the pixels; None for the plain loss


class Matches(NamedTuple):
    """Holds the assignment, on the CPU."""

    image: NDArray[np.int64]  # (G,), image of each target
    label: NDArray[np.int64]  # (G,), class of each target
    query: NDArray[np.int64]  # (S, G), matched to each target; -1: targets outnumber queries
    place: Tensor | slice  # which of the targets of all processes these are
    num_targets: int  # in all processes


def targets_of(
    label: Tensor, padded_hw: tuple[int, int], num_classes: int, spatial: SpatialMap | None
) -> Targets:
    """Make targets of labels (B, H, W) int64, padded at the bottom and right to `padded_hw`."""
    # One column per label value -1 (anything below 0) to 256 (anything above 255).
    seen = torch.zeros(len(label), IGNORE + 3, dtype=torch.bool, device=label.device)
    seen.scatter_(1, label.flatten(1).clamp(-1, IGNORE + 1) + 1, True)
    present = seen[:, 1 : num_classes + 1].clone()
    seen[:, 1 : num_classes + 1] = False
    seen[:, IGNORE + 1] = False
    return Targets(pad_to(label, padded_hw, IGNORE), present, seen.any(), spatial)


def pairwise_costs(
    x: Tensor, t: Tensor, weights: PointWeights | None, mask_weight: float, dice_weight: float
) -> Tensor:
    """(R, Q, K): mask and dice cost of every query against every target, see `SetCriterion.match`.

    x (R, Q, N) are mask logits, and t (R, K, N) targets, already weighted.
    """
    total: Tensor | float = x.shape[-1]
    smoothing: Tensor | float = 1.0
    w = None
    if weights is not None:
        total, smoothing = weights.total[:, None, None], weights.smoothing[:, None, None]
        w = weights.values[:, None]
    s, softened = sigmoid_and_softplus(x, w)
    # One product gives the sums with the targets, and over all points.
    last = torch.ones_like(t[:, :1]) if w is None else w
    both = s @ torch.cat([t, last], dim=1).mT
    common, of_s = both[..., :-1], both[..., -1:]
    dice = (2 * common + smoothing) / (of_s + t.sum(-1)[:, None] + smoothing)
    return mask_weight * ((softened - x @ t.mT) / total) + dice_weight * (1 - dice)


@fused
def sigmoid_and_softplus(x: Tensor, w: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the sigmoid of x (R, Q, N), and sums of softplus with weights (R, 1, N): (R, Q, 1)."""
    softened = F.softplus(x)
    return x.sigmoid(), (softened if w is None else softened * w).sum(-1, keepdim=True)


def assign(cost: Tensor, targets: Targets) -> Matches:
    """Assign queries to the classes present as cheaply as possible; costs are (S, B, Q, K)."""
    parts = [cost.flatten(), whole(targets.present).flatten(), targets.unknown.reshape(1)]
    numbers = torch.cat([part.float() for part in parts]).cpu().numpy()
    cost_SBQK = numbers[: cost.numel()].reshape(cost.shape)
    # This covers the images of all processes.
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


def mask_and_dice(x: Tensor, t: Tensor, weights: PointWeights | None) -> tuple[Tensor, Tensor]:
    """Compute binary cross-entropy and dice loss of masks at points.

        BCE  = sum w (softplus(x) - x t) / total
        dice = 1 - (2 sum w s t + e) / (sum w s + sum w t + e),  s = sigmoid(x)

    Without weights w = 1, total = N, e = 1.

    Source: Mask2Former, criterion.py; weighted: SpatialSeg, Eqs. (16) and (17).
    Paper: Eq. (16) is printed without its minus sign.

    (..., N) float32 logits x, (..., N) targets t in [0, 1] -> two of (...).
    """
    if weights is None:
        bce, common, both = mask_sums(x, t)
        return bce / x.shape[-1], 1 - (2 * common + 1) / (both + 1)
    w, total, e = weights
    bce, common, both = mask_sums(x, t, w)
    return bce / total, 1 - (2 * common + e) / (both + e)


@fused
def mask_sums(x: Tensor, t: Tensor, w: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Return the sums over points of BCE, s t and s + t of `mask_and_dice`, with weights w."""
    bce, s = F.softplus(x) - x * t, x.sigmoid()
    if w is None:
        return bce.sum(-1), (s * t).sum(-1), s.sum(-1) + t.sum(-1)
    t = w * t
    return (w * bce).sum(-1), (s * t).sum(-1), (w * s).sum(-1) + t.sum(-1)


def _chunk_bytes(x: Tensor) -> int:
    return CHUNK_BYTES if x.device.type == "cpu" else CHUNK_BYTES_GPU


def _read(logits_SGhw: Tensor, points_SGN2: Tensor) -> Tensor:
    """Read every mask at its own points: (S, G, N)."""
    values = sample(logits_SGhw.flatten(0, 1)[:, None], points_SGN2.flatten(0, 1)[:, None])
    return values.reshape(points_SGN2.shape[:-1])
