"""What a check of a data set finds, as values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Counts = NDArray[np.int64]


class Times(NamedTuple):
    """Names of a split by time of day; mirrored copies are counted apart."""

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
        num_day: names of day images; mirrored copies apart.
        num_night: names of night images; mirrored copies apart.
        num_flipped: names of mirrored copies.
        sizes: (height, width) -> number of images.
        pixels: (K + 1,) pixels per class; the last are ignored.
        images: (K + 1,) images in which a class occurs.
        thermal: what was counted of thermal images before they became grey; None where they come
            as grey levels.
    """

    split: str
    num_names: int
    num_read: int
    num_unlabelled: int
    num_day: int
    num_night: int
    num_flipped: int
    sizes: dict[tuple[int, int], int]
    pixels: Counts
    images: Counts
    thermal: Thermal | None


class Thermal(NamedTuple):
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
class Report:
    """A data set: its splits, what is wrong, what is worth knowing; one sentence each."""

    splits: tuple[SplitReport, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...]


Lists = dict[str, tuple[str, ...]]
"""Split -> names, of the splits that could be listed."""


class Layout(Protocol):
    """What is to be known about a data set beside what every data set has."""

    @property
    def title(self) -> str:
        """The layout, for a headline."""
        ...

    def repeats(self, split: str) -> bool:
        """Whether a split that cannot be listed only repeats what other splits hold."""
        ...

    def times(self, names: tuple[str, ...]) -> Times:
        """How many names are of the day and of the night."""
        ...

    def thermal(self, name: str) -> Thermal | None:
        """Counts of one thermal image; InputError as where it is read."""
        ...

    def problems(self, lists: Lists) -> list[str]:
        """What is wrong with names and files, without opening any."""
        ...

    def notes(self, splits: tuple[SplitReport, ...]) -> list[str]:
        """What is worth knowing about what was read."""
        ...
