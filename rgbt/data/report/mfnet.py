"""What is checked of a data set in MFNet's layout alone: names, lists, the published numbers."""

from __future__ import annotations

import re
from collections import Counter
from itertools import combinations

from rgbt.data.mfnet import FLIPPED, MFNet, base_name
from rgbt.data.report.values import Lists, SplitReport, Times

OFFICIAL_DAY_NIGHT = {"train": (410, 374), "val": (205, 187), "test": (205, 188)}
"""Day and night images of each split of MFNet (784, 392 and 393 names), mirrored copies apart."""

NAME = re.compile(rf"\d{{5}}[DN]({FLIPPED})?")


class MFNetLayout:
    """See `rgbt.data.report.values.Layout`."""

    def __init__(self, dataset: MFNet) -> None:
        self.dataset = dataset

    @property
    def title(self) -> str:
        """Which of the two layouts it is."""
        return f"{self.dataset.layout} layout"

    def repeats(self, split: str) -> bool:
        """Lists by time of day only repeat names of others, and letters tell the same."""
        return split.endswith(("_day", "_night")) and not self.dataset.has(split)

    def times(self, names: tuple[str, ...]) -> Times:
        """By the letters."""
        letters = Counter(name[-1:] for name in names if not name.endswith(FLIPPED))
        return Times(letters["D"], letters["N"], sum(name.endswith(FLIPPED) for name in names))

    def thermal(self, name: str) -> None:
        """Thermal images come as grey levels."""

    def problems(self, lists: Lists) -> list[str]:
        """Wrong names, names in two splits, files that no list names."""
        return [*_name_problems(lists), *self._overlaps(lists), *self._unlisted(lists)]

    def notes(self, splits: tuple[SplitReport, ...]) -> list[str]:
        """How the numbers differ from the published split, so that no subset is taken for it."""
        if self.dataset.name != "mfnet":
            return []
        notes = []
        for split in splits:
            expected = _official_numbers(split.split)
            found = (split.num_day, split.num_night)
            if expected is not None and found != expected:
                notes.append(
                    f"split {split.split} has {found[0]} day and {found[1]} night images, the "
                    f"official list has {expected[0]} and {expected[1]} ({sum(expected)} in all)."
                )
        return notes

    def _overlaps(self, lists: Lists) -> list[str]:
        """Names in two splits, unless both use one list or one is a part of the other by name."""
        problems = []
        for one, other in combinations(lists, 2):
            words, other_words = set(one.split("_")), set(other.split("_"))
            part = words <= other_words or other_words <= words
            if part or self.dataset.list_path(one) == self.dataset.list_path(other):
                continue
            both = [name for name in lists[one] if name in set(lists[other])]
            if both:
                problems.append(
                    f"splits {one} and {other} share {len(both)} names, the first is '{both[0]}'."
                )
        return problems

    def _unlisted(self, lists: Lists) -> list[str]:
        unlisted = sorted(self.dataset.names_on_disk() - set().union(*lists.values()))
        if not unlisted:
            return []
        return [f"no list names {len(unlisted)} files on disk, the first is '{unlisted[0]}.png'."]


def _name_problems(lists: Lists) -> list[str]:
    problems = []
    for split, names in lists.items():
        for name, count in Counter(names).items():
            if count > 1:
                problems.append(f"split {split} lists '{name}' {count} times.")
            if not NAME.fullmatch(name):
                problems.append(
                    f"split {split}: '{name}' is not five digits and D or N"
                    f" (or that with '{FLIPPED}')."
                )
        problems += _wrong_time_of_day(split, names)
        flipped = [name for name in names if name.endswith(FLIPPED)]
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


def _official_numbers(split: str) -> tuple[int, int] | None:
    base, _, part = split.partition("_")
    day, night = OFFICIAL_DAY_NIGHT.get(base, (0, 0))
    known = {"": (day, night), "day": (day, 0), "night": (0, night)}
    return known.get(part) if base in OFFICIAL_DAY_NIGHT else None
