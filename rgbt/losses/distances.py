"""Distances to another pass or to another network.

Self-distillation between the passes of complementary random masking (queries are compared index by
index, without matching), and the distance of features of things from those of the initial network.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval, Len
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import InputError, nearest
from rgbt.losses.cross_entropy import TINY
from rgbt.processes import mean_count
from rgbt.ranges import Names, Positive
from rgbt.requirements import Requirement
from rgbt.types import IGNORE


def sdc(teacher: Tensor, student: Tensor) -> Tensor:
    """Compute self-distillation of complementary representations.

        mean |stopgrad(teacher) - student|

    Source: CRM, Eq. (2).   Released: final layer only, raw logits, mean over all entries including
    the no-object column, teacher without gradient.

    (B, Q, K+1) class logits of the clean and of the masked RGB-T pass -> () float32.
    """
    return (teacher.detach().float() - student.float()).abs().mean()


def sdn(teacher: Tensor, rgb: Tensor, thermal: Tensor) -> Tensor:
    """Compute self-distillation of non-local representations (CRM, Eq. 3), of R' and T' to F."""
    return sdc(teacher, rgb) + sdc(teacher, thermal)


def thing_cells(
    label: Tensor, feature_hw: tuple[int, int], things: tuple[int, ...], min_share: float
) -> Tensor:
    """Find cells, (B, h, w) bool, of which one thing class has at least `min_share` of the pixels.

    A cell of a label (B, H, W) has ceil(H / h) x ceil(W / w) pixels; what lies outside the label is
    of no class. With a share above 0.5, no second class has as many pixels.

    Released: lhoyer/DAFormer (e6f6e04), mmseg/utils/utils.py, downscale_label_ratio, whose cells
    divide the label.
    """
    (height, width), (rows, columns) = label.shape[1:], feature_hw
    kernel = [-(-height // rows), -(-width // columns)]
    below, right = kernel[0] * rows - height, kernel[1] * columns - width
    padded = F.pad(label, (0, right, 0, below), value=IGNORE)
    of_class = torch.stack([padded == index for index in things], 1).float()
    return (F.avg_pool2d(of_class, kernel) >= min_share).any(1)


def feature_distance(features: Tensor, initial: Tensor, cells: Tensor) -> Tensor:
    """Average ``||F_n - F'_n||_2`` over the `cells` n of two feature maps; 0 without a cell.

    Source: DAFormer (Hoyer et al., CVPR 2022), Sec. 3.3.   Released: lhoyer/DAFormer (e6f6e04),
    mmseg/models/uda/dacs.py, masked_feat_dist.

    F and F' (B, C, h, w), the latter without gradient, and (B, h, w) bool -> () float32.
    """
    distance = torch.linalg.vector_norm(features.float() - initial.float(), dim=1)
    number = mean_count(cells.sum().float()).clamp(min=TINY)
    return torch.sum(distance.masked_fill(~cells, 0.0)) / number


@dataclass(frozen=True, kw_only=True)
class FeatureDistance:
    """Computes the weighted distance of features of things from those of the initial network.

    Released: configs/_base_/uda/dacs_a999_fdthings.py of lhoyer/DAFormer, with the ten classes of
    Cityscapes from traffic light, traffic sign and person to bicycle.
    """

    weight: Positive  # factor of the distance in the loss; released: 0.005
    things: Annotated[Names, Len(1, 255)]  # names of the thing classes in the data set
    min_share: Annotated[float, Interval(gt=0.5, le=1)]  # see `thing_cells`; released: 0.75

    @property
    def requires(self) -> tuple[Requirement, ...]:
        """Require features of the network, and weights that it starts from."""
        setting = "scheme.feature_distance"
        advice = "name a file of weights with pretrained=FILE or model.weights=FILE"
        return (
            Requirement("model", "features", True, setting),
            Requirement("model.weights", "pretrained", True, setting, advice),
        )

    def __call__(
        self, features: Tensor, initial: Tensor, label: Tensor, classes: tuple[str, ...]
    ) -> Tensor:
        """Return the weighted distance, () float32, of maps (B, C, h, w) for a label (B, H, W)."""
        hw = (features.shape[2], features.shape[3])
        cells = thing_cells(label, hw, self.indices(classes), self.min_share)
        return self.weight * feature_distance(features, initial, cells)

    def indices(self, classes: tuple[str, ...]) -> tuple[int, ...]:
        """Return the indices of `things`; InputError where one is no class of the data set."""
        if unknown := [name for name in self.things if name not in classes]:
            raise InputError(
                f"scheme.feature_distance.things: the data set has no class '{unknown[0]}'; "
                f"{nearest(unknown[0], classes)}."
            )
        return tuple(classes.index(name) for name in self.things)
