"""Functions shared by the readers of data sets: roots, splits, image sizes, fingerprints.

Nothing here depends on the layout of one data set.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, nearest
from rgbt.data.integrity import is_there, within
from rgbt.types import Sample

Array = NDArray[np.uint8]


def existing_root(root: str, content: str) -> Path:
    """The folder `root`; InputError if there is none, which requests "the one" with `content`."""
    path = Path(root).expanduser()
    if not path.is_dir():
        raise InputError(f"dataset.root: there is no folder '{root}'; give the one {content}.")
    return path


def check_split(split: str, splits: Iterable[str]) -> None:
    """Refuse a split that is not one of `splits`."""
    if split not in splits:
        raise InputError(f"dataset.splits has no split '{split}'; {nearest(split, splits)}.")


def existing_file(what: str, path: Path, name: str, root: Path) -> Path:
    """`path`, one file of the sample `name`; InputError if it is missing or outside `root`."""
    if not is_there(path):
        raise InputError(
            f"'{name}': its {what} {path} is missing; restore it, or use data.on_error=skip to "
            "leave the frame out."
        )
    return within(path, root)


def names_in(folder: Path) -> tuple[str, ...]:
    """Sorted names of the PNG files of a folder, without ending and without those of archivers."""
    return tuple(sorted(path.stem for path in folder.glob("*.png") if path.name[0] != "."))


def pair_of_one_size(name: str, rgb: Array, thermal: Array, path: Path) -> Sample:
    """The sample of RGB (H, W, 3) and thermal (H, W) of `path`; InputError if the sizes differ."""
    check_size(rgb, "thermal", thermal, name, path)
    return Sample(rgb=rgb, thermal=thermal, label=None, name=name)


def with_label(pair: Sample, label: Array | None, path: Path | None) -> Sample:
    """`pair` with its label (H, W), read from `path`; InputError if the sizes differ."""
    if label is not None:
        check_size(pair.rgb, "its label", label, pair.name, path)
    return replace(pair, label=label)


def check_size(rgb: Array, what: str, image: NDArray[Any], name: str, path: Path | None) -> None:
    """Refuse an image (H', W') of `path` that is not of the size of `rgb` (H, W, 3)."""
    if image.shape != rgb.shape[:2]:
        raise InputError(
            f"'{name}': RGB is {rgb.shape[0]}x{rgb.shape[1]} pixels but {what} is "
            f"{image.shape[0]}x{image.shape[1]}; both must show the same pixels, align them "
            f"first: {path}."
        )


def hash_of_files(
    splits: Mapping[str, tuple[str, ...]], files: Callable[[str], Iterable[Path]]
) -> str:
    """SHA-256 in hexadecimal over the names of every split and the sizes of their files.

    Nothing is decoded and folders are left out, so that equal copies have equal fingerprints.

    Args:
        splits: split -> its names; () where the split is not there.
        files: name -> its files; a missing file has size -1.
    """
    sizes: dict[str, list[int]] = {}
    digest = hashlib.sha256()
    for split in sorted(splits):
        digest.update(f"{split} {len(splits[split])}\n".encode())
        for name in splits[split]:
            if name not in sizes:
                sizes[name] = [size_of(path) for path in files(name)]
            digest.update(f"{name} {sizes[name]}\n".encode())
    return digest.hexdigest()


def root_nearby(root: Path, holds: Callable[[Path], bool]) -> Path | None:
    """The folder directly above or below `root` that `holds` a data set; None if there is none."""

    def is_one(folder: Path) -> bool:
        try:
            return holds(folder)
        except OSError:  # no permission
            return False

    return next(filter(is_one, (root.absolute().parent, *sorted(root.iterdir()))), None)


def check_lengths(
    num_classes: int, classes: tuple[str, ...], palette: tuple[tuple[int, int, int], ...]
) -> None:
    """Refuse names or colours that are not one per class."""
    for key, length in (("classes", len(classes)), ("palette", len(palette))):
        if length != num_classes:
            raise InputError(
                f"dataset.num_classes is {num_classes} but dataset.{key} has {length} entries; "
                "make them agree."
            )


def size_of(path: Path) -> int:
    """Bytes of a file, -1 if it is missing."""
    # A path through a file instead of a folder is missing as well.
    try:
        return path.stat().st_size
    except (FileNotFoundError, NotADirectoryError):
        return -1
