"""The report of a data set, and the checks that a data set declares for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rgbt.dataset import LabelledDataset

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
    """Pixels of thermal images by their values.

    Attributes:
        pixels: all.
        empty: of these, those of value 0, which margins have.
        below: others below the range that is read.
        above: above it.
        lowest: smallest value that is not 0; 0 where there is none.
        highest: largest of them.
    """

    pixels: int
    empty: int
    below: int
    above: int
    lowest: float
    highest: float

    @classmethod
    def of(cls, values: NDArray[Any], low: float, high: float) -> ThermalStatistics:
        """Those of one image (H, W), read from `low` to `high`."""
        filled = values[values != 0]
        return cls(
            pixels=values.size,
            empty=values.size - filled.size,
            below=int(np.count_nonzero(filled < low)),
            above=int(np.count_nonzero(filled > high)),
            lowest=filled.min().item() if filled.size else 0,
            highest=filled.max().item() if filled.size else 0,
        )

    def shares(self) -> tuple[str, str, str]:
        """Shares of `empty`, `below` and `above` in all pixels, for a message."""
        empty, below, above = (f"{each / self.pixels:.2%}" for each in self[1:4])
        return empty, below, above


@dataclass(frozen=True)
class DatasetReport:
    """A data set: its splits, and one sentence for each problem and each note."""

    splits: tuple[SplitReport, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...]


SplitNames = dict[str, tuple[str, ...]]
"""Split -> names, of the splits whose names could be read."""


class DatasetChecks:
    """The checks of one data set, in addition to those of every data set; subclasses override them.

    Args:
        dataset: is checked.
    """

    def __init__(self, dataset: LabelledDataset) -> None:
        self.dataset = dataset

    @property
    def title(self) -> str:
        """The layout, for a headline."""
        return type(self.dataset).__name__

    def repeats(self, split: str) -> bool:
        """Whether a split only repeats images of other splits, and need not exist."""
        return split.endswith(("_day", "_night"))

    def times(self, names: tuple[str, ...]) -> DayNight:
        """Number of day and of night images; zeros if the data set does not state it."""
        nights = self.dataset.nights(names)
        return DayNight(0, 0) if nights is None else DayNight(len(names) - sum(nights), sum(nights))

    def thermal(self, name: str) -> ThermalStatistics | None:  # noqa: ARG002 - of subclasses
        """Statistics of one thermal image, or None; InputError if it cannot be read."""
        return None

    def problems(self, lists: SplitNames) -> list[str]:  # noqa: ARG002 - of subclasses
        """Problems of names and files; no file is opened."""
        return []

    def notes(self, splits: tuple[SplitReport, ...]) -> list[str]:  # noqa: ARG002 - of subclasses
        """Remarks about the samples that were read."""
        return []


@runtime_checkable
class Checkable(Protocol):
    """A data set that declares its checks."""

    def checks(self) -> DatasetChecks:
        """The checks of this data set."""
        ...
