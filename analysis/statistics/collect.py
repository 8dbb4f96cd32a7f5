"""Measurements of a whole split: one pass, in threads, in memory that does not grow with images.

Kept per image are a few numbers by region; the maps of occupancy are added up as images come.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import chain
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.data import ALL, SpatialStatistics
from analysis.statistics.measure import ESTIMATORS, KERNELS, ImageMeasurements, ImageMeter
from rgbt.checks import InputError, check_range
from rgbt.dataset import LabelledDataset
from rgbt.metrics.metric import Regions
from rgbt.metrics.names import DAY, NIGHT
from rgbt.types import Sample

CHUNK = 32
"""Images that a thread measures before it adds its maps to the common ones; at most 255, which is
what a map of bytes can count."""


@dataclass(frozen=True, kw_only=True)
class MeasurementSettings:
    """How a split is measured.

    Attributes:
        kernel: of the Laplacian, one of `KERNELS`.
        workers: threads; 0: one per core. Threads and not processes, since decoding, filtering and
            sums run outside Python's lock. The result does not depend on their number.
        skip_unreadable: leave out what cannot be read, and say so, instead of stopping.

    Raises:
        InputError: fewer than 0 workers.
    """

    regions: Regions
    kernel: str = KERNELS[0]
    workers: int = 0
    skip_unreadable: bool = False

    def __post_init__(self) -> None:
        check_range("workers", self.workers, 0, 1024)


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
        split: its split.
        settings: see `MeasurementSettings`.
        advance: called once per image.
        unreadable: with `skip_unreadable`, called with the sentence about each image left out.

    Returns:
        the statistics, images in the order of the split.

    Raises:
        InputError: no such split; a file that cannot be read (without `skip_unreadable`, or all);
            an image without label or of another size than the first; a data set whose background
            is not class 0.
    """
    if dataset.unscored and dataset.unscored[0] != dataset.classes[0]:
        raise InputError(
            f"these statistics take class 0 for the background, as MFNet has it, but class 0 of "
            f"{dataset.name} is '{dataset.classes[0]}' and its background "
            f"{' and '.join(dataset.unscored)}; they are not made for it yet."
        )
    names = dataset.names(split)
    first = _first_readable(dataset, names, settings)
    region_map = settings.regions.map((first.rgb.shape[0], first.rgb.shape[1]))
    nights = dataset.nights(names)
    classes = len(dataset.classes)
    parts = (ALL,) if nights is None else (DAY, NIGHT)
    work = _SharedWork(
        dataset=dataset,
        meter=ImageMeter(region_map, classes, settings.kernel),
        like=first,
        part_of=dict(zip(names, [0] * len(names) if nights is None else nights, strict=True)),
        occupied=np.zeros((len(parts), classes, *region_map.shape), np.int32),
        skip_unreadable=settings.skip_unreadable,
        advance=advance,
        unreadable=unreadable,
    )
    measured = _in_threads(work, names, settings.workers or os.cpu_count() or 1)
    kept = [index for index, each in enumerate(measured) if each is not None]
    rows = [each for each in measured if each is not None]
    return SpatialStatistics(
        dataset=dataset.name,
        fingerprint=dataset.fingerprint(),
        split=split,
        classes=tuple(dataset.classes),
        palette=np.array(dataset.palette, np.uint8),
        partition=settings.regions.name,
        region_map=region_map,
        kernel=settings.kernel,
        names=tuple(names[index] for index in kept),
        night=None if nights is None else np.array(nights, bool)[kept],
        labels=np.stack([row.labels for row in rows]),
        ignored=np.stack([row.ignored for row in rows]),
        parts=parts,
        occupied=work.occupied,
        laplacian=np.stack([row.laplacian for row in rows]),
        mean=np.stack([row.mean for row in rows]),
        noise={name: np.stack([row.noise[name] for row in rows]) for name in ESTIMATORS},
    )


@dataclass(frozen=True, kw_only=True)
class _SharedWork:
    """What the threads share: all of it is read only but the maps, which a lock guards."""

    dataset: LabelledDataset
    meter: ImageMeter
    like: Sample
    part_of: Mapping[str, int]
    occupied: NDArray[np.int32]
    skip_unreadable: bool
    advance: Callable[[], object]
    unreadable: Callable[[str], object]
    lock: Lock = field(default_factory=Lock)

    def measure(self, names: Sequence[str]) -> list[ImageMeasurements | None]:
        """Measurements of up to `CHUNK` images; None for one that is left out."""
        maps = np.zeros(self.occupied.shape, np.uint8)
        found = []
        for name in names:
            sample = self._read(name)
            measured = None if sample is None else self.meter(sample)
            if sample is not None and measured is not None:
                _add_label(maps[int(self.part_of[name])], sample, measured)
            found.append(measured)
            self.advance()
        with self.lock:
            np.add(self.occupied, maps, out=self.occupied)
        return found

    def _read(self, name: str) -> Sample | None:
        try:
            sample = self.dataset.read(name)
        except InputError as error:
            if not self.skip_unreadable:
                raise
            self.unreadable(str(error))
            return None
        if sample.label is None:
            raise InputError(f"'{name}' has no label; the statistics by region need one per image.")
        size, expected = sample.thermal.shape, self.like.thermal.shape
        if size != expected:
            raise InputError(
                f"'{name}' is {size[0]}x{size[1]} pixels but '{self.like.name}' is "
                f"{expected[0]}x{expected[1]}; regions need images of one size, so give a split "
                "list for each size."
            )
        return sample


def _add_label(maps: NDArray[np.uint8], sample: Sample, measured: ImageMeasurements) -> None:
    """Add one to the map of its class at every pixel; (K, H, W) in place."""
    assert sample.label is not None, "only labelled samples are measured"
    for index in np.flatnonzero(measured.labels.any(0)):
        np.add(maps[index], (sample.label == index).view(np.uint8), out=maps[index])


def _in_threads(
    work: _SharedWork, names: Sequence[str], workers: int
) -> list[ImageMeasurements | None]:
    """`work.measure` of all names, in order; the first error stops what has not begun."""
    # Short lists still keep every thread busy.
    size = max(1, min(CHUNK, -(-len(names) // (4 * workers))))
    chunks = [names[begin : begin + size] for begin in range(0, len(names), size)]
    pool = ThreadPoolExecutor(workers)
    try:
        return list(chain.from_iterable(pool.map(work.measure, chunks)))
    finally:
        pool.shutdown(cancel_futures=True)


def _first_readable(
    dataset: LabelledDataset, names: Sequence[str], settings: MeasurementSettings
) -> Sample:
    """The sample whose size the others must have."""
    first = ""
    for name in names:
        try:
            return dataset.read(name)
        except InputError as error:
            if not settings.skip_unreadable:
                raise
            first = first or str(error)
    raise InputError(
        f"none of the {len(names)} images of {dataset.name} can be read; the first one: {first}"
    )
