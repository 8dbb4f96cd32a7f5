"""What a data set in MFNet's layout holds and what is wrong with it, as values.

Reads every listed sample once, in threads. Printing is in `rgbt.data.check`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.mfnet import FLIPPED, MFNet, base_name
from rgbt.types import IGNORE

OFFICIAL_DAY_NIGHT = {"train": (410, 374), "val": (205, 187), "test": (205, 188)}
"""Day and night images of each split of MFNet (784, 392 and 393 names), mirrored copies apart."""

NAME = re.compile(rf"\d{{5}}[DN]({FLIPPED})?")

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class SplitReport:
    """One split.

    Attributes:
        split: its name.
        num_names: lines of the list.
        num_read: names that could be read, each counted once.
        num_day: names of day images; mirrored copies apart.
        num_night: names of night images; mirrored copies apart.
        num_flipped: names of mirrored copies.
        sizes: (height, width) -> number of images.
        pixels: (K + 1,) pixels per class; the last are ignored.
        images: (K + 1,) images in which a class occurs.
    """

    split: str
    num_names: int
    num_read: int
    num_day: int
    num_night: int
    num_flipped: int
    sizes: dict[tuple[int, int], int]
    pixels: Counts
    images: Counts


@dataclass(frozen=True)
class Report:
    """A data set: its splits, what is wrong, what is worth knowing; one sentence each."""

    splits: tuple[SplitReport, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Content:
    """What a readable sample holds."""

    hw: tuple[int, int]
    pixels: Counts


def check_dataset(
    dataset: MFNet,
    *,
    num_threads: int = 4,
    advance: Callable[[], object] = lambda: None,
) -> Report:
    """Read everything that the lists name and compare it with what should be there.

    Args:
        dataset: in MFNet's layout.
        num_threads: files decoded at a time.
        advance: called once for every sample that has been read.

    Returns:
        Report; `problems` is empty where nothing is wrong.
    """
    notes: list[str] = []
    problems: list[str] = []
    lists = _read_lists(dataset, problems, notes)
    contents: dict[str, _Content] = {}
    listed = sorted(set().union(*lists.values()))
    for name, found in zip(listed, _read_all(dataset, listed, num_threads, advance), strict=True):
        if isinstance(found, str):
            problems.append(found)
        else:
            contents[name] = found
    splits = tuple(
        _report_split(split, names, contents, dataset.num_classes) for split, names in lists.items()
    )
    problems += _name_problems(lists) + _overlaps(dataset, lists)
    for lines, more in (
        (problems, _unlisted(dataset, listed)),
        (notes, _size_notes(splits)),
        (notes, _official_notes(splits) if dataset.name == "mfnet" else []),
    ):
        lines += more
    return Report(splits, tuple(problems), tuple(notes))


def num_listed(dataset: MFNet) -> int:
    """Samples that `check_dataset` will read."""
    return len(set().union(*_read_lists(dataset, [], []).values()))


def _read_lists(
    dataset: MFNet, problems: list[str], notes: list[str]
) -> dict[str, tuple[str, ...]]:
    """Names of every split whose list can be read; what is wrong with the others is appended."""
    lists = {}
    for split in dataset.splits:
        try:
            lists[split] = dataset.names(split)
        except InputError as error:
            # Lists by time of day only repeat names of others, and letters tell the same.
            part = split.endswith(("_day", "_night")) and not dataset.list_path(split).exists()
            (notes if part else problems).append(str(error))
    return lists


def _read_all(
    dataset: MFNet, names: list[str], num_threads: int, advance: Callable[[], object]
) -> Iterable[_Content | str]:
    """Content of every name in order, or the sentence that says why it cannot be read."""

    def read(name: str) -> _Content | str:
        try:
            label = dataset.read(name).label
        except InputError as error:
            return str(error)
        finally:
            advance()
        assert label is not None, "this layout always has labels"
        counts = np.bincount(label.ravel(), minlength=IGNORE + 1)
        pixels = np.append(counts[: dataset.num_classes], counts[IGNORE])
        return _Content((label.shape[0], label.shape[1]), pixels)

    with ThreadPoolExecutor(num_threads) as pool:
        yield from pool.map(read, names)


def _report_split(
    split: str, names: tuple[str, ...], contents: dict[str, _Content], num_classes: int
) -> SplitReport:
    read = [contents[name] for name in dict.fromkeys(names) if name in contents]
    letters = Counter(name[-1:] for name in names if not name.endswith(FLIPPED))
    pixels = np.array([content.pixels for content in read]).reshape(-1, num_classes + 1)
    return SplitReport(
        split=split,
        num_names=len(names),
        num_read=len(read),
        num_day=letters["D"],
        num_night=letters["N"],
        num_flipped=sum(name.endswith(FLIPPED) for name in names),
        sizes=dict(Counter(content.hw for content in read)),
        pixels=pixels.sum(0),
        images=(pixels > 0).sum(0),
    )


def _name_problems(lists: dict[str, tuple[str, ...]]) -> list[str]:
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


def _overlaps(dataset: MFNet, lists: dict[str, tuple[str, ...]]) -> list[str]:
    """Names in two splits, unless both use one list or one split is a part of the other by name."""
    problems = []
    for one, other in combinations(lists, 2):
        words, other_words = set(one.split("_")), set(other.split("_"))
        part = words <= other_words or other_words <= words
        if part or dataset.list_path(one) == dataset.list_path(other):
            continue
        both = [name for name in lists[one] if name in set(lists[other])]
        if both:
            problems.append(
                f"splits {one} and {other} share {len(both)} names, the first is '{both[0]}'."
            )
    return problems


def _unlisted(dataset: MFNet, listed: list[str]) -> list[str]:
    unlisted = sorted(dataset.names_on_disk() - set(listed))
    if not unlisted:
        return []
    return [f"no list names {len(unlisted)} files on disk, the first is '{unlisted[0]}.png'."]


def _size_notes(splits: tuple[SplitReport, ...]) -> list[str]:
    sizes = set().union(*(split.sizes for split in splits))
    if len(sizes) < 2:
        return []
    listed = ", ".join(f"{height}x{width}" for height, width in sorted(sizes))
    return [f"images differ in size ({listed}); evaluate with data.eval_batch_size=1."]


def _official_notes(splits: tuple[SplitReport, ...]) -> list[str]:
    """How the numbers differ from the published split, so that a subset is never taken for it."""
    notes = []
    for split in splits:
        expected = _official_numbers(split.split)
        found = (split.num_day, split.num_night)
        if expected is not None and found != expected:
            notes.append(
                f"split {split.split} has {found[0]} day and {found[1]} night images, the official "
                f"list has {expected[0]} and {expected[1]} ({sum(expected)} in all)."
            )
    return notes


def _official_numbers(split: str) -> tuple[int, int] | None:
    base, _, part = split.partition("_")
    day, night = OFFICIAL_DAY_NIGHT.get(base, (0, 0))
    known = {"": (day, night), "day": (day, 0), "night": (0, night)}
    return known.get(part) if base in OFFICIAL_DAY_NIGHT else None
