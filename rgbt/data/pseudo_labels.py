"""Read labels that a trained network predicted, instead of those of a data set.

A folder of them (written by `rgbt.evaluation.images`) holds:

    labels/NAME.png       8 bit, class ids of the data set, 255 below the confidence threshold
    confidence/NAME.png   16 bit, 65535 times the probability of the predicted class
    pseudo_labels.json    teacher and settings; written last, so a folder with it is complete
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import (
    Any,
    Required,  # pydantic takes no other before Python 3.12
)

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

from rgbt.checks import InputError
from rgbt.data.files import decode
from rgbt.data.labels import indices
from rgbt.dataset import DatasetWrapper, LabelledDataset
from rgbt.files.plain_files import read_json
from rgbt.types import Sample

FORMAT = "rgbt pseudo-labels 1"
MANIFEST = "pseudo_labels.json"
# Value of the confidence 1 in a file.
FULL = 65535


class Manifest(TypedDict, total=False):
    """Describes the content of ``pseudo_labels.json``."""

    format: Required[str]
    teacher: str  # a run's key, or a file
    weights: str  # SHA-256 of the teacher's parameters
    view: str | None
    head: str | None
    label_map: dict[str, Any] | None  # num_source, targets, groups; None: none
    threshold: float
    dataset: str
    fingerprint: str  # fingerprint of the data set
    split: str
    classes: Required[list[str]]  # their names, in order of their ids
    images: int  # how many
    skipped: list[str]  # unreadable ones
    kept: float  # share of pixels with a label
    mean_confidence: float  # mean over all pixels
    by_class: dict[str, dict[str, float | None]]  # share of pixels, mean_confidence of those
    digest: Required[str]  # SHA-256 over names, labels and confidences


class PseudoLabels:
    """Reads a complete folder of pseudo-labels; InputError if there is none, or an incomplete one.

    `manifest` is a `Manifest`.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        path = self.folder / MANIFEST
        if not path.is_file():
            state = "is not complete" if self.folder.is_dir() else "does not exist"
            raise InputError(
                f"the folder of pseudo-labels {self.folder} {state}: expected {MANIFEST} in it. "
                f"Write it with rgbt predict ... out={self.folder} pseudo_labels=true."
            )
        self.manifest: dict[str, Any] = read_json(path, Manifest, "remove it and predict again")
        if self.manifest["format"] != FORMAT:
            raise InputError(
                f"{path}: expected the format '{FORMAT}', got '{self.manifest['format']}'; "
                "choose another folder."
            )
        self.classes: tuple[str, ...] = tuple(self.manifest["classes"])
        self.digest: str = self.manifest["digest"]

    def missing(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return those of the names that have no pseudo-label here."""
        return tuple(name for name in names if not label_path(self.folder, name).is_file())

    def read(self, name: str) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Read label (H, W) uint8, 255 = no label, and confidence (H, W) from 0 to 1.

        InputError: a file is missing, cannot be decoded, or holds something else.
        """
        if self.missing([name]):
            raise InputError(
                f"'{name}' has no pseudo-label in {self.folder}; predict the split that it belongs "
                "to."
            )
        label = indices(len(self.classes)).read(label_path(self.folder, name))
        path = confidence_path(self.folder, name)
        confidence = decode(path)
        if confidence.dtype != np.uint16 or confidence.shape != label.shape:
            raise InputError(
                f"{path}: expected 16 bits of shape {label.shape}, as the label has, got "
                f"{confidence.dtype} of shape {confidence.shape}."
            )
        return label, (confidence / np.float32(FULL)).astype(np.float32)


def label_path(folder: Path, name: str) -> Path:
    """Return the file of the label of `name`."""
    return folder / "labels" / f"{name}.png"


def confidence_path(folder: Path, name: str) -> Path:
    """Return the file of the confidence of `name`."""
    return folder / "confidence" / f"{name}.png"


class PseudoLabelled(DatasetWrapper):
    """Replaces labels of a data set by pseudo-labels of a folder, perhaps with confidences.

    InputError: the folder is not complete, or its classes differ from those of the data set.
    """

    def __init__(
        self, dataset: LabelledDataset, folder: str | Path, *, with_confidence: bool
    ) -> None:
        super().__init__(dataset)
        self.labels = PseudoLabels(folder)
        self.with_confidence = with_confidence
        if self.labels.classes != tuple(self.classes):
            raise InputError(
                f"the pseudo-labels of {self.labels.folder} have the classes "
                f"{', '.join(self.labels.classes)}, but {self.name} has {', '.join(self.classes)}; "
                "predict them for this data set (label_map=... for a teacher of other classes)."
            )

    def read(self, name: str) -> Sample:
        """Read the sample with its pseudo-label; InputError for none, or one of another size."""
        sample = self.source.read(name)
        label, confidence = self.labels.read(name)
        if label.shape != sample.thermal.shape:
            raise InputError(
                f"'{name}' has {sample.thermal.shape} pixels but its pseudo-label in "
                f"{self.labels.folder} {label.shape}; predict them for the data set as it is now."
            )
        return replace(sample, label=label, confidence=confidence if self.with_confidence else None)

    def label(self, name: str) -> NDArray[np.uint8]:
        """Read the pseudo-label alone."""
        return self.labels.read(name)[0]


class Unlabelled(DatasetWrapper):
    """Reads a data set without its labels."""

    def read(self, name: str) -> Sample:
        """Read the sample without label and confidence."""
        return replace(self.source.read(name), label=None, confidence=None)

    def label(self, name: str) -> None:
        """Return None: there are no labels."""
