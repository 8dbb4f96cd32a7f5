"""Count (region, label, prediction) of one image with one histogram."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rgbt.metrics.metric import Regions

LANES = 2
"""Copies of the histogram that take turns from column to column, added at the end.

Neighbouring pixels mostly fall into the same bin, and a processor waits for one increment of a bin
before it starts the next; with two copies the histogram takes three quarters of the time.
"""


class RegionCounter:
    """Counts images of any size; what depends on the size alone is computed once per size.

    Every pixel becomes the number ``((r (K + 1)) + min(label, K)) K + prediction``, and one
    histogram over these numbers holds the confusion matrices of all regions. Row K collects
    ignored pixels and is dropped. The numbers are kept as narrow as they fit: for 9 classes a byte
    until the region is added, two bytes after.

    Args:
        num_classes: K, 1..255.
        regions: the partition.
    """

    def __init__(self, num_classes: int, regions: Regions) -> None:
        if not 1 <= num_classes <= 255:
            raise ValueError(f"num_classes must be between 1 and 255, got {num_classes}.")
        self.num_classes = num_classes
        self.regions = regions
        self._per_region = (num_classes + 1) * num_classes
        self._size = regions.regions * self._per_region
        self._joint_dtype = _narrowest(self._per_region)
        self._offsets: dict[tuple[int, int], Tensor] = {}

    def __call__(
        self, label: NDArray[np.integer] | Tensor, prediction: NDArray[np.integer] | Tensor
    ) -> NDArray[np.int64]:
        """(R, K, K) counts of one image, rows = label, columns = prediction; those of images add.

        Source: SpatialSeg release, metric code (a confusion matrix per region); pixels whose label
        is no class (255 = ignore) are left out.

        (H, W) integer labels 0..255, of which K and above are ignored, and predictions 0..K-1.

        Raises:
            ValueError: shapes differ, or a prediction is no class.
        """
        label_HW, prediction_HW = (
            torch.as_tensor(each).to(torch.uint8) for each in (label, prediction)
        )
        if label_HW.dim() != 2 or label_HW.shape != prediction_HW.shape:
            raise ValueError(
                f"label and prediction: expected two maps H x W of one shape, got "
                f"{tuple(label_HW.shape)} and {tuple(prediction_HW.shape)}."
            )
        if int(prediction_HW.max()) >= self.num_classes:
            raise ValueError(
                f"prediction: expected classes 0..{self.num_classes - 1}, got "
                f"{int(prediction_HW.max())}."
            )
        joint = label_HW.clamp(max=self.num_classes).to(self._joint_dtype)
        joint = joint.mul_(self.num_classes).add_(prediction_HW)
        offset = self._offset((label_HW.shape[0], label_HW.shape[1]))
        counts = torch.bincount((offset + joint).view(-1), minlength=LANES * self._size)
        shape = (LANES, self.regions.regions, self.num_classes + 1, self.num_classes)
        summed: NDArray[np.int64] = counts.view(shape).sum(0)[:, : self.num_classes].numpy()
        return summed

    def _offset(self, image_hw: tuple[int, int]) -> Tensor:
        """(H, W): first histogram bin of the region and lane of every pixel."""
        if image_hw not in self._offsets:
            region = torch.from_numpy(self.regions.map(image_hw).astype(np.int32))
            lane = torch.arange(image_hw[1], dtype=torch.int32) % LANES
            offset = region * self._per_region + lane * self._size
            self._offsets[image_hw] = offset.to(_narrowest(LANES * self._size, signed=True))
        return self._offsets[image_hw]


def _narrowest(size: int, *, signed: bool = False) -> torch.dtype:
    """Smallest integer type that holds 0..size-1 and that PyTorch computes with."""
    if size <= 2**8 and not signed:
        return torch.uint8
    return torch.int16 if size <= 2**15 else torch.int32
