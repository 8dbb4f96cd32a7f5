"""Checks of a user's own folder: lists, unused files, thermal values."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rgbt.data.folder.values import plain
from rgbt.data.report.lists import listed_twice, shared
from rgbt.data.report.values import DayNight, SplitNames, SplitReport, ThermalStatistics

if TYPE_CHECKING:
    from rgbt.data.folder.dataset import Folder

MOST_CLIPPED = 0.5
"""Largest share of the thermal values of a split that may be outside `thermal_range`."""


class _Clipped(NamedTuple):
    """Of the thermal values of one image that are not 0: how many, how many outside, their ends."""

    filled: int
    outside: int
    lowest: float
    highest: float


class FolderChecks:
    """See `rgbt.data.report.values.DatasetChecks`."""

    def __init__(self, dataset: Folder) -> None:
        self.dataset = dataset
        self._clipped: dict[str, _Clipped] = {}

    @property
    def title(self) -> str:
        """The patterns of its images."""
        rgb, thermal, _ = self.dataset.patterns
        where = "channel 4" if self.dataset.packed else thermal.text
        return f"RGB {rgb.text}, thermal {where}"

    def repeats(self, split: str) -> bool:
        """Parts of a split by time of day need not exist."""
        return split.endswith(("_day", "_night"))

    def times(self, names: tuple[str, ...]) -> DayNight:
        """By `dataset.night`; zeros if it is not given."""
        nights = self.dataset.nights(names)
        return DayNight(0, 0) if nights is None else DayNight(len(names) - sum(nights), sum(nights))

    def thermal(self, name: str) -> ThermalStatistics | None:
        """Statistics of the values of the camera; None if the files hold grey levels."""
        limits = self.dataset.thermal_range
        if limits is None:
            return None
        values = self.dataset.values(name)
        filled = values[values != 0]
        below, above = (
            int(np.count_nonzero(each)) for each in (filled < limits[0], filled > limits[1])
        )
        lowest, highest = (float(end(filled)) if filled.size else 0.0 for end in (np.min, np.max))
        self._clipped[name] = _Clipped(filled.size, below + above, lowest, highest)
        return ThermalStatistics(
            pixels=values.size,
            empty=values.size - filled.size,
            below=below,
            above=above,
            lowest=int(np.floor(lowest)),
            highest=int(np.ceil(highest)),
        )

    def problems(self, lists: SplitNames) -> list[str]:
        """Names listed twice, files without an RGB image, a range that excludes the values."""
        splits = self.dataset.splits
        return [
            *listed_twice(lists),
            *shared(lists, lambda one, other: splits[one] == splits[other]),
            *self._unused(),
            *self._missed(lists),
        ]

    def notes(self, splits: tuple[SplitReport, ...]) -> list[str]:
        """Shares of thermal values outside the range, and frames of no split."""
        return [*self._outside(splits), *self._unlisted()]

    def _unused(self) -> list[str]:
        """Thermal images and labels without an RGB image."""
        dataset = self.dataset
        _, *partners = dataset.patterns
        frames = dataset.frames.values()
        used = {path for frame in frames for path in (frame.rgb, frame.thermal, frame.label)}
        matches = [match for each in partners if each for match in each.files(dataset.root)]
        unused = sorted({match.path for match in matches} - used)
        if not unused:
            return []
        return [
            f"{len(unused)} thermal images or labels have no RGB image (dataset.rgb) and are in no "
            f"split, the first is {unused[0]}."
        ]

    def _missed(self, lists: SplitNames) -> list[str]:
        problems = []
        for split, names in lists.items():
            read = [self._clipped[name] for name in set(names) if name in self._clipped]
            filled = sum(each.filled for each in read)
            outside = sum(each.outside for each in read)
            if self.dataset.thermal_range is not None and outside > MOST_CLIPPED * filled:
                lowest, highest = (
                    min(each.lowest for each in read),
                    max(each.highest for each in read),
                )
                problems.append(
                    f"split {split}: {outside / filled:.2%} of the thermal values other than 0 lie "
                    f"outside dataset.thermal_range={plain(self.dataset.thermal_range)} and become "
                    f"black or white; they run from {lowest:g} to {highest:g}, choose a range "
                    "among them."
                )
        return problems

    def _outside(self, splits: tuple[SplitReport, ...]) -> list[str]:
        limits = self.dataset.thermal_range
        notes = []
        for split in splits:
            if limits is None or split.thermal is None:
                continue
            pixels, empty, below, above, _, _ = split.thermal
            notes.append(
                f"split {split.split}: of the thermal pixels {empty / pixels:.2%} are 0, "
                f"{below / pixels:.2%} lie below and {above / pixels:.2%} above "
                f"dataset.thermal_range={plain(limits)}."
            )
        return notes

    def _unlisted(self) -> list[str]:
        dataset = self.dataset
        listed = {
            name for split in dataset.splits if dataset.has(split) for name in dataset.names(split)
        }
        unlisted = [name for name in dataset.frames if name not in listed]
        if not unlisted:
            return []
        return [f"{len(unlisted)} frames are in no split, the first is '{unlisted[0]}'."]
