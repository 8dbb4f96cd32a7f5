"""Checks of data sets in MFNet's layout: names, lists, the published numbers."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

from rgbt.data.mfnet_layout import MIRRORED, base_name
from rgbt.data.report.lists import other_times, shared
from rgbt.data.report.values import DatasetChecks, DayNight, SplitNames, SplitReport

OFFICIAL_DAY_NIGHT = {"train": (410, 374), "val": (205, 187), "test": (205, 188)}
"""Day and night images of each split of MFNet (784, 392 and 393 names), without mirrored copies."""

OFFICIAL_COUNTS = {
    **OFFICIAL_DAY_NIGHT,
    **{f"{split}_day": (day, 0) for split, (day, _) in OFFICIAL_DAY_NIGHT.items()},
    **{f"{split}_night": (0, night) for split, (_, night) in OFFICIAL_DAY_NIGHT.items()},
}

NAME = re.compile(rf"\d{{5}}[DN]({MIRRORED})?")


class MFNetChecks(DatasetChecks):
    """Overrides what differs from other data sets."""

    dataset: Any  # a MFNet, whose module imports this one

    @property
    def title(self) -> str:
        """One of the two layouts."""
        return f"{self.dataset.layout} layout"

    def repeats(self, split: str) -> bool:
        """Lists by time of day only repeat names of others, and need not exist."""
        return split.endswith(("_day", "_night")) and not self.dataset.has(split)

    def times(self, names: tuple[str, ...]) -> DayNight:
        """By the letters of the names."""
        letters = Counter(name[-1:] for name in names if not name.endswith(MIRRORED))
        return DayNight(letters["D"], letters["N"], sum(name.endswith(MIRRORED) for name in names))

    def problems(self, lists: SplitNames) -> list[str]:
        """Wrong names, names in two splits, files in no list."""
        return [*_name_problems(lists), *shared(lists, self._share_a_list), *self._unlisted(lists)]

    def notes(self, splits: tuple[SplitReport, ...]) -> list[str]:
        """Differences from the numbers of the published split."""
        if self.dataset.name != "mfnet":
            return []
        return other_times(splits, OFFICIAL_COUNTS)

    def _share_a_list(self, one: str, other: str) -> bool:
        return bool(self.dataset.list_path(one) == self.dataset.list_path(other))

    def _unlisted(self, lists: SplitNames) -> list[str]:
        unlisted = sorted(self.dataset.names_on_disk() - set().union(*lists.values()))
        if not unlisted:
            return []
        return [f"no list names {len(unlisted)} files on disk, the first is '{unlisted[0]}.png'."]


def _name_problems(lists: SplitNames) -> list[str]:
    problems = []
    for split, names in lists.items():
        for name, count in Counter(names).items():
            if count > 1:
                problems.append(f"split {split} lists '{name}' {count} times.")
            if not NAME.fullmatch(name):
                problems.append(
                    f"split {split}: '{name}' is not five digits and D or N"
                    f" (or that with '{MIRRORED}')."
                )
        problems += _wrong_time_of_day(split, names)
        flipped = [name for name in names if name.endswith(MIRRORED)]
        if flipped and "train" not in split:
            problems.append(
                f"split {split} lists {len(flipped)} mirrored copies, the first is '{flipped[0]}'; "
                "only training splits may."
            )
    return problems


def _wrong_time_of_day(split: str, names: tuple[str, ...]) -> list[str]:
    wrong_letter = {"day": "N", "night": "D"}.get(split.rpartition("_")[2])
    if wrong_letter is None:
        return []
    wrong = [name for name in names if base_name(name).endswith(wrong_letter)]
    return [f"split {split} lists '{name}', which is a {wrong_letter} image." for name in wrong]
