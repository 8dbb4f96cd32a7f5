"""Checks of lists of names, of numbers of days and nights, and of image sizes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from itertools import combinations

from rgbt.data.report.values import SplitNames, SplitReport


def listed_twice(lists: SplitNames) -> list[str]:
    """Names that one split lists several times."""
    return [
        f"split {split} lists '{name}' {count} times."
        for split, names in lists.items()
        for name, count in Counter(names).items()
        if count > 1
    ]


def shared(
    lists: SplitNames, may_share: Callable[[str, str], bool] = lambda *_: False
) -> list[str]:
    """Names in two splits, unless one is a part of the other by name or `may_share` says so."""
    problems = []
    for one, other in combinations(lists, 2):
        if is_part(one, other) or may_share(one, other):
            continue
        in_other = set(lists[other])
        both = [name for name in lists[one] if name in in_other]
        if both:
            problems.append(
                f"splits {one} and {other} share {len(both)} names, the first is '{both[0]}'."
            )
    return problems


def is_part(one: str, other: str) -> bool:
    """Whether one of two splits is a part of the other by name, as "test_day" is of "test"."""
    words, other_words = set(one.split("_")), set(other.split("_"))
    return words <= other_words or other_words <= words


def other_times(
    splits: tuple[SplitReport, ...], official: Mapping[str, tuple[int, int]]
) -> list[str]:
    """Differences from the official numbers, split -> (day, night), of the splits in `official`."""
    notes = []
    for split in splits:
        counts = (split.num_day, split.num_night)
        expected = official.get(split.split, counts)
        if counts != expected:
            notes.append(
                f"split {split.split} has {counts[0]} day and {counts[1]} night images, the "
                f"official list has {expected[0]} and {expected[1]} ({sum(expected)} in all)."
            )
    return notes


def other_sizes(splits: tuple[SplitReport, ...], official: tuple[int, int]) -> list[str]:
    """Image sizes other than the official (height, width)."""
    others = sorted({size for split in splits for size in split.sizes} - {official})
    if not others:
        return []
    listed = ", ".join(f"{height}x{width}" for height, width in others)
    return [
        f"images are {listed}, the original ones {official[0]}x{official[1]}: scores of resized "
        "images are not comparable with those of original ones."
    ]
