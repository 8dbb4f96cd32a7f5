"""Checks of KP: source of its splits, days and nights, published numbers."""

from __future__ import annotations

from typing import Any

from rgbt.data.kp_layout import NAME, TIMES, is_night, set_of
from rgbt.data.report.lists import listed_twice, other_sizes, other_times, shared
from rgbt.data.report.values import DatasetChecks, SplitNames, SplitReport

OFFICIAL_DAY_NIGHT = {"train": (261, 238), "val": (64, 76), "test": (178, 133)}
"""Day and night images of each split of the CRM release: 499, 140 and 311."""

HW = (512, 640)


class KPChecks(DatasetChecks):
    """Overrides what differs from other data sets."""

    dataset: Any  # a KP, whose module imports this one

    @property
    def title(self) -> str:
        """The layout of images and labels, and the source of the splits."""
        images = "the CRM release" if self.dataset.has_images else "MS-UDA"
        origin = "list files" if self.dataset.lists == "files" else "set numbers"
        return f"KP in the layout of {images}, splits from {origin}"

    def problems(self, lists: SplitNames) -> list[str]:
        """Names listed twice, in two splits or at the wrong time; labels that are in no split."""
        return [
            *listed_twice(lists),
            *shared(lists, self._share_a_list),
            *_wrong_times(lists),
            *_lists_that_disagree(lists),
            *self._unlisted(lists),
        ]

    def notes(self, splits: tuple[SplitReport, ...]) -> list[str]:
        """The source of the splits, and differences from the published split."""
        notes = [self._division()]
        if self.dataset.name != "kp":
            return notes
        if self._is_ms_uda(splits):
            notes.append(
                "the training split has only days and the validation split only nights, as in "
                "MS-UDA: scores are not comparable with those of CRM, which trains on both; "
                "dataset.lists=sets divides as CRM does."
            )
        return [*notes, *other_times(splits, OFFICIAL_DAY_NIGHT), *other_sizes(splits, HW)]

    def _division(self) -> str:
        if self.dataset.lists == "sets":
            return (
                "no list is read: all labels on disk are divided into splits by set numbers, as in "
                "the CRM release."
            )
        files = [path for split in self.dataset.splits for path in self.dataset.list_files(split)]
        return f"splits are read from the lists {', '.join(dict.fromkeys(files)) or '(none)'}."

    def _share_a_list(self, one: str, other: str) -> bool:
        """Whether the configuration reads both from one file, for example without a test list."""
        return not set(self.dataset.list_files(one)).isdisjoint(self.dataset.list_files(other))

    def _is_ms_uda(self, splits: tuple[SplitReport, ...]) -> bool:
        """Whether training is by day, with sets that CRM tests on, and validation at night."""
        of = {split.split: split for split in splits}
        if not {"train", "val"} <= set(of):
            return False
        train, val = of["train"], of["val"]
        is_divided = train.num_night == val.num_day == 0 and train.num_day and val.num_night
        sets = {set_of(name) for name in self.dataset.names("train")} if is_divided else set()
        return not sets.isdisjoint({6, 7, 8})

    def _unlisted(self, lists: SplitNames) -> list[str]:
        listed = set().union(*lists.values())
        unlisted = [name for name in self.dataset.labels_on_disk if name not in listed]
        strange = [name for name in unlisted if NAME.fullmatch(name) is None]
        problems = []
        if strange:
            problems.append(
                f"{len(strange)} labels have names without a set, the first is '{strange[0]}.png'."
            )
        if len(unlisted) > len(strange):
            first = next(name for name in unlisted if name not in set(strange))
            problems.append(
                f"no split names {len(unlisted) - len(strange)} labels on disk, the first is "
                f"'{first}.png'."
            )
        return problems


def _wrong_times(lists: SplitNames) -> list[str]:
    problems = []
    for split, names in lists.items():
        time = split.rpartition("_")[2]
        wrong = [name for name in names if time in TIMES and is_night(name) != (time == "night")]
        problems += [
            f"split {split} lists '{name}', which was recorded "
            f"{'at night' if is_night(name) else 'by day'} (set{set_of(name):02d})."
            for name in wrong
        ]
    return problems


def _lists_that_disagree(lists: SplitNames) -> list[str]:
    """Problems of splits that are not the union of their day and their night."""
    problems = []
    for split, names in lists.items():
        parts = [f"{split}_{time}" for time in TIMES]
        if not all(part in lists for part in parts):
            continue
        differ = sorted(set(names) ^ {name for part in parts for name in lists[part]})
        if differ:
            problems.append(
                f"split {split} is not {parts[0]} and {parts[1]} together: {len(differ)} names are "
                f"in one of them alone, the first is '{differ[0]}'."
            )
    return problems
