"""Counts by pixel instead of by region: the heat map of SpatialSeg, Fig. 1(a), as data."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.metrics.archive import Archive
from rgbt.metrics.counts import scored_classes

ARCHIVE = Archive("rgbt pixel maps 1", "pixel maps", "it is the maps.npz that rgbt score writes")

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class PixelMaps:
    """How often prediction and label agreed at each pixel, over the images of a split.

    Attributes:
        intersection: (K, H, W) int32, images in which label and prediction are the class there.
        union: (K, H, W) int32, images in which one of them is; unlabelled pixels do not count.
        palette: K (red, green, blue) colours.
        dataset: fingerprint of the data set.
        unscored: names of the classes that are left out of means over classes.

    Raises:
        ValueError: the shapes do not agree, or `unscored` names no class or all of them.
    """

    intersection: NDArray[np.int32]
    union: NDArray[np.int32]
    images: int
    classes: tuple[str, ...]
    palette: tuple[tuple[int, int, int], ...]
    dataset: str
    split: str
    name: str
    unscored: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        shape, classes = self.intersection.shape, len(self.classes)
        if len(shape) != 3 or shape[0] != classes or self.union.shape != shape:
            raise ValueError(
                f"pixel maps: expected intersection and union K={classes} x H x W, got {shape} and "
                f"{self.union.shape}."
            )
        scored_classes(self.classes, self.unscored)

    @property
    def scored(self) -> NDArray[np.bool_]:
        """(K,): which classes take part in means over classes."""
        return scored_classes(self.classes, self.unscored)

    def save(self, path: Path) -> None:
        """Write one compressed file under a temporary name, then rename: never half a file."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        ARCHIVE.save(path, {**values, "unscored": np.array(self.unscored, dtype=str)})

    @classmethod
    def load(cls, path: Path) -> PixelMaps:
        """Read what `save` wrote; InputError: no such file, or not a file of pixel maps."""
        return ARCHIVE.load(path, cls._of_arrays)

    @classmethod
    def _of_arrays(cls, values: dict[str, Any]) -> PixelMaps:
        plain = {key: array.tolist() for key, array in values.items() if array.ndim < 3}
        for key in ("classes", "unscored"):
            plain[key] = tuple(plain[key])
        palette = tuple((r, g, b) for r, g, b in plain.pop("palette"))
        arrays = {key: values[key] for key in ("intersection", "union")}
        return cls(palette=palette, **arrays, **plain)

    def iou(self) -> NDArray[np.float64]:
        """Compute the mean IoU over classes at every pixel: the map of SpatialSeg, Fig. 1(a).

            (1 / |C|) sum_{c in C} I_c(y, x) / U_c(y, x)

        C are the scored classes with U > 0 at the pixel: at a single pixel most classes never
        occur, so that absent ones as 0 would mostly show how many do. The mean of the map over a
        region is not the mIoU of that region, which adds up pixels before it divides.

        Source: SpatialSeg, Fig. 1(a); how absent classes count is not stated there.

        Returns:
            (H, W) fractions 0..1; NaN where there is nothing to score.
        """
        union = self.union[self.scored]
        ratio = self.intersection[self.scored] / np.maximum(union, 1)
        there = (union > 0).sum(0)
        heat = np.full(there.shape, np.nan)
        np.divide(ratio.sum(0), there, out=heat, where=there > 0)
        return heat


def add_image(sums: NDArray[np.int32], label: Bytes, prediction: Bytes) -> None:
    """Count one image, (H, W) each, in the intersection and union (2, K, H, W).

    Pixels whose label is no class are left out.
    """
    counted = label < sums.shape[1]
    for index, (both, either) in enumerate(zip(*sums, strict=True)):
        labelled, predicted = label == index, (prediction == index) & counted
        both += labelled & predicted
        either += labelled | predicted
