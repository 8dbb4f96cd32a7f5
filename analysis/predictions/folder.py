"""Finds the prediction of every image in a folder, and the missing ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rgbt.checks import InputError
from rgbt.data.predictions import OVERLAY, Affixes
from rgbt.dataset import LabelledDataset

Missing = Literal["refuse", "leave_out"]

SHOWN = 3
"""Most names that a message lists."""


@dataclass(frozen=True)
class PredictionFiles:
    """Files of a split.

    Attributes:
        paths: name of the image -> its prediction, in the order of the split.
        missing: names of the split without a file.
        extra: names of PNG files that belong to no image of the split (overlays left out).
    """

    paths: dict[str, Path]
    missing: tuple[str, ...]
    extra: tuple[str, ...]


def find(
    folder: Path, dataset: LabelledDataset, split: str, given: Affixes, missing: Missing
) -> PredictionFiles:
    """The predictions of a split: files prefix + NAME + suffix + ".png".

    Args:
        folder: holds the PNG files.
        dataset: its names are looked up.
        split: of the data set.
        given: prefix and suffix of the names of the files.
        missing: "refuse", or "leave_out" to go on without the images that have no file.

    Raises:
        InputError: no such folder, no PNG in it, no file of this split, files missing, or
            several of an image.
    """
    stems = _stems(folder)
    names = dataset.names(split)
    own = {name: given.file_stem(name) for name in names}
    there = {name: folder / f"{stem}.png" for name, stem in own.items() if stem in stems}
    absent = tuple(name for name in names if name not in there)
    if not there:
        raise InputError(
            f"none of the {len(names)} images of split '{split}' has a file "
            f"{given.file_stem('NAME')}.png in {folder}; it contains "
            f"{listed(sorted(stems), '.png')}{_hint(stems, dataset, given)}."
        )
    if absent and missing == "refuse":
        raise InputError(
            f"{folder} lacks the predictions of {len(absent)} of the {len(names)} images of split "
            f"'{split}' ({listed([own[name] for name in absent], '.png')}); add them, or count the "
            "others alone with missing=leave_out."
        )
    known = {*own.values(), *(f"{name}{OVERLAY}" for name in names)}
    return PredictionFiles(there, absent, tuple(sorted(stems - known)))


def listed(names: Sequence[str], ending: str = "") -> str:
    """The first names of many, for a sentence."""
    shown = ", ".join(f"{name}{ending}" for name in names[:SHOWN])
    return shown if len(names) <= SHOWN else f"{shown} and {len(names) - SHOWN} more"


def _stems(folder: Path) -> set[str]:
    if not folder.is_dir():
        raise InputError(
            f"predictions={folder}: there is no such folder; give the one that holds NAME.png for "
            "every image of the split."
        )
    stems = {path.stem for path in folder.glob("*.png")}
    if not stems:
        others = sorted(path.name for path in folder.iterdir())
        holds = f"it contains {listed(others)}" if others else "it is empty"
        raise InputError(f"predictions={folder}: expected PNG files named NAME.png, but {holds}.")
    return stems


def _hint(stems: set[str], dataset: LabelledDataset, affixes: Affixes) -> str:
    """A hint that the files are those of another split."""
    for split in filter(dataset.has, dataset.splits):
        number = sum(affixes.file_stem(name) in stems for name in dataset.names(split))
        if number:
            return f", {number} of them images of split '{split}': give split={split}"
    return ""
