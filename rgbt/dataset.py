"""The members of every data set, and the base of those that wrap another one (cache, labels)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rgbt.types import Sample, SceneMaps


class LabelledDataset(Protocol):
    """RGB-thermal pairs in named splits, all or some of them labelled.

    Attributes:
        root: its folder; `name` is used in messages and tables.
        num_classes: K; labels are 0 to K - 1, or 255 = ignored.
        classes: names of the K classes, and `palette` their (red, green, blue) colours, 0..255.
        unscored: classes that are counted but left out of every mean over classes.
        background: classes that are no object: sample occupancy leaves them out and overlays do not
            paint them; empty: there is none.
    """

    root: Path
    name: str
    num_classes: int
    classes: tuple[str, ...]
    palette: tuple[tuple[int, int, int], ...]
    unscored: tuple[str, ...]
    background: tuple[str, ...]

    @property
    def splits(self) -> Mapping[str, str]:
        """Split -> its list, or the pattern of its files."""

    def has(self, split: str) -> bool:
        """Say whether any image of `split` exists; InputError if the split is unknown."""

    def names(self, split: str) -> tuple[str, ...]:
        """Return the names of a split, in order; InputError if it is unknown, missing or empty."""

    def read(self, name: str) -> Sample:
        """Read one sample; InputError: it cannot be read."""

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """Return the label of `read` alone, (H, W); None if the pair is unlabelled."""

    def files(self, name: str) -> tuple[Path, ...]:
        """Return the files that `read` opens for `name`, in a fixed order, existing or not."""

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files, as JSON values by key."""

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Say whether each image was taken at night; None if the data set does not state it."""

    def fingerprint(self) -> str:
        """Return a hash of names and files; equal copies in other folders have the same."""


@runtime_checkable
class KnownScenes(Protocol):
    """A data set that knows depth and objects of its scenes, such as a generated one."""

    def scene_maps(self, name: str) -> SceneMaps:
        """Return maps of the size of the label; InputError: the image has none."""


class DatasetWrapper:
    """Base of a data set that changes another one, `source`; a subclass overrides what it changes.

    All other members are those of the source.
    """

    if TYPE_CHECKING:  # what `__getattr__` finds
        root: Path
        name: str
        num_classes: int
        classes: tuple[str, ...]
        palette: tuple[tuple[int, int, int], ...]
        unscored: tuple[str, ...]
        background: tuple[str, ...]
        splits: Mapping[str, str]
        has: Callable[[str], bool]
        names: Callable[[str], tuple[str, ...]]
        read: Callable[[str], Sample]
        label: Callable[[str], NDArray[np.uint8] | None]
        files: Callable[[str], tuple[Path, ...]]
        decoding: Callable[[], dict[str, Any]]
        nights: Callable[[tuple[str, ...]], tuple[bool, ...] | None]
        fingerprint: Callable[[], str]

    def __init__(self, source: LabelledDataset) -> None:
        self.source = source

    def __getattr__(self, key: str) -> Any:
        if key == "source" or key.startswith("__"):  # a copy has no attributes yet
            raise AttributeError(key)
        return getattr(self.source, key)


def background_indices(dataset: LabelledDataset) -> tuple[int, ...]:
    """Return the class indices of `LabelledDataset.background`."""
    return tuple(dataset.classes.index(name) for name in dataset.background)


def reader_of(dataset: LabelledDataset) -> LabelledDataset:
    """Return the data set that reads files, behind all wrappers."""
    while isinstance(dataset, DatasetWrapper):
        dataset = dataset.source
    return dataset
