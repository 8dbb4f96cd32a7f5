"""Functions shared by the readers of data sets: roots, files of a sample, sizes, fingerprints.

Nothing here depends on the layout of one data set.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.integrity import is_there, within

Array = NDArray[np.uint8]


def existing_root(root: str, content: str) -> Path:
    """The folder `root`; InputError if there is none, which requests "the one" with `content`."""
    path = Path(root).expanduser()
    if not path.is_dir():
        raise InputError(
            f"dataset.root: the folder '{root}' does not exist; give the folder {content}."
        )
    return path


def existing_file(what: str, path: Path, name: str, root: Path) -> Path:
    """`path`, one file of the sample `name`; InputError if it is missing or outside `root`."""
    if not is_there(path):
        advice = "restore it, or skip unreadable frames with data.on_error=skip"
        if name.endswith("_flip"):
            advice = "the list names a mirrored copy: write it, or use a list without such names"
        raise InputError(f"'{name}': its {what} {path} is missing; {advice}.")
    return within(path, root)


def names_in(folder: Path) -> tuple[str, ...]:
    """Sorted names of the PNG files of a folder, without ending and without those of archivers."""
    return tuple(sorted(path.stem for path in folder.glob("*.png") if path.name[0] != "."))


def check_size(rgb: Array, what: str, image: NDArray[Any], name: str, path: Path | None) -> None:
    """Refuse an image (H', W') of `path` that is not of the size of `rgb` (H, W, 3)."""
    if image.shape != rgb.shape[:2]:
        raise InputError(
            f"'{name}': RGB is {rgb.shape[0]}x{rgb.shape[1]} pixels but {what} is "
            f"{image.shape[0]}x{image.shape[1]}; both must show the same pixels. Align them "
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


def size_of(path: Path) -> int:
    """Bytes of a file, -1 if it is missing."""
    # A path through a file instead of a folder is missing as well.
    try:
        return path.stat().st_size
    except (FileNotFoundError, NotADirectoryError):
        return -1
