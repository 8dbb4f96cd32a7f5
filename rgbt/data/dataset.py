"""What the commands ask of any data set."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.types import Sample


class LabelledDataset(Protocol):
    """RGB-thermal pairs in named splits, all or some of them labelled.

    See `rgbt.data.mfnet.MFNet` and `rgbt.data.freiburg.Freiburg`.

    Attributes:
        root: its folder.
        name: what it is called in messages and tables.
        num_classes: K; labels are 0 to K - 1, or 255 = ignored.
        classes: names of the K classes.
        palette: their (red, green, blue) colours, 0..255.
        unscored: classes that are counted but left out of every mean over classes.
    """

    root: Path
    name: str
    num_classes: int
    classes: tuple[str, ...]
    palette: tuple[tuple[int, int, int], ...]
    unscored: tuple[str, ...]

    @property
    def splits(self) -> Mapping[str, str]:
        """Split -> what of the folder it is made of: a list, or a pattern of files."""
        ...

    def has(self, split: str) -> bool:
        """Whether anything of `split` is there; InputError where the split is unknown."""
        ...

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, in order; InputError where it is unknown, missing or empty."""
        ...

    def read(self, name: str) -> Sample:
        """One sample; InputError where it cannot be read."""
        ...

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of `read` alone, (H, W); None where the pair is unlabelled."""
        ...

    def files(self, name: str) -> tuple[Path, ...]:
        """Every file that `read` opens for `name`, in a fixed order, there or not."""
        ...

    def decoding(self) -> dict[str, Any]:
        """What decides, beside the files, what `read` makes of them: values of JSON by key."""
        ...

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether each image was taken at night; None where the data set does not say."""
        ...

    def fingerprint(self) -> str:
        """Hash of names and files, equal for equal copies wherever they lie."""
        ...


def check_lengths(
    num_classes: int, classes: tuple[str, ...], palette: tuple[tuple[int, int, int], ...]
) -> None:
    """Refuse names or colours that are not one per class, naming the key."""
    for key, length in (("classes", len(classes)), ("palette", len(palette))):
        if length != num_classes:
            raise InputError(
                f"dataset.num_classes is {num_classes} but dataset.{key} has {length} entries; "
                "make them agree."
            )
