"""Find the predictions of a split in a folder and count them by region and by pixel."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from analysis.commands import in_threads
from analysis.predictions.maps import PixelMaps, add_image
from rgbt.checks import InputError
from rgbt.config.common_options import PredictionFormatOptions
from rgbt.data.predictions import OVERLAY, Array, PredictionReader
from rgbt.dataset import LabelledDataset
from rgbt.metrics.counting import region_counts
from rgbt.metrics.counts import Counts
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.metric import Absent, Partition, Regions
from rgbt.metrics.scores import ratio

Resize = Literal["refuse", "nearest", "stretch"]

PARTITIONS: tuple[Partition, ...] = get_args(Partition)

# Ratio of the aspects of prediction and label, less 1, up to which one is a resized other.
MOST_STRETCH = 0.05

# IoU that two labels or more gain by other indices of the predictions before a remark says so.
LEAST_GAIN = 0.1

# Most names that a message lists.
SHOWN = 3


@dataclass(frozen=True)
class FolderScores:
    """Result of counting a folder of predictions.

    Attributes:
        counts: one per partition, in the order of the partitions.
        maps: counts by pixel; None where the images differ in size.
        extra: names of PNG files that belong to no image of the split (overlays left out).
        resized: name of an image whose prediction had another size -> both sizes, such as "480x640
            to 720x1280".
        background: classes of the data set that are no object.
        labels: list of the split and sizes of its labels, in words.
    """

    name: str
    counts: tuple[Counts, ...]
    maps: PixelMaps | None
    extra: tuple[str, ...]
    resized: dict[str, str]
    background: tuple[str, ...]
    labels: str

    def save(self, folder: Path) -> None:
        """Write ``counts_<partition>.npz`` of each partition, and ``maps.npz``."""
        folder.mkdir(parents=True, exist_ok=True)
        for counts in self.counts:
            counts.save(folder / f"counts_{counts.partition}.npz")
        if self.maps is not None:
            self.maps.save(folder / "maps.npz")

    def remarks(self) -> list[str]:
        """Say what a reader of the numbers needs to know about the folder, a sentence each."""
        remarks = []
        for sizes, number in Counter(self.resized.values()).items():
            remarks.append(
                f"{number} predictions were resized to their label by the nearest pixel, from "
                f"{sizes}."
            )
        if self.extra:
            remarks.append(
                f"{len(self.extra)} other PNG files of the folder belong to no image of the split "
                f"and were not read ({_listed(self.extra)})."
            )
        remarks += class_remarks(self.counts[0])
        if self.maps is None:
            remarks.append("The images differ in size, so there is no map by pixel.")
        return remarks


def find(
    folder: Path, names: Sequence[str], reader: PredictionReader
) -> tuple[list[Path], tuple[str, ...]]:
    """Find the predictions of images in their order: files as `PredictionReader.path` names them.

    Also the names of other PNG files, overlays apart. InputError: no such folder, or a file misses.
    """
    if not folder.is_dir():
        raise InputError(f"predictions: no such folder: {folder}")
    found = set(folder.glob("*.png"))
    paths = [reader.path(folder, name) for name in names]
    absent = [path.relative_to(folder).as_posix() for path in paths if path not in found]
    if absent:
        held = _listed(sorted(path.name for path in folder.iterdir())) or "nothing"
        raise InputError(
            f"predictions: {folder} lacks {len(absent)} of the {len(names)} images of the split "
            f"({_listed(absent)}); it contains {held}. Add them, or choose another split."
        )
    overlays = (folder / f"{name}{OVERLAY}.png" for name in names)
    others = found.difference(paths, overlays)
    return paths, tuple(sorted(path.stem for path in others))


def score_folder(  # noqa: PLR0913 - options of a command
    folder: Path,
    dataset: LabelledDataset,
    split: str,
    *,
    partitions: tuple[Partition, ...] = PARTITIONS,
    regions: int = 5,
    given: PredictionFormatOptions = PredictionFormatOptions(),  # noqa: B008 - frozen
    resize: Resize = "refuse",
    name: str = "",
    absent: Absent = "released",
    advance: Callable[[], None] = lambda: None,
) -> FolderScores:
    """Count predicted label images of any method against the labels of a split.

    The same files give the same counts whatever the number of threads. Memory: the counts, the
    pixel maps (8 K H W bytes) and one image per thread.

    Args:
        folder: holds NAME.png for every image of the split; other files are not read.
        dataset: names, labels, classes and colours.
        split: of the data set.
        partitions: how the image is cut; all are counted in the same pass.
        regions: R of each partition.
        given: the format of the files.
        resize: "refuse" predictions of another size than the label, or take for every pixel of the
            label the "nearest" one of the prediction (by pixel centres); "stretch" does so too
            where the ratio of height and width differs.
        name: of the method; "": the folder's name.
        absent: convention for absent classes of the data set, stored with the counts.
        advance: called after each image.

    Raises:
        InputError: files missing, unreadable, of another size, or with values that are no class;
            of several, the first in the order of the split.
    """
    names = dataset.names(split)
    reader = PredictionReader(dataset.classes, dataset.palette, *given.form)
    paths, extra = find(folder, names, reader)
    cuts = [_regions(partition, regions) for partition in partitions]
    size = _label_of(dataset, names[0]).shape
    sums, lock = np.zeros((2, dataset.num_classes, *size), np.int32), Lock()

    def count(image: str, path: Path) -> tuple[NDArray[np.int64], str, str]:
        """Return counts (partitions, R, K, K), the size of the label, and both sizes."""
        label, prediction, sizes = _label_of(dataset, image), reader.read(path), ""
        if prediction.shape != label.shape:
            sizes = f"{_size(prediction)} to {_size(label)}"
            prediction = _resized(prediction, label, path, resize)
        if label.shape == size:
            with lock:
                add_image(sums, label, prediction)
        matrices = []
        for cut in cuts:
            matrices.append(region_counts(label, prediction, dataset.num_classes, cut))
        return np.stack(matrices), _size(label), sizes

    shape = (len(cuts), len(names), regions, *[dataset.num_classes] * 2)
    counts, resized, label_sizes = np.zeros(shape, np.int32), {}, set()
    for index, (matrices, label_size, sizes) in enumerate(in_threads(count, names, paths)):
        counts[:, index] = matrices
        label_sizes.add(label_size)
        if sizes:
            resized[names[index]] = sizes
        advance()
    name = name or folder.resolve().name
    shared: dict[str, Any] = {"classes": dataset.classes, "unscored": dataset.unscored}
    of: dict[str, Any] = {"split": split, "dataset": dataset.fingerprint()}
    maps = None
    if len(label_sizes) == 1:
        about: Any = {"images": len(names), "palette": dataset.palette, "name": name}
        maps = PixelMaps(intersection=sums[0], union=sums[1], **about, **of, **shared)
    # Whatever a method gets to see, the images are those of both cameras.
    of |= {"absent": absent, "view": "rgbt", "dataset_name": dataset.name}
    shared |= {"names": names, "night": dataset.nights(names)}
    made = []
    for by_image, cut in zip(counts, cuts, strict=True):
        measurement = Measurement(partition=cut.name, **of)
        made.append(Counts(counts=by_image, measurement=measurement, **shared))
    labels = f"{dataset.splits[split]}, labels of {_listed(sorted(label_sizes))} pixels"
    return FolderScores(name, tuple(made), maps, extra, resized, dataset.background, labels)


def class_remarks(counts: Counts) -> list[str]:
    """Say which classes seem to have another index than that of the data set, or no prediction.

    The IoU of every label with every prediction is compared with that of the best assignment of
    one prediction to each label. A table alone would show a low score.
    """
    matrix, remarks = counts.whole().astype(np.float64), []
    labelled, predicted = matrix.sum(1), matrix.sum(0)
    overlap = ratio(matrix, labelled[:, None] + predicted - matrix, "released")
    best = linear_sum_assignment(overlap, maximize=True)[1]
    gains = overlap[np.arange(len(best)), best] - overlap.diagonal()
    gaining = np.flatnonzero(gains > LEAST_GAIN).tolist()
    if len(gaining) > 1:  # a network that predicts one class alone may fit one other label better
        fits = [f"{best[label]} as {label} ({counts.classes[label]})" for label in gaining]
        remarks.append(
            "The classes seem to have other indices than those of the data set: predictions fit "
            f"the labels better with {', '.join(fits)}."
        )
    unpredicted = np.flatnonzero((labelled > 0) & (predicted == 0) & counts.scored).tolist()
    if unpredicted:
        names = ", ".join(counts.classes[label] for label in unpredicted)
        remarks.append(f"No prediction holds these classes of the labels: {names}.")
    return remarks


def _label_of(dataset: LabelledDataset, image: str) -> Array:
    label = dataset.label(image)
    if label is None:
        raise InputError(f"split: '{image}' of {dataset.name} has no label to count against.")
    return label


def _resized(prediction: Array, label: Array, path: Path, resize: Resize) -> Array:
    (height, width), (rows, columns) = prediction.shape, label.shape
    sizes = f"resize: {path} is {_size(prediction)} pixels but its label is {_size(label)}"
    if resize == "refuse":
        raise InputError(f"{sizes}; set resize=nearest to count the nearest pixel.")
    if resize == "nearest" and abs(height / width / (rows / columns) - 1) > MOST_STRETCH:
        raise InputError(
            f"{sizes}, which is another shape: is it turned, or cropped? If the method resized "
            "whole images to this shape, set resize=stretch."
        )
    nearest = cv2.resize(prediction, (columns, rows), interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(nearest)


def _size(image: Array) -> str:
    return "x".join(map(str, image.shape))


def _regions(partition: Partition, regions: int) -> Regions:
    aspect: Literal["image"] | None = "image" if partition == "ring" else None
    return Regions(partition=partition, regions=regions, aspect=aspect, absent="released")


def _listed(names: Sequence[str]) -> str:
    """List the first names of many, for a sentence."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more
