"""The members of every data set, and the base of data sets that wrap another one.

Wrappers are images from a cache, other labels, corrupted images. Parts that must not import
`rgbt.data` use these members too, which is why they are here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rgbt.requirements import Record, record_of
from rgbt.types import Sample, SceneMaps


class LabelledDataset(Protocol):
    """RGB-thermal pairs in named splits, all or some of them labelled.

    See `rgbt.data.mfnet.MFNet` and `rgbt.data.freiburg.Freiburg`.

    Attributes:
        root: its folder.
        name: used in messages and tables.
        num_classes: K; labels are 0 to K - 1, or 255 = ignored.
        classes: names of the K classes.
        palette: their (red, green, blue) colours, 0..255.
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
        ...

    def has(self, split: str) -> bool:
        """Whether any image of `split` exists; InputError if the split is unknown."""
        ...

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, in order; InputError if it is unknown, missing or empty."""
        ...

    def read(self, name: str) -> Sample:
        """One sample; InputError if it cannot be read."""
        ...

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of `read` alone, (H, W); None if the pair is unlabelled."""
        ...

    def files(self, name: str) -> tuple[Path, ...]:
        """Every file that `read` opens for `name`, in a fixed order, whether it exists or not."""
        ...

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files, as JSON values by key."""
        ...

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether each image was taken at night; None if the data set does not state it."""
        ...

    def fingerprint(self) -> str:
        """Hash of names and files; equal copies in different folders have equal fingerprints."""
        ...


@runtime_checkable
class KnownScenes(Protocol):
    """A data set that knows depth and objects of its scenes, such as a generated one."""

    def scene_maps(self, name: str) -> SceneMaps:
        """Maps of the size of the label; InputError if the image has none."""
        ...


class DatasetWrapper:
    """Base class of a data set that changes another one; a subclass overrides what it changes.

    Args:
        source: the wrapped data set.

    Attributes:
        source: the wrapped data set.
    """

    def __init__(self, source: LabelledDataset) -> None:
        self.source = source
        self.root = source.root
        self.name = source.name
        self.num_classes = source.num_classes
        self.classes = source.classes
        self.palette = source.palette
        self.unscored = source.unscored
        self.background = source.background

    @property
    def record(self) -> Record:
        """Record of the source."""
        return record_of(self.source)

    @property
    def splits(self) -> Mapping[str, str]:
        """Splits of the source."""
        return self.source.splits

    def has(self, split: str) -> bool:
        """Whether the source has any image of `split`."""
        return self.source.has(split)

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split of the source."""
        return self.source.names(split)

    def read(self, name: str) -> Sample:
        """One sample of the source."""
        return self.source.read(name)

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of `read` alone."""
        return self.source.label(name)

    def files(self, name: str) -> tuple[Path, ...]:
        """Files of the source."""
        return self.source.files(name)

    def decoding(self) -> dict[str, Any]:
        """Settings of the source that change what `read` returns."""
        return self.source.decoding()

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether each image was taken at night, if the source states it."""
        return self.source.nights(names)

    def fingerprint(self) -> str:
        """Fingerprint of the source."""
        return self.source.fingerprint()


class Subset(DatasetWrapper):
    """A data set of which only some images are read.

    Args:
        source: the wrapped data set.
        chosen: names of the images; every split has these.
    """

    def __init__(self, source: LabelledDataset, chosen: tuple[str, ...]) -> None:
        super().__init__(source)
        self._chosen = chosen

    def names(self, split: str) -> tuple[str, ...]:
        """The chosen names, whatever the split."""
        del split
        return self._chosen


def layers(dataset: LabelledDataset) -> Iterator[LabelledDataset]:
    """`dataset` and every data set behind it; the one that reads files is the last."""
    yield dataset
    while isinstance(dataset, DatasetWrapper):
        dataset = dataset.source
        yield dataset


def background_indices(dataset: LabelledDataset) -> tuple[int, ...]:
    """The class indices of `LabelledDataset.background`."""
    return tuple(dataset.classes.index(name) for name in dataset.background)


def reader_of(dataset: LabelledDataset) -> LabelledDataset:
    """The data set that reads files, behind all wrappers."""
    *_, reader = layers(dataset)
    return reader
