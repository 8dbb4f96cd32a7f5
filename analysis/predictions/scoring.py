"""Predictions counted by region and by pixel, in one pass over the images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from analysis.bar import in_threads
from analysis.predictions.folder import Missing, PredictionFiles, find
from analysis.predictions.maps import MapSum, PixelMaps
from rgbt.checks import InputError, check_choice
from rgbt.data.predictions import Array, FormatOptions, PredictionReader
from rgbt.dataset import LabelledDataset
from rgbt.metrics.counting import RegionCounter
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent, Partition, Regions

Resize = Literal["refuse", "nearest", "stretch"]
MOST_STRETCH = 0.05
"""Ratio of the aspects of prediction and label, less 1, up to which one is a resized other."""

PARTITIONS: tuple[Partition, ...] = get_args(Partition)


@dataclass(frozen=True, kw_only=True)
class ScoringOptions:
    """How a folder of predictions is counted.

    Attributes:
        partitions: how the image is cut; all are counted in the same pass.
        regions: R of each partition.
        format: see `rgbt.data.predictions.FormatOptions`.
        missing: "refuse", or "leave_out" to count only the images that have a prediction.
        resize: "refuse" predictions of another size than the label, or take for every pixel of the
            label the "nearest" one of the prediction (by pixel centres); "stretch" does so too
            where the ratio of height and width differs.
        name: of the method; "": the folder's name.
        threads: that read and count; 0: one per core.
        absent: convention for absent classes of the data set, stored with the counts.
    """

    partitions: tuple[Partition, ...] = PARTITIONS
    regions: int = 5
    format: FormatOptions = FormatOptions()
    missing: Missing = "refuse"
    resize: Resize = "refuse"
    name: str = ""
    threads: int = 0
    absent: Absent = "released"

    def __post_init__(self) -> None:
        for partition in self.partitions:
            check_choice("partition", partition, PARTITIONS)
        check_choice("absent", self.absent, get_args(Absent))
        check_choice("missing", self.missing, get_args(Missing))
        check_choice("resize", self.resize, get_args(Resize))


@dataclass(frozen=True)
class FolderScores:
    """Result of counting a folder of predictions.

    Attributes:
        counts: one per partition, in the order of `ScoringOptions.partitions`.
        maps: counts by pixel; None where the images differ in size.
        found: which files were read, which are missing, which belong to no image.
        resized: name of an image whose prediction had another size -> both sizes, such as "480x640
            to 720x1280".
    """

    name: str
    counts: tuple[Counts, ...]
    maps: PixelMaps | None
    found: PredictionFiles
    resized: dict[str, str]


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
    found = find(folder, dataset, split, options.format.affixes, options.missing)
    paths = found.paths.values()
    reader = PredictionReader(dataset.classes, dataset.palette, options.format)
    names = tuple(found.paths)
    counters = [
        RegionCounter(dataset.num_classes, _regions(partition, options.regions))
        for partition in options.partitions
    ]
    maps = MapSum(dataset.num_classes)

    def count(image: str, path: Path) -> tuple[NDArray[np.int64], str]:
        """Counts (partitions, R, K, K), and both sizes if it was resized."""
        label = dataset.label(image)
        if label is None:
            raise InputError(
                f"'{image}' of {dataset.name} has no label to count predictions against; "
                "choose a labelled split."
            )
        prediction, sizes = reader.read(path), ""
        if prediction.shape != label.shape:
            sizes = f"{_size(prediction)} to {_size(label)}"
            prediction = _resized(prediction, label, path, options.resize)
        maps.add(label, prediction)
        return np.stack([counter(label, prediction) for counter in counters]), sizes

    shape = (len(counters), len(names), options.regions, *[dataset.num_classes] * 2)
    counts = np.zeros(shape, np.int32)
    resized = {}
    every = in_threads(count, names, paths, threads=options.threads)
    for index, (matrices, sizes) in enumerate(every):
        counts[:, index] = matrices
        if sizes:
            resized[names[index]] = sizes
        advance()
    name = options.name or folder.resolve().name
    shared: dict[str, Any] = {"classes": dataset.classes, "unscored": dataset.unscored}
    shared |= {"split": split, "dataset": dataset.fingerprint()}
    summed = None
    if maps.sums is not None and maps.is_one_size:
        both = {"intersection": maps.sums[0], "union": maps.sums[1]}
        about: Any = {"images": len(names), "palette": dataset.palette, "name": name}
        summed = PixelMaps(**both, **about, **shared)
    shared |= {"names": names, "night": dataset.nights(names), "absent": options.absent}
    made = [
        Counts(counts=by_image, partition=counter.regions.name, **shared)
        for by_image, counter in zip(counts, counters, strict=True)
    ]
    return FolderScores(name, tuple(made), summed, found, resized)


def _resized(prediction: Array, label: Array, path: Path, resize: Resize) -> Array:
    (height, width), (rows, columns) = prediction.shape, label.shape
    if resize == "refuse":
        raise InputError(
            f"{path} is {height}x{width} pixels but its label is {rows}x{columns}; write "
            "predictions at the size of the label, or count the nearest pixel with resize=nearest."
        )
    if resize == "nearest" and abs(height / width / (rows / columns) - 1) > MOST_STRETCH:
        raise InputError(
            f"{path} is {height}x{width} pixels and its label {rows}x{columns}, which is another "
            "shape and no other size; is it turned, or cropped? If the method resized whole images "
            "to this shape, set resize=stretch."
        )
    nearest = cv2.resize(prediction, (columns, rows), interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(nearest)


def _size(image: Array) -> str:
    return "x".join(map(str, image.shape))


def _regions(partition: Partition, regions: int) -> Regions:
    aspect: Literal["image"] | None = "image" if partition == "ring" else None
    return Regions(partition=partition, regions=regions, aspect=aspect, absent="released")
