"""Find the images to predict: a split, a folder of new images, one file, two files or arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rgbt.checks import InputError, nearest
from rgbt.data.images import PairPattern, PairReader, ReadsPairs
from rgbt.data.patterns import Pattern, in_order, what_is_in
from rgbt.dataset import LabelledDataset, reader_of
from rgbt.types import Sample

KINDS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Suffixes of image files."""

PLAIN = (
    *(PairPattern(f"rgb/{{name}}{kind}", f"thermal/{{name}}{kind}") for kind in KINDS),
    PairPattern("{name}.png", "{name}.png"),
)
"""Layouts that are read for every data set: folders rgb and thermal, or files of four channels."""


@dataclass(frozen=True)
class ToPredict:
    """Images to predict, in order.

    Attributes:
        names: of the images; names of written files begin with them.
        read: name -> its images, without a label.
        folders: of the files, which must not be overwritten.
        skipped: name -> error, of skipped images; `samples` adds to it.
    """

    names: tuple[str, ...]
    read: Callable[[str], Sample]
    folders: frozenset[Path]
    skipped: dict[str, str] = field(default_factory=dict)

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
        if self.names and self.skipped.keys() >= set(self.names):
            first = self.skipped[self.names[0]]
            raise InputError(f"none of the {len(self.names)} images can be read: {first}")

    def check_out(self, out: Path) -> None:
        """Refuse a folder that holds the input images, which would be overwritten."""
        if out.resolve() in {folder.resolve() for folder in self.folders}:
            raise InputError(f"out={out} holds the input images; choose another folder.")
        twice = [name for name in self.names if f"{name}_overlay" in self.names]
        if twice:
            raise InputError(
                f"out: the files of '{twice[0]}' and '{twice[0]}_overlay' are the same."
            )


def of_split(dataset: LabelledDataset, split: str) -> ToPredict:
    """The images of a split; labels are not read if the data set can read pairs alone."""
    names = dataset.names(split)
    reader = reader_of(dataset)
    read = reader.pair if isinstance(reader, ReadsPairs) else reader.read
    folders = {path.parent for name in names for path in dataset.files(name)}
    return ToPredict(names, read, frozenset(folders))


def of_path(dataset: LabelledDataset, text: str, on_error: Literal["raise", "skip"]) -> ToPredict:
    """The image of a packed file, or the pairs of a folder.

    A folder is read by the patterns of the data set, or by `PLAIN`: the first of them that matches
    a pair. An RGB image without a thermal image is left out if `on_error` is "skip".

    Raises:
        InputError: no such path, no pair in the folder, two pairs of one name, an RGB image without
            a thermal one.
    """
    folder, images = Path(text), images_of(dataset)
    if folder.is_file():
        return of_files(dataset, folder, folder)
    if not folder.is_dir():
        raise InputError(
            f"input={text}: this is neither a file, nor a folder, nor a split of {dataset.name}; "
            f"splits: {nearest(text, dataset.splits)}."
        )
    pairs: dict[str, tuple[Path, Path]] = {}
    layouts = iter((*images.layouts, *PLAIN))
    while not any(thermal.is_file() for _, thermal in pairs.values()):
        layout = next(layouts, None)
        if layout is None:
            wanted = "; ".join(map(str, images.layouts))
            raise InputError(
                f"input={folder} holds no pair of images but {what_is_in(folder)}; expected "
                f"{wanted}, or folders rgb and thermal with equal names, or PNG files of four "
                "channels. To predict a single pair, use rgb=FILE thermal=FILE."
            )
        pairs = _pairs(folder, layout)
    alone = {str(rgb): f"{rgb} has no {path}." for rgb, path in pairs.values() if not path.exists()}
    for reason in list(alone.values())[: on_error == "raise"]:
        raise InputError(
            f"input={text}: {len(alone)} RGB images have no thermal image: {reason} Restore it, or "
            "skip such images with data.on_error=skip."
        )
    pairs = {name: pair for name, pair in pairs.items() if str(pair[0]) not in alone}
    folders = {folder, *(file.parent for pair in pairs.values() for file in pair)}
    names = tuple(sorted(pairs, key=in_order))
    read: Callable[[str], Sample] = lambda name: images.read(name, *pairs[name])  # noqa: E731
    return ToPredict(names, read, frozenset(folders), alone)


def _pairs(folder: Path, layout: PairPattern) -> dict[str, tuple[Path, Path]]:
    """Name -> RGB and expected thermal image, of one layout."""
    rgb, thermal = Pattern(layout.rgb, "input"), Pattern(layout.thermal, "input")
    found = rgb.files(folder)
    # If all are in one folder, "{name}.png" matches 7.png and 7_ir.png, which is "{name}_ir.png".
    partners = {thermal.path(folder, v) for _, v in found if rgb.text != thermal.text}
    pairs: dict[str, tuple[Path, Path]] = {}
    for path, values in found:
        name = "_".join(values[word] for word in rgb.words)
        if path in partners:
            continue
        if name in pairs:
            raise InputError(f"input: {pairs[name][0]} and {path} would both be called '{name}'.")
        pairs[name] = (path, thermal.path(folder, values))
    return pairs


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
    rgb, thermal = np.asarray(rgb), np.asarray(thermal)
    if rgb.dtype != np.uint8 or rgb.shape != (*thermal.shape, 3) or thermal.ndim != 2:
        raise InputError(
            "expected rgb uint8 of shape (rows, columns, 3) and thermal of shape (rows, columns), "
            f"got {rgb.dtype} {rgb.shape} and {thermal.dtype} {thermal.shape}."
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
