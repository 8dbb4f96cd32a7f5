"""Mask and dice loss of matched queries at points, for all layers and passes of a step at once.

Letters beyond `rgbt.types`: ``S`` sets, one per (layer, pass), layer-major; ``N`` points; ``G``
targets of the batch: one per class present in an image, by image, then by class; ``R`` = S x G.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.losses.matcher import CHUNK_BYTES, Matches, Targets
from rgbt.losses.points import Points, most_uncertain, sample
from rgbt.losses.spatial import PointWeights


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


def mask_losses(
    logits_LPBQhw: Tensor, targets: Targets, matches: Matches, points: Points, sampling: Sampling
) -> tuple[Tensor, Tensor]:
    """Cross-entropy and dice, each a sum over the matched masks of a set: two of (S,) float32."""
    device = logits_LPBQhw.device
    image, label, query = (torch.from_numpy(each).to(device) for each in matches[:3])
    masks = (targets.label[image] == label[:, None, None])[:, None].float()
    num_drawn = sampling.candidates + sampling.fresh
    bytes_per_set = 8 * len(image) * num_drawn
    step = max(1, CHUNK_BYTES // max(1, bytes_per_set))

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
