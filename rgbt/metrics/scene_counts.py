"""Count label by prediction at each distance, and for objects of each size.

The depth and the number of the object are those of the labelled scene, not of the prediction. So a
pixel that is wrongly predicted as car counts at the distance of what is really there, and the IoU
by distance is defined. A wrongly predicted pixel has no object of its class and hence no size: IoU
by size of the object is not defined, recall is. An object has the same size in every region: its
visible area in the whole image, in pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rgbt.metrics.details import Details
from rgbt.metrics.metric import Regions
from rgbt.metrics.scores import Matrices, Scores, recall


def object_recall(counts: Matrices) -> Scores:
    """Recall of each class among the pixels of objects: ``TP / (TP + FN)``.

    NaN where no object of that size has a pixel of the class, whatever the convention for absent
    classes: most classes have no objects of most sizes, and no published table counts them as 0.

    Shapes: (..., K, K) -> (..., K) fractions 0..1.
    """
    return recall(counts, "exclude")


class SceneCounter:
    """Counts label by prediction in groups of pixels of one image.

    Args:
        num_classes: K, at least 1.
        regions: the partition.
        details: "distance" or "size", with the edges between the bins.
    """

    def __init__(self, num_classes: int, regions: Regions, details: Details) -> None:
        self._classes = num_classes
        self._regions = regions
        self._details = details
        self._edges = np.array(details.setting)

    def __call__(
        self, label: ArrayLike, prediction: ArrayLike, scene: ArrayLike
    ) -> NDArray[np.int64]:
        """(R G, K, K) counts, rows = label, columns = prediction; those of images add.

        Group b holds ``edge b <= value < edge b + 1``; the last one pixels without a value.

        Args:
            label: (H, W) integers 0..255, of which K and above are ignored.
            prediction: (H, W) integers 0..K-1.
            scene: (H, W); of "distance" metres > 0, inf: the sky; of "size" the number of the
                object, 0: none.

        Raises:
            ValueError: the maps differ in shape.
        """
        label_HW, prediction_HW = np.asarray(label), np.asarray(prediction)
        scene_HW = np.asarray(scene)
        if not label_HW.shape == prediction_HW.shape == scene_HW.shape:
            raise ValueError(
                f"label, prediction and scene: expected maps H x W of one shape, got "
                f"{label_HW.shape}, {prediction_HW.shape} and {scene_HW.shape}."
            )
        values = scene_HW if self._details.kind == "distance" else areas(scene_HW)
        group = np.searchsorted(self._edges, values, side="right")
        group = np.where(np.isfinite(values), group, self._details.groups - 1)
        region = self._regions.map((label_HW.shape[0], label_HW.shape[1])).astype(np.int64)
        row = region * self._details.groups + group
        valid = label_HW < self._classes
        place = (row[valid] * self._classes + label_HW[valid]) * self._classes
        size = self._regions.regions * self._details.groups * self._classes**2
        counted = np.bincount(place + prediction_HW[valid], minlength=size)
        return counted.reshape(-1, self._classes, self._classes)


def areas(objects: NDArray[np.integer]) -> NDArray[np.float64]:
    """(H, W): pixels of the object that each pixel belongs to; inf: of none (number 0)."""
    _, inverse, pixels = np.unique(objects, return_inverse=True, return_counts=True)
    found = pixels.astype(np.float64)[inverse.reshape(objects.shape)]
    return np.where(objects == 0, np.inf, found)
