"""Checks of PST900: the two parts, their recordings, pixels without thermal values."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from rgbt.data.named_files import names_in
from rgbt.data.pst900_layout import FOLDERS, bag_of
from rgbt.data.report.lists import listed_twice, other_sizes, shared
from rgbt.data.report.values import DatasetChecks, SplitNames, SplitReport, ThermalStatistics

NUM_TRAIN = 597
"""Pairs of the training part on disk; the data set's page says 606."""

TEST_BAGS = {21: 40, 22: 59, 23: 28, 24: 72, 25: 89}
"""Recording -> pairs of the test part, 288 in all."""

HW = (720, 1280)


class PST900Checks(DatasetChecks):
    """Overrides what differs from other data sets."""

    dataset: Any  # a PST900, whose module imports this one

    @property
    def title(self) -> str:
        """One of the two layouts."""
        return f"PST900 in {'lists' if self.dataset.has_lists else 'folders'}"

    def repeats(self, split: str) -> bool:
        """The validation split is the test part, unless it has a list or bags of its own."""
        return self._is_test(split) and split != "test"

    def thermal(self, name: str) -> ThermalStatistics:
        """Of grey levels; those of 0 were not measured."""
        return ThermalStatistics.of(self.dataset.thermal(name), 0, 255)

    def problems(self, lists: SplitNames) -> list[str]:
        """Names listed twice or in two parts, files that belong to no image of a split."""
        own = {split: names for split, names in lists.items() if not self.repeats(split)}
        return [*listed_twice(own), *shared(own), *self._unused(own)]

    def notes(self, splits: tuple[SplitReport, ...]) -> list[str]:
        """What "val" is, how the parts differ from the archive's, pixels without thermal."""
        notes = [self._of_val()] if self._is_test("val") else []
        if self.dataset.name == "pst900":
            notes += [*self._other_numbers(splits), *self._other_bags(), *other_sizes(splits, HW)]
        return [*notes, *(note for split in splits for note in self._holes(split))]

    def _is_test(self, split: str) -> bool:
        return bool(self.dataset.part_of(split) == "test")

    def _of_val(self) -> str:
        return (
            "split val is the test part, as in the CRM release: a checkpoint chosen on it is "
            "chosen on what is reported; dataset.val_bags takes recordings out of training instead."
        )

    def _unused(self, lists: SplitNames) -> list[str]:
        """Files that belong to no sample of a split."""
        unused: list[Path] = []
        for folder in self.dataset.folders():
            with_rgb = names_in(folder / FOLDERS[0])
            used = set().union(*lists.values()) if self.dataset.has_lists else set(with_rgb)
            for kind in FOLDERS:
                names = names_in(folder / kind)
                unused += [folder / kind / f"{name}.png" for name in names if name not in used]
        if not unused:
            return []
        return [f"{len(unused)} files belong to no image of a split, the first is {unused[0]}."]

    def _other_numbers(self, splits: tuple[SplitReport, ...]) -> list[str]:
        expected = {"train": NUM_TRAIN, "test": sum(TEST_BAGS.values())}
        if self.dataset.val_bags:
            del expected["train"]
        return [
            f"split {split.split} has {split.num_names} images, the archive has "
            f"{expected[split.split]}."
            for split in splits
            if split.num_names != expected.get(split.split, split.num_names)
        ]

    def _other_bags(self) -> list[str]:
        bags = {part: self._bags(part) for part in ("train", "test")}
        listed = ", ".join(f"{count} of bag {bag}" for bag, count in TEST_BAGS.items())
        notes = []
        tested = sum(bags["train"][bag] for bag in TEST_BAGS)
        if tested:
            part = "is" if tested == bags["train"].total() else "holds"
            notes.append(
                f"split train {part} {tested} images of the bags 21 to 25, which the archive has "
                "for testing: the folders train and test seem to be exchanged, as in the drawing "
                "on the data set's page; exchange them back."
            )
        if bags["test"] and bags["test"] != Counter(TEST_BAGS):
            found = ", ".join(
                f"{count} of {'no bag' if bag is None else f'bag {bag}'}"
                for bag, count in sorted(bags["test"].items(), key=lambda item: item[0] or -1)
            )
            notes.append(f"split test has {found}; the archive has {listed}.")
        return notes

    def _bags(self, split: str) -> Counter[int | None]:
        names = self.dataset.names(split) if self.dataset.has(split) else ()
        return Counter(bag_of(name) for name in names)

    def _holes(self, split: SplitReport) -> list[str]:
        if split.thermal is None or self.repeats(split.split):
            return []
        return [
            f"split {split.split}: {split.thermal.shares()[0]} of the thermal pixels are 0, which "
            f"those without a measurement are; others run from {split.thermal.lowest} to "
            f"{split.thermal.highest}."
        ]
