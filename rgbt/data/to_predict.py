"""Find the images to predict: a split, a folder of new images, one file or two files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rgbt.checks import InputError, nearest
from rgbt.data.images import PairReader, ReadsPairs
from rgbt.data.new_images import find_pairs
from rgbt.dataset import LabelledDataset, reader_of
from rgbt.types import Sample

ENDINGS = (".png", "_overlay.png")
"""Endings of the two files written per image."""


@dataclass(frozen=True)
class ToPredict:
    """PairReader to predict, in order.

    Attributes:
        names: of the images; names of written files begin with them.
        read: name -> its images, without a label.
        folders: of the files, which must not be overwritten.
        skipped: name -> error, of skipped images; `samples` adds to it.
        others: further images, which belong to no pair.
    """

    names: tuple[str, ...]
    read: Callable[[str], Sample]
    folders: frozenset[Path]
    skipped: dict[str, str] = field(default_factory=dict)
    others: tuple[Path, ...] = ()

    def samples(self, on_error: Literal["raise", "skip"]) -> Iterator[Sample]:
        """The images one after the other.

        Raises:
            InputError: one cannot be read and `on_error` is "raise", or none can.
        """
        for name in self.names:
            try:
                sample = self.read(name)
            except InputError as error:
                if on_error == "raise":
                    raise
                self.skipped[name] = str(error)
                continue
            yield sample
        if self.names and not set(self.names) - self.skipped.keys():
            first = self.skipped[self.names[0]]
            raise InputError(f"none of the {len(self.names)} images can be read: {first}")

    def check_out(self, out: Path) -> None:
        """Refuse a folder in which input or output images would be overwritten."""
        if out.resolve() in {folder.resolve() for folder in self.folders}:
            raise InputError(
                f"out={out} holds the input images, which would be overwritten; choose another "
                "folder."
            )
        written: dict[str, str] = {}
        for name in self.names:
            for file in (f"{name}{ending}" for ending in ENDINGS):
                if file in written:
                    raise InputError(
                        f"'{written[file]}' and '{name}' would both be written to {out / file}; "
                        "rename one of the images."
                    )
                written[file] = name


def of_split(dataset: LabelledDataset, split: str) -> ToPredict:
    """The images of a split; labels are not read if the data set can read pairs alone."""
    names = dataset.names(split)
    reader = reader_of(dataset)
    read = reader.pair if isinstance(reader, ReadsPairs) else reader.read
    folders = {path.parent for name in names for path in dataset.files(name)}
    return ToPredict(names, read, frozenset(folders))


def of_path(dataset: LabelledDataset, text: str, on_error: Literal["raise", "skip"]) -> ToPredict:
    """The image of a packed file, or the pairs of a folder (see `find_pairs`).

    An RGB image without a thermal image is left out if `on_error` is "skip".

    Raises:
        InputError: no such path, no pair in the folder, an RGB image without a thermal one.
    """
    path, images = Path(text), images_of(dataset)
    if path.is_file():
        return of_files(dataset, path, path)
    if not path.is_dir():
        raise InputError(
            f"input={text}: this is neither a file, nor a folder, nor a split of {dataset.name}; "
            f"splits: {nearest(text, dataset.splits)}."
        )
    found = find_pairs(path, images.layouts, dataset.name)
    for rgb, thermal in list(found.alone.items())[: on_error == "raise"]:
        raise InputError(
            f"input={text}: {len(found.alone)} of {len(found.alone) + len(found.pairs)} RGB "
            f"images have no thermal image, the first is {rgb}: expected {thermal}. Restore it, "
            "or skip such images with data.on_error=skip."
        )
    pairs = {pair.name: pair for pair in found.pairs}
    folders = {path, *(file.parent for pair in found.pairs for file in pair[1:])}
    skipped = {str(rgb): f"{rgb} has no {thermal}." for rgb, thermal in found.alone.items()}
    return ToPredict(
        tuple(pairs),
        lambda name: images.read(*pairs[name]),
        frozenset(folders),
        skipped,
        found.others,
    )


def of_files(dataset: LabelledDataset, rgb: Path, thermal: Path) -> ToPredict:
    """One pair, named after its RGB file; the same file twice is a packed one."""
    images = images_of(dataset)
    return ToPredict(
        (rgb.stem,),
        lambda name: images.read(name, rgb, thermal),
        frozenset({rgb.parent, thermal.parent}),
    )


def of_arrays(dataset: LabelledDataset, rgb: Any, thermal: Any) -> Sample:
    """One pair of arrays, without a label.

    Thermal values of 8 bits are grey levels, as in `Sample`. Values of other types are those of the
    camera, and both images are read like files of the data set: cut, and scaled by its
    ``thermal_range``.

    Args:
        dataset: of the network.
        rgb: (H, W, 3) uint8, RGB order.
        thermal: (H, W), uint8 or camera values.

    Raises:
        InputError: other types, shapes or values.
    """
    for name, image in (("rgb", rgb), ("thermal", thermal)):
        if not isinstance(image, np.ndarray):
            raise InputError(
                f"{name}: expected a NumPy array, got {type(image).__name__}; convert it with "
                "numpy.asarray(...), or give the paths of both files."
            )
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or not rgb.size:
        raise InputError(
            "rgb: expected uint8 of shape (rows, columns, 3) in the order red, green, blue, got "
            f"{rgb.dtype} of shape {rgb.shape}."
        )
    if thermal.shape != rgb.shape[:2]:
        raise InputError(
            f"thermal: expected shape {rgb.shape[:2]}, the rows and columns of rgb, got "
            f"{thermal.shape}."
        )
    reader = reader_of(dataset)
    if thermal.dtype != np.uint8:
        images = images_of(dataset)
        path = Path("thermal")
        return images.sample("image", rgb, images.check_values(thermal, path), path)
    limits = reader.images.thermal_range if isinstance(reader, ReadsPairs) else None
    if limits is not None and limits[0] < 255:
        raise InputError(
            f"thermal: 8 bits may be grey levels or values of dataset.thermal_range={list(limits)};"
            " convert values of the camera to float32, or give the paths of both files."
        )
    return Sample(np.ascontiguousarray(rgb), np.ascontiguousarray(thermal), None, "image")


def images_of(dataset: LabelledDataset) -> PairReader:
    """The reader of new images of a data set; InputError if it has none."""
    reader = reader_of(dataset)
    if not isinstance(reader, ReadsPairs):
        raise InputError(
            f"{type(reader).__name__} does not declare how to read new images. Name one of its "
            f"splits ({', '.join(reader.splits)}), or give the class `images` and `pair` (see "
            "docs/tutorials/own-data-set.md)."
        )
    return reader.images
