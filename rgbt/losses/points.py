"""Draw, sample and select the points at which masks are compared.

Part of the set criterion. Points are (x, y) in [-1, 1], the coordinates of `grid_sample`: -1 and 1
are the outer edges of the outermost pixels, so one point means the same place at every resolution.
Letters beyond `rgbt.types`: ``N`` points, ``R`` maps (any number of masks, stacked), ``S`` sets,
one per (layer, pass), layer-major.
"""

from __future__ import annotations

from itertools import product
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.processes import num_processes, rank
from rgbt.types import IGNORE

EVERY = slice(None)


class Points:
    """Draws independent uniform points from one generator, on `device`.

    Draws are made set by set in the order of the requests, so that the numbers do not depend on how
    many sets are requested at once. Each set is drawn for the batch of all processes. The criterion
    requests the matcher's points of all (layer, pass) pairs, then for the loss points of all pairs;
    within a loss set, the points of one mask are its candidates followed by its random remainder.

    A coordinate is one of 2^15 centres of a regular grid: four come from one random integer, in
    half the time of four floats.
    """

    def __init__(self, generator: torch.Generator, *, device: torch.device) -> None:
        self.generator = generator
        self.device = device

    def loss(
        self, num_sets: int, num_masks: int, num_points: int, kept: Tensor | slice = EVERY
    ) -> Tensor:
        """Draw the next sets for mask losses, (num_sets, `kept` of num_masks, num_points, 2)."""
        numbers = 2 * num_masks * num_points
        bits = torch.empty(
            num_sets, -(-numbers // 4), dtype=torch.int64, device=self.generator.device
        )
        for one_set in bits:
            one_set.random_(generator=self.generator)
        # 63 random bits are four words of 16; the top bit of each is cut, because one is always 0.
        words = bits.view(torch.int16)[:, :numbers].view(num_sets, num_masks, 2 * num_points)
        own_words = words[:, kept].bitwise_and_(0x7FFF).to(self.device)
        uniform = own_words.float().sub_(2.0**14 - 0.5).mul_(2.0**-14)
        return uniform.reshape(num_sets, uniform.shape[1], num_points, 2)

    def matcher(self, num_sets: int, num_images: int, num_points: int) -> Tensor:
        """Draw the next sets for the matching costs, (num_sets, num_images, num_points, 2)."""
        of_all = num_processes()
        return self.loss(num_sets, num_images * of_all, num_points, slice(rank(), None, of_all))


def sample(maps: Tensor, points: Tensor, outside: Literal["zeros", "border"] = "zeros") -> Tensor:
    """Read bilinear values (R, C, S, N) of maps (R, C, h, w) at points (R, S, N, 2).

    `outside` lies beyond the outermost pixel centres (Mask2Former, point_features.py).
    """
    return F.grid_sample(maps, points, mode="bilinear", padding_mode=outside, align_corners=False)


def class_shares(label: Tensor, points: Tensor, num_classes: int) -> Tensor:
    """Read bilinear values of the masks of all classes at points, without making the masks.

    The same as `sample` of the one-hot label, in a fraction of the time: the four labels around a
    point are read once. (B, H, W) int64, of which 255 is no class, at (S, B, N, 2) -> (S, B, K, N).
    """
    height, width = label.shape[1:]
    sets, images, count = points.shape[:3]
    # A frame of ignored pixels represents the outside, so that no index needs a check.
    framed = F.pad(label, (1, 1, 1, 1), value=IGNORE).clamp(max=num_classes).flatten(1)
    x = (points[..., 0] + 1) * (width / 2) + 0.5
    y = (points[..., 1] + 1) * (height / 2) + 0.5
    left, top = x.floor(), y.floor()
    right_share, bottom_share = x - left, y - top
    corner = (top.long() * (width + 2) + left.long()).transpose(0, 1).flatten(1)

    shares = points.new_zeros(sets, images, num_classes + 1, count)
    for down, across in product((0, 1), (0, 1)):
        index = corner + (down * (width + 2) + across)
        found = framed.gather(1, index).reshape(images, sets, 1, count).transpose(0, 1)
        row = bottom_share if down else 1 - bottom_share
        column = right_share if across else 1 - right_share
        shares.scatter_add_(2, found, (row * column)[:, :, None])
    return shares[:, :, :num_classes]


def most_uncertain(logits: Tensor, points: Tensor, keep: int) -> Tensor:
    """Select the `keep` points of each mask whose logits are nearest to 0, in no particular order.

    (R, N) float32 logits, finite and overwritten, and (R, N, 2) -> (R, keep, 2).
    Source: Mask2Former, point_features.py, with uncertainty ``-|logit|``.
    """
    # Non-negative floats are ordered like their bits, and integers are selected much faster.
    magnitude = logits.abs_().view(torch.int32)
    index = magnitude.topk(keep, dim=1, largest=False, sorted=False).indices
    kept = torch.view_as_complex(points).gather(1, index)
    return torch.view_as_real(kept)
