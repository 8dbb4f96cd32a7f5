"""Find the images to predict: a split, a folder of new images, one file, two files or arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rgbt.checks import InputError, nearest
from rgbt.data.images import PairReader, ReadsPairs
from rgbt.data.patterns import FrameFiles, Patterns, what_is_in
from rgbt.dataset import LabelledDataset, reader_of
from rgbt.types import Sample

# Suffixes of image files.
KINDS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")

# Layouts that are read for every data set: folders rgb and thermal, or files of four channels.
PLAIN = (
    *(Patterns.of(f"rgb/{{name}}{kind}", f"thermal/{{name}}{kind}") for kind in KINDS),
    Patterns.of("{name}.png", "{name}.png"),
)


@dataclass(frozen=True)
class ToPredict:
    """Holds images to predict, in order, by name; names of written files begin with theirs.

    `read` returns the images of a name, without a label; `folders` hold the files, which must not
    be overwritten; `skipped`: name -> error, to which `samples` adds.
    """

    names: tuple[str, ...]
    read: Callable[[str], Sample]
    folders: frozenset[Path]
    skipped: dict[str, str] = field(default_factory=dict)

    def samples(self, on_error: Literal["raise", "skip"]) -> Iterator[Sample]:
        """Yield the images in order; InputError for the first unreadable one, or if all are."""
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


def of_split(dataset: LabelledDataset, split: str) -> ToPredict:
    """Return the images of a split; labels are not read if the data set can read pairs alone."""
    names = dataset.names(split)
    reader = reader_of(dataset)
    read = reader.pair if isinstance(reader, ReadsPairs) else reader.read
    folders = {path.parent for name in names for path in dataset.files(name)}
    return ToPredict(names, read, frozenset(folders))


def of_path(dataset: LabelledDataset, text: str, on_error: Literal["raise", "skip"]) -> ToPredict:
    """Return the image of a packed file, or the pairs of a folder.

    A folder is read by the patterns of the data set, or by `PLAIN`: the first of them that matches
    a pair. An RGB image without a thermal image is left out if `on_error` is "skip".

    InputError: no such path, no pair in the folder, two pairs of one name, an RGB image without a
    thermal one.
    """
    folder, images = Path(text), images_of(dataset)
    if folder.is_file():
        return of_files(dataset, folder, folder)
    if not folder.is_dir():
        raise InputError(
            f"input={text}: this is neither a file, nor a folder, nor a split of {dataset.name} "
            f"({nearest(text, dataset.splits)})."
        )
    pairs: dict[str, FrameFiles] = {}
    for layout in (*images.layouts, *PLAIN):
        pairs = layout.frames(folder)
        if any(frame.thermal.is_file() for frame in pairs.values()):
            break
    else:
        wanted = "; ".join(map(str, images.layouts))
        raise InputError(
            f"input={folder} holds no pair of images but {what_is_in(folder)}; expected {wanted}, "
            "or folders rgb and thermal with equal names, or PNG files of four channels. To "
            "predict a single pair, use rgb=FILE thermal=FILE."
        )
    alone = {
        str(frame.rgb): f"{frame.rgb} has no {frame.thermal}."
        for frame in pairs.values()
        if not frame.thermal.exists()
    }
    if alone and on_error == "raise":
        first = next(iter(alone.values()))
        raise InputError(
            f"input={text}: {len(alone)} RGB images have no thermal image: {first} Restore it, or "
            "skip such images with data.on_error=skip."
        )
    pairs = {name: frame for name, frame in pairs.items() if str(frame.rgb) not in alone}
    folders = {folder, *(file.parent for pair in pairs.values() for file in pair[2:4])}
    read: Callable[[str], Sample] = lambda name: images.read(name, *pairs[name][2:4])  # noqa: E731
    return ToPredict(tuple(pairs), read, frozenset(folders), alone)


def of_files(dataset: LabelledDataset, rgb: Path, thermal: Path) -> ToPredict:
    """Return one pair, named after its RGB file; the same file twice is a packed one."""
    images = images_of(dataset)
    for name, path in {"rgb": rgb, "thermal": thermal}.items():
        if not path.is_file():
            raise InputError(f"{name}={path}: there is no such file.")
    return ToPredict(
        (rgb.stem,),
        lambda name: images.read(name, rgb, thermal),
        frozenset({rgb.parent, thermal.parent}),
    )


def of_arrays(dataset: LabelledDataset, rgb: Any, thermal: Any) -> Sample:
    """Return a pair of arrays, rgb (H, W, 3) uint8 and thermal (H, W), without a label.

    Thermal values of 8 bits are grey levels, as in `Sample`. Values of other types are those of the
    camera, and both images are read like files of the data set: cut, and scaled by its
    ``thermal_range``. InputError: other types, shapes or values.
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
    limits = reader.images.limits if isinstance(reader, ReadsPairs) else None
    if limits is not None and limits[0] < 255:
        raise InputError(
            f"thermal: 8 bits may be grey levels or values of dataset.thermal_range={list(limits)};"
            " convert values of the camera to float32, or give the paths of both files."
        )
    return Sample(np.ascontiguousarray(rgb), np.ascontiguousarray(thermal), None, "image")


def images_of(dataset: LabelledDataset) -> PairReader:
    """Return the reader of new images of a data set; InputError if it has none."""
    reader = reader_of(dataset)
    if not isinstance(reader, ReadsPairs):
        raise InputError(
            f"{type(reader).__name__} does not declare how to read new images. Name one of its "
            f"splits ({', '.join(reader.splits)}), or give the class `images` and `pair`."
        )
    return reader.images
