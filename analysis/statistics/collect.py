"""Measurements of a whole split: one pass, in threads, in memory that does not grow with images.

Kept per image are a few numbers by region; the maps of occupancy are added up as images come.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from threading import Lock

import cv2
import numpy as np

from analysis.bar import in_threads
from analysis.statistics.data import ALL, SpatialStatistics
from analysis.statistics.measure import ESTIMATORS, KERNELS, ImageMeasurements, ImageMeter
from rgbt.checks import InputError, check_range
from rgbt.dataset import LabelledDataset
from rgbt.metrics.metric import Regions
from rgbt.metrics.names import DAY, NIGHT
from rgbt.types import Sample


@dataclass(frozen=True, kw_only=True)
class MeasurementSettings:
    """How a split is measured.

    Attributes:
        kernel: of the Laplacian, one of `KERNELS`.
        short_edge: images are resized so that their shorter edge has so many pixels, the images by
            area and the labels to the nearest pixel; 0: as they are.
        workers: threads; 0: one per core.
        skip_unreadable: leave out what cannot be read, and say so, instead of stopping.

    Raises:
        InputError: fewer than 0 workers, or a negative edge.
    """

    regions: Regions
    kernel: str = KERNELS[0]
    short_edge: int = 0
    workers: int = 0
    skip_unreadable: bool = False

    def __post_init__(self) -> None:
        check_range("workers", self.workers, 0, 1024)
        check_range("short_edge", self.short_edge, 0, 10_000)

    def resized(self, sample: Sample) -> Sample:
        """A sample in the size in which it is measured."""
        height, width = sample.thermal.shape[:2]
        if self.short_edge in (0, min(height, width)):
            return sample
        factor = self.short_edge / min(height, width)
        size = round(width * factor), round(height * factor)
        label = sample.label
        if label is not None:
            label = np.asarray(cv2.resize(label, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        rgb, thermal = (
            np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            for image in (sample.rgb, sample.thermal)
        )
        return replace(sample, rgb=rgb, thermal=thermal, label=label)


def collect(
    dataset: LabelledDataset,
    split: str,
    settings: MeasurementSettings,
    advance: Callable[[], object] = lambda: None,
    unreadable: Callable[[str], object] = lambda _: None,
) -> SpatialStatistics:
    """Read and measure every image of a split once.

    Args:
        dataset: reads labelled pairs, all of one size.
        split: of the data set.
        settings: see `MeasurementSettings`.
        advance: called once per image.
        unreadable: with `skip_unreadable`, called with the sentence about each image left out.

    Returns:
        the statistics, images in the order of the split.

    Raises:
        InputError: no such split; a file that cannot be read (without `skip_unreadable`, or all);
            an image without label or of another size than the first.
    """
    names = dataset.names(split)
    like = _first_readable(dataset, names, settings)
    region_map = settings.regions.map((like.rgb.shape[0], like.rgb.shape[1]))
    nights = dataset.nights(names)
    parts = (ALL,) if nights is None else (DAY, NIGHT)
    occupied = np.zeros((len(parts), len(dataset.classes), *region_map.shape), np.int32)
    meter, lock = ImageMeter(region_map, len(dataset.classes), settings.kernel), Lock()

    def measure(name: str, night: bool) -> ImageMeasurements | None:
        """None for an image that is left out."""
        try:
            sample = settings.resized(dataset.read(name))
        except InputError as error:
            if not settings.skip_unreadable:
                raise
            unreadable(str(error))
            advance()
            return None
        _check(sample, like)
        measured = meter(sample)
        with lock:
            for index in np.flatnonzero(measured.labels.any(0)):
                occupied[int(night), index] += sample.label == index
        advance()
        return measured

    every = in_threads(measure, names, nights or [False] * len(names), threads=settings.workers)
    found = {index: row for index, row in enumerate(every) if row is not None}
    rows, kept = list(found.values()), list(found)
    return SpatialStatistics(
        dataset=dataset.name,
        fingerprint=dataset.fingerprint(),
        split=split,
        classes=tuple(dataset.classes),
        background=tuple(dataset.background),
        palette=np.array(dataset.palette, np.uint8),
        partition=settings.regions.name,
        region_map=region_map,
        kernel=settings.kernel,
        names=tuple(names[index] for index in kept),
        night=None if nights is None else np.array(nights, bool)[kept],
        parts=parts,
        occupied=occupied,
        noise={name: np.stack([row.noise[name] for row in rows]) for name in ESTIMATORS},
        **{
            key: np.stack([getattr(row, key) for row in rows])
            for key in ("labels", "ignored", "laplacian", "mean")
        },
    )


def _check(sample: Sample, like: Sample) -> None:
    if sample.label is None:
        raise InputError(
            f"'{sample.name}' has no label; the statistics by region need one per image."
        )
    size, expected = sample.thermal.shape, like.thermal.shape
    if size != expected:
        raise InputError(
            f"'{sample.name}' is {size[0]}x{size[1]} pixels but '{like.name}' is "
            f"{expected[0]}x{expected[1]}; regions need images of one size, so give a split "
            "list for each size."
        )


def _first_readable(
    dataset: LabelledDataset, names: Sequence[str], settings: MeasurementSettings
) -> Sample:
    """The sample whose size the others must have."""
    first = ""
    for name in names:
        try:
            return settings.resized(dataset.read(name))
        except InputError as error:
            if not settings.skip_unreadable:
                raise
            first = first or str(error)
    raise InputError(
        f"none of the {len(names)} images of {dataset.name} can be read; the first one: {first}"
    )
