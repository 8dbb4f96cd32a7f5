"""Checks of a user's own folder: lists, unused files, thermal values."""

from __future__ import annotations

from typing import Any

from rgbt.data.folder.values import plain
from rgbt.data.report.lists import listed_twice, shared
from rgbt.data.report.values import DatasetChecks, SplitNames, SplitReport, ThermalStatistics

MOST_CLIPPED = 0.5
"""Largest share of the thermal values of a split that may be outside `thermal_range`."""


class FolderChecks(DatasetChecks):
    """Overrides what differs from other data sets."""

    dataset: Any  # a Folder, whose module imports this one

    def __init__(self, dataset: Any) -> None:
        super().__init__(dataset)
        self._statistics: dict[str, ThermalStatistics] = {}

    @property
    def title(self) -> str:
        """The patterns of its images."""
        rgb, thermal, _ = self.dataset.patterns
        where = "channel 4" if self.dataset.packed else thermal.text
        return f"RGB {rgb.text}, thermal {where}"

    def thermal(self, name: str) -> ThermalStatistics | None:
        """Of the values of the camera; None if the files hold grey levels."""
        if self.dataset.thermal_range is None:
            return None
        values = self.dataset.values(name)
        self._statistics[name] = ThermalStatistics.of(values, *self.dataset.thermal_range)
        return self._statistics[name]

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
            read = [self._statistics[name] for name in set(names) if name in self._statistics]
            filled = sum(each.pixels - each.empty for each in read)
            outside = sum(each.below + each.above for each in read)
            if self.dataset.thermal_range is not None and outside > MOST_CLIPPED * filled:
                lowest, highest = min(each.lowest for each in read), max(e.highest for e in read)
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
            empty, below, above = split.thermal.shares()
            notes.append(
                f"split {split.split}: of the thermal pixels {empty} are 0, {below} lie below and "
                f"{above} above dataset.thermal_range={plain(limits)}."
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
