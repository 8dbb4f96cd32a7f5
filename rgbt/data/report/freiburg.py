"""Checks of Freiburg Thermal: missing images, frames in two parts, thermal counts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rgbt.data.freiburg_layout import unused_files
from rgbt.data.report.values import DayNight, SplitNames, SplitReport, ThermalStatistics

if TYPE_CHECKING:
    from rgbt.data.freiburg import Freiburg


class FreiburgChecks:
    """See `rgbt.data.report.values.DatasetChecks`."""

    def __init__(self, dataset: Freiburg) -> None:
        self.dataset = dataset

    @property
    def title(self) -> str:
        """The only layout there is."""
        return "layout of Freiburg Thermal"

    def repeats(self, split: str) -> bool:
        """The split "train" is "train_day", and "test" the day followed by the night."""
        return split in ("train", "test")

    def times(self, names: tuple[str, ...]) -> DayNight:
        """By the folders."""
        nights = sum(self.dataset.nights(names))
        return DayNight(len(names) - nights, nights)

    def thermal(self, name: str) -> ThermalStatistics:
        """Statistics of the counts in the crop."""
        counts = self.dataset.counts(name)
        low, high = self.dataset.thermal_range
        filled = counts[counts > 0]
        return ThermalStatistics(
            pixels=counts.size,
            empty=counts.size - filled.size,
            below=int(np.count_nonzero(filled < low)),
            above=int(np.count_nonzero(filled > high)),
            lowest=int(filled.min(initial=np.iinfo(np.uint16).max)) if filled.size else 0,
            highest=int(counts.max()),
        )

    def problems(self, lists: SplitNames) -> list[str]:
        """Files without an RGB image, and test frames that training has as well."""
        return [*self._unused(), *self._overlaps(lists)]

    def notes(self, splits: tuple[SplitReport, ...]) -> list[str]:
        """Shares of thermal pixels outside `thermal_range`."""
        low, high = self.dataset.thermal_range
        notes = []
        for split in splits:
            if split.thermal is None or self.repeats(split.split):
                continue
            pixels, empty, below, above, lowest, highest = split.thermal
            notes.append(
                f"split {split.split}: of the thermal pixels {empty / pixels:.2%} are 0, which "
                f"margins are, {below / pixels:.2%} lie below and {above / pixels:.2%} above "
                f"dataset.thermal_range=[{low}, {high}]; counts other than 0 run from {lowest} to "
                f"{highest}."
            )
        return notes

    def _unused(self) -> list[str]:
        unused = unused_files(self.dataset.root, self.dataset.frames)
        if not unused:
            return []
        return [
            f"{len(unused)} thermal images or labels have no RGB image and are in no split, the "
            f"first is {unused[0]}."
        ]

    def _overlaps(self, lists: SplitNames) -> list[str]:
        """Frames in two parts, by their time stamps; names differ between the parts."""
        problems = []
        for test in ("test_day", "test_night"):
            for other in ("train_day", "train_night", "val"):
                trained = {
                    form: name for name in lists.get(other, ()) for form in self._forms(name)
                }
                both = [
                    (name, trained[form])
                    for name in lists.get(test, ())
                    for form in self._forms(name)[:1]
                    if form in trained
                ]
                if both:
                    problems.append(
                        f"splits {test} and {other} share {len(both)} frames by their time stamps, "
                        f"the first is '{both[0][0]}', which is '{both[0][1]}'."
                    )
        return problems

    def _forms(self, name: str) -> tuple[str, ...]:
        """A stamp without and with the number in the burst, as far as it can be left out."""
        stamp = self.dataset.frame(name).stamp
        return (stamp.removesuffix("0"), stamp)
