"""Statistics of a split by region: what is measured once, and the file that holds it.

Letters: ``N`` images, ``R`` regions, ``K`` classes, ``H W`` pixels; the second axis of length 2 is
the modality (`MODALITIES`). What is computed from them is in `resampled`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from analysis.commands import in_threads
from analysis.statistics.measure import KERNELS, ImageMeter
from rgbt.checks import InputError, check_choice
from rgbt.dataset import LabelledDataset
from rgbt.metrics.archive import Archive
from rgbt.metrics.metric import Regions
from rgbt.metrics.names import DAY, NIGHT
from rgbt.types import Sample

# Order of the modality axis. RGB is measured as grey (ITU-R BT.601), rounded to 8 bits.
MODALITIES = ("rgb", "thermal")

ALL = "all"

ARCHIVE = Archive(
    "rgbt spatial statistics 3", "statistics", "write it with rgbt spatial dataset=... out=..."
)


@dataclass(frozen=True, kw_only=True)
class SpatialStatistics:
    """Measurements of every image of a split, by region.

    Attributes:
        classes: names of the K classes.
        background: those that are no object, see `rgbt.dataset.LabelledDataset`.
        partition: name of the regions, e.g. "ring9" (`rgbt.metrics.metric.Regions.name`).
        region_map: (H, W) uint8, region index 0..R-1 of every pixel.
        kernel: of the Laplacian, "four" or "eight" neighbours.
        names: names of the N images.
        night: (N,) bool, taken at night; None where the data set does not say.
        labels: (N, R, K) int64, pixels of each class.
        ignored: (N, R) int64, pixels whose label is 255.
        occupied: (2, K, H, W) int32, images by day and at night that have class k at the pixel;
            all by day where `night` is None.
        laplacian: (N, 2, R) float64, variance of the Laplacian (Eq. 3), squared grey levels.
        mean: (N, 2, R) float64, mean pixel value, grey levels 0..255.
        noise: (N, E, 2, R) float64, standard deviation of the noise by each of `ESTIMATORS`, grey
            levels; NaN where a region holds no window of the estimator.
    """

    dataset: str
    fingerprint: str
    split: str
    classes: tuple[str, ...]
    background: tuple[str, ...]
    partition: str
    region_map: NDArray[np.uint8]
    kernel: str
    names: tuple[str, ...]
    night: NDArray[np.bool_] | None
    labels: NDArray[np.int64]
    ignored: NDArray[np.int64]
    occupied: NDArray[np.int32]
    laplacian: NDArray[np.float64]
    mean: NDArray[np.float64]
    noise: NDArray[np.float64]

    @property
    def num_regions(self) -> int:
        """R."""
        return int(self.region_map.max()) + 1

    @property
    def is_background(self) -> NDArray[np.bool_]:
        """(K,): which classes are background."""
        return np.array([name in self.background for name in self.classes], bool)

    @property
    def objects(self) -> tuple[int, ...]:
        """Indices of the classes that are not background."""
        return tuple(np.flatnonzero(~self.is_background).tolist())

    def subsets(self) -> tuple[str, ...]:
        """List the parts of the images: "all", and "day" and "night" if there are both."""
        both = self.night is not None and 0 < int(self.night.sum()) < len(self.names)
        return (ALL, DAY, NIGHT) if both else (ALL,)

    def chosen(self, part: str) -> NDArray[np.bool_]:
        """Return (N,): which images belong to `part`: "all", "day" or "night".

        Raises:
            InputError: no such part, a data set without that information, or no such image.
        """
        check_choice("part", part, (ALL, DAY, NIGHT))
        night = np.zeros(len(self.names), bool) if self.night is None else self.night
        wanted = night | True if part == ALL else night == (part == NIGHT)
        if not wanted.any() or (self.night is None and part != ALL):
            raise InputError(
                f"part={part}: split '{self.split}' of {self.dataset} states no such image."
            )
        return wanted

    def occupied_in(self, part: str) -> NDArray[np.int64]:
        """Count the images of `part` that have class k at the pixel, (K, H, W); see `chosen`."""
        self.chosen(part)
        by_part = self.occupied if part == ALL else self.occupied[[int(part == NIGHT)]]
        return np.asarray(by_part.sum(0))

    def save(self, path: Path) -> None:
        """Write one compressed file under a temporary name, then rename: never half a file."""
        values: dict[str, Any] = {}
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            values[name] = value if isinstance(value, np.ndarray) else np.array(value, str)
        # Missing is stored as no value at all: npz without pickles knows no None.
        values["night"] = np.zeros(0, bool) if self.night is None else self.night
        ARCHIVE.save(path, values)

    @classmethod
    def load(cls, path: Path) -> SpatialStatistics:
        """Read what `save` wrote; InputError: no such file, or not a file of statistics."""
        return ARCHIVE.load(path, cls._of_arrays)

    @classmethod
    def _of_arrays(cls, values: dict[str, Any]) -> SpatialStatistics:
        night = values.pop("night")
        for key, array in values.items():
            if array.dtype.kind == "U":
                values[key] = tuple(array.tolist()) if array.ndim else str(array)
        return cls(night=night if len(night) else None, **values)


def collect(
    dataset: LabelledDataset,
    split: str,
    regions: Regions,
    *,
    kernel: str = KERNELS[0],
    short_edge: int = 0,
    advance: Callable[[], object] = lambda: None,
) -> SpatialStatistics:
    """Read and measure every image of a split once.

    Args:
        dataset: reads labelled pairs, all of one size.
        split: of the data set.
        regions: partition of the image.
        kernel: of the Laplacian, one of `KERNELS`.
        short_edge: images are resized so that their shorter edge has so many pixels, the images by
            area and the labels to the nearest pixel; 0: as they are.
        advance: called once per image.

    Returns:
        the statistics, images in the order of the split; the same for any number of threads.

    Raises:
        InputError: no such split; a file that cannot be read; an image without label or of another
            size than the first.
    """
    names = dataset.names(split)
    nights = dataset.nights(names)
    like = _resized(dataset.read(names[0]), short_edge)
    region_map = regions.map((like.rgb.shape[0], like.rgb.shape[1]))
    occupied = np.zeros((2, len(dataset.classes), *region_map.shape), np.int32)
    meter, lock = ImageMeter(region_map, len(dataset.classes), kernel), Lock()

    def measure(name: str, night: bool) -> dict[str, NDArray[Any]]:
        sample = _resized(dataset.read(name), short_edge)
        _check(sample, like)
        measured = meter(sample)
        with lock:
            for index in np.flatnonzero(measured["labels"].any(0)):
                occupied[int(night), index] += sample.label == index
        advance()
        return measured

    images = list(in_threads(measure, names, nights or [False] * len(names)))
    return SpatialStatistics(
        dataset=dataset.name,
        fingerprint=dataset.fingerprint(),
        split=split,
        classes=tuple(dataset.classes),
        background=tuple(dataset.background),
        partition=regions.name,
        region_map=region_map,
        kernel=kernel,
        names=tuple(names),
        night=None if nights is None else np.array(nights, bool),
        occupied=occupied,
        **{key: np.stack([measured[key] for measured in images]) for key in images[0]},
    )


def _resized(sample: Sample, short_edge: int) -> Sample:
    """Resize a sample to the size in which it is measured."""
    height, width = sample.thermal.shape[:2]
    if short_edge in (0, min(height, width)):
        return sample
    factor = short_edge / min(height, width)
    size = round(width * factor), round(height * factor)
    rgb, thermal = _by_area(sample.rgb, size), _by_area(sample.thermal, size)
    label = sample.label
    if label is not None:
        label = np.asarray(cv2.resize(label, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    return replace(sample, rgb=rgb, thermal=thermal, label=label)


def _by_area(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _check(sample: Sample, like: Sample) -> None:
    if sample.label is None:
        raise InputError(f"split: '{sample.name}' has no label; the statistics need one per image.")
    if sample.thermal.shape != like.thermal.shape:
        sizes = ["x".join(map(str, image.shape)) for image in (sample.thermal, like.thermal)]
        raise InputError(
            f"split: '{sample.name}' is {sizes[0]} pixels but '{like.name}' is {sizes[1]}; regions "
            "need images of one size."
        )
