"""Checks of Freiburg Thermal: missing images, frames in two parts, thermal counts."""

from __future__ import annotations

from typing import Any

from rgbt.data.freiburg_layout import unused_files
from rgbt.data.report.values import DatasetChecks, SplitNames, SplitReport, ThermalStatistics


class FreiburgChecks(DatasetChecks):
    """Overrides what differs from other data sets."""

    dataset: Any  # a Freiburg, whose module imports this one

    @property
    def title(self) -> str:
        """The only layout there is."""
        return "layout of Freiburg Thermal"

    def repeats(self, split: str) -> bool:
        """The split "train" is "train_day", and "test" the day followed by the night."""
        return split in ("train", "test")

    def thermal(self, name: str) -> ThermalStatistics:
        """Of the counts in the crop."""
        return ThermalStatistics.of(self.dataset.counts(name), *self.dataset.thermal_range)

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
            empty, below, above = split.thermal.shares()
            notes.append(
                f"split {split.split}: of the thermal pixels {empty} are 0, which margins are, "
                f"{below} lie below and {above} above dataset.thermal_range=[{low}, {high}]; "
                f"counts other than 0 run from {split.thermal.lowest} to {split.thermal.highest}."
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
