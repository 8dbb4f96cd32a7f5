"""Predictions counted by region and by pixel, in one pass over the images."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from analysis.predictions.folder import Missing, PredictionFiles, find
from analysis.predictions.images import Array, Format, PredictionReader, check_one_kind
from analysis.predictions.maps import MapSum, PixelMaps
from rgbt.checks import InputError, check_choice
from rgbt.dataset import LabelledDataset
from rgbt.metrics.confusion import RegionCounter
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent, Regions
from rgbt.metrics.regions import Partition

Resize = Literal["refuse", "nearest"]
MOST_STRETCH = 0.05
"""Ratio of the aspects of prediction and label, less 1, up to which one is a resized other."""

PARTITIONS: tuple[Partition, ...] = get_args(Partition)


@dataclass(frozen=True, kw_only=True)
class ScoringOptions:
    """How a folder of predictions is counted.

    Attributes:
        partitions: how the image is cut; all are counted in the same pass.
        regions: R of each partition.
        form: how files are read, see `analysis.predictions.images.PredictionReader`.
        missing: "refuse", or "leave_out" to count only the images that have a prediction.
        resize: "refuse" predictions of another size than the label, or take for every pixel of the
            label the "nearest" one of the prediction (by pixel centres).
        suffix: files are called NAME + suffix + ".png".
        name: of the method; "": the folder's name.
        threads: that read and count; 0: one per core.
        absent: convention for absent classes of the data set, stored with the counts.
    """

    partitions: tuple[Partition, ...] = PARTITIONS
    regions: int = 5
    form: Format = "auto"
    missing: Missing = "refuse"
    resize: Resize = "refuse"
    suffix: str = ""
    name: str = ""
    threads: int = 0
    absent: Absent = "released"

    def __post_init__(self) -> None:
        for partition in self.partitions:
            check_choice("partition", partition, PARTITIONS)
        check_choice("format", self.form, get_args(Format))
        check_choice("absent", self.absent, get_args(Absent))
        check_choice("missing", self.missing, get_args(Missing))
        check_choice("resize", self.resize, get_args(Resize))


@dataclass(frozen=True)
class FolderScores:
    """What a folder of predictions gave.

    Attributes:
        counts: one per partition, in the order of `ScoringOptions.partitions`.
        maps: counts by pixel; None where the images differ in size.
        found: which files were read, which are missing, which belong to no image.
        resized: names of images whose prediction had another size.
    """

    name: str
    counts: tuple[Counts, ...]
    maps: PixelMaps | None
    found: PredictionFiles
    resized: tuple[str, ...]


def score_folder(
    folder: Path,
    dataset: LabelledDataset,
    split: str,
    options: ScoringOptions = ScoringOptions(),  # noqa: B008 - frozen
    advance: Callable[[], None] = lambda: None,
) -> FolderScores:
    """Count predicted label images of any method against the labels of a split.

    The same files give the same counts whatever the number of threads. Memory: the counts, the
    pixel maps (10 K H W bytes) and one image per thread.

    Args:
        folder: holds NAME.png for every image of the split; other files are not read.
        dataset: names, labels, classes and colours.
        split: of the data set.
        options: see `ScoringOptions`.
        advance: called after each image.

    Raises:
        InputError: files missing, unreadable, of another size, or with values that are no class;
            of several, the first in the order of the split.
    """
    found = find(folder, dataset, split, options.suffix, options.missing)
    if options.form == "auto":
        check_one_kind(found.paths.values())
    counting = _CountingPass(dataset, options)
    names = tuple(found.paths)
    size = (len(options.partitions), len(names), options.regions, *[dataset.num_classes] * 2)
    counts = np.zeros(size, np.int32)
    resized = []
    for index, (matrices, was_resized) in enumerate(counting.run(found)):
        counts[:, index] = matrices
        if was_resized:
            resized.append(names[index])
        advance()
    fingerprint, name = dataset.fingerprint(), options.name or folder.resolve().name
    return FolderScores(
        name=name,
        counts=tuple(
            Counts(
                counts=by_image,
                names=names,
                night=dataset.nights(names),
                classes=dataset.classes,
                partition=counter.regions.name,
                dataset=fingerprint,
                split=split,
                unscored=dataset.unscored,
                absent=options.absent,
            )
            for by_image, counter in zip(counts, counting.counters, strict=True)
        ),
        maps=counting.maps(fingerprint, split, name, len(names)),
        found=found,
        resized=tuple(resized),
    )


class _CountingPass:
    """The state of one pass, shared by its threads."""

    def __init__(self, dataset: LabelledDataset, options: ScoringOptions) -> None:
        self.dataset = dataset
        self.options = options
        self.reader = PredictionReader(dataset.classes, dataset.palette, options.form)
        self.counters = [
            RegionCounter(dataset.num_classes, _regions(partition, options.regions))
            for partition in options.partitions
        ]
        self._sum: MapSum | None = None
        self._sizes: set[tuple[int, ...]] = set()
        self._lock = threading.Lock()

    def run(self, found: PredictionFiles) -> Iterator[tuple[NDArray[np.int64], bool]]:
        """Counts (partitions, R, K, K) and whether it was resized, of every image in order."""
        threads = self.options.threads or os.cpu_count() or 1
        with ThreadPoolExecutor(threads) as pool:
            try:
                yield from pool.map(self._one, found.paths, found.paths.values())
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def maps(self, fingerprint: str, split: str, name: str, images: int) -> PixelMaps | None:
        """What was added up, None if the images differed in size."""
        if self._sum is None or len(self._sizes) > 1:
            return None
        self._sum.flush()
        return PixelMaps(
            intersection=self._sum.intersection,
            union=self._sum.union,
            images=images,
            classes=self.dataset.classes,
            palette=self.dataset.palette,
            dataset=fingerprint,
            split=split,
            name=name,
            unscored=self.dataset.unscored,
        )

    def _one(self, name: str, path: Path) -> tuple[NDArray[np.int64], bool]:
        label = self.dataset.label(name)
        if label is None:
            raise InputError(
                f"'{name}' of {self.dataset.name} has no label to count predictions against; "
                "choose a labelled split."
            )
        prediction = self.reader.read(path)
        differs = prediction.shape != label.shape
        if differs:
            prediction = self._resized(prediction, label, path)
        self._add(label, prediction)
        return np.stack([counter(label, prediction) for counter in self.counters]), differs

    def _resized(self, prediction: Array, label: Array, path: Path) -> Array:
        shapes = (prediction.shape, label.shape)
        aspects = [height / width for height, width in shapes]
        if self.options.resize == "nearest" and abs(aspects[0] / aspects[1] - 1) > MOST_STRETCH:
            raise InputError(
                f"{path} is {prediction.shape[0]}x{prediction.shape[1]} pixels and its label "
                f"{label.shape[0]}x{label.shape[1]}, which is another shape and no other size; is "
                "it turned, or cropped? write predictions of the whole image."
            )
        if self.options.resize == "refuse":
            raise InputError(
                f"{path} is {prediction.shape[0]}x{prediction.shape[1]} pixels but its label is "
                f"{label.shape[0]}x{label.shape[1]}; write predictions at the size of the label, "
                "or count the nearest pixel with resize=nearest."
            )
        size = (label.shape[1], label.shape[0])
        return np.asarray(cv2.resize(prediction, size, interpolation=cv2.INTER_NEAREST_EXACT))

    def _add(self, label: Array, prediction: Array) -> None:
        with self._lock:
            self._sizes.add(label.shape)
            if self._sum is None:
                self._sum = MapSum(self.dataset.num_classes, (label.shape[0], label.shape[1]))
            summed = self._sum
        if summed.union.shape[1:] == label.shape:
            summed.add(label, prediction)


def _regions(partition: Partition, regions: int) -> Regions:
    aspect: Literal["image"] | None = "image" if partition == "ring" else None
    return Regions(partition=partition, regions=regions, aspect=aspect, absent="released")
