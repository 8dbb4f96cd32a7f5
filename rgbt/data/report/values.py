"""The report of a data set, and the checks that a data set declares for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

PixelCounts = NDArray[np.int64]


class DayNight(NamedTuple):
    """Images of a split by time of day; mirrored copies are counted separately."""

    day: int
    night: int
    mirrored: int = 0


@dataclass(frozen=True)
class SplitReport:
    """One split.

    Attributes:
        split: its name.
        num_names: lines of the list, or frames of the folders.
        num_read: names that could be read, each counted once.
        num_unlabelled: of these, those without a label.
        num_day: names of day images without mirrored copies.
        num_night: names of night images without mirrored copies.
        num_flipped: names of mirrored copies.
        sizes: (height, width) -> number of images.
        pixels: (K + 1,) pixels per class; the last are ignored.
        images: (K + 1,) images in which a class occurs.
        thermal: statistics of the thermal images before conversion to grey levels; None if the
            files hold grey levels.
    """

    split: str
    num_names: int
    num_read: int
    num_unlabelled: int
    num_day: int
    num_night: int
    num_flipped: int
    sizes: dict[tuple[int, int], int]
    pixels: PixelCounts
    images: PixelCounts
    thermal: ThermalStatistics | None


class ThermalStatistics(NamedTuple):
    """Pixels of thermal images by their counts.

    Attributes:
        pixels: all.
        empty: of these, those of count 0, which margins have.
        below: others below the range that is read.
        above: above it.
        lowest: smallest count that is not 0; 0 where there is none.
        highest: largest count.
    """

    pixels: int
    empty: int
    below: int
    above: int
    lowest: int
    highest: int


@dataclass(frozen=True)
class DatasetReport:
    """A data set: its splits, and one sentence for each problem and each note."""

    splits: tuple[SplitReport, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...]


SplitNames = dict[str, tuple[str, ...]]
"""Split -> names, of the splits whose names could be read."""


class DatasetChecks(Protocol):
    """The checks of one data set, in addition to those of every data set."""

    @property
    def title(self) -> str:
        """The layout, for a headline."""
        ...

    def repeats(self, split: str) -> bool:
        """Whether a split only repeats images of other splits, and need not exist."""
        ...

    def times(self, names: tuple[str, ...]) -> DayNight:
        """Number of day and of night images."""
        ...

    def thermal(self, name: str) -> ThermalStatistics | None:
        """Counts of one thermal image, or None; InputError if it cannot be read."""
        ...

    def problems(self, lists: SplitNames) -> list[str]:
        """Problems of names and files; no file is opened."""
        ...

    def notes(self, splits: tuple[SplitReport, ...]) -> list[str]:
        """Remarks about the samples that were read."""
        ...


@runtime_checkable
class Checkable(Protocol):
    """A data set that declares its checks."""

    def checks(self) -> DatasetChecks:
        """The checks of this data set."""
        ...
