"""The command ``rgbt check``, which reads a whole data set and reports its problems.

    rgbt check dataset=mfnet dataset.root=...

Every listed sample is read once, in threads. Progress goes to stderr, the report to stdout. Exit
code 0: no problem, 1: problems, 2: wrong input.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import Progress

from rgbt.checks import InputError
from rgbt.config.command import command
from rgbt.config.component import build
from rgbt.data.file_dataset import FileDataset
from rgbt.data.labels import PixelCounts, label_pixels
from rgbt.tables import TextTable
from rgbt.terminal import plain_text, print_rich, rich_table

Names = tuple[str, ...]


@dataclass(frozen=True)
class SplitReport:
    """One split.

    Attributes:
        names: lines of the list, or frames of the folders.
        read: names that could be read, each counted once.
        unlabelled: of these, those without a label.
        day: names of day images without mirrored copies.
        night: names of night images without mirrored copies.
        mirrored: names of mirrored copies.
        sizes: (height, width) -> number of images.
        pixels: (K + 1,) pixels per class; the last are ignored.
        images: (K + 1,) images in which a class occurs.
    """

    names: int
    read: int
    unlabelled: int
    day: int
    night: int
    mirrored: int
    sizes: dict[tuple[int, ...], int]
    pixels: PixelCounts
    images: PixelCounts


@dataclass(frozen=True)
class DatasetReport:
    """A data set: its splits by name, and one sentence for each problem and each note."""

    splits: dict[str, SplitReport]
    problems: tuple[str, ...]
    notes: tuple[str, ...]


@command()
def main(config: DictConfig, _overrides: list[str]) -> int:
    """Check ``config.dataset``; returns 1 if there are problems."""
    dataset = build(config.dataset)
    if not isinstance(dataset, FileDataset):
        raise InputError(
            f"dataset: {type(dataset).__name__} cannot be checked, because it is not a "
            "rgbt.data.file_dataset.FileDataset."
        )
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("reading", total=None)

        def advance(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        report = check_dataset(dataset, num_threads=os.cpu_count() or 1, advance=advance)
    print_rich(plain_text(f"{dataset.name} ({dataset.title}): {dataset.root}"))
    for table in tables(dataset, report):
        print_rich(rich_table(table))
    for kind, lines in (("note", report.notes), ("problem", report.problems)):
        for line in lines:
            print_rich(plain_text(f"{kind}: {line}"))
    problems, notes = len(report.problems), len(report.notes)
    print_rich(plain_text(f"{problems} problem(s), {notes} note(s)."))
    return 1 if report.problems else 0


def tables(dataset: FileDataset, report: DatasetReport) -> tuple[TextTable, TextTable]:
    """Numbers of names and sizes by split; percent of pixels and number of images by class."""
    rows = [
        (
            *(split, *map(str, (r.names, r.read, r.day, r.night, r.mirrored, r.unlabelled))),
            ", ".join(f"{h}x{w} ({number})" for (h, w), number in sorted(r.sizes.items())),
        )
        for split, r in report.splits.items()
    ]
    header = ("split", "names", "read", "day", "night", "mirrored", "unlabelled", "sizes")
    own = {
        split: r
        for split, r in report.splits.items()
        if r.pixels.any() and not dataset.repeats(split)
    }
    shares = [
        (name, *(f"{r.pixels[i] / r.pixels.sum():.3%} ({r.images[i]})" for r in own.values()))
        for i, name in enumerate((*dataset.classes, "ignored"))
    ]
    columns = ("class", *(f"{split} pixels (images)" for split in own))
    return TextTable("", header, tuple(rows)), TextTable("", columns, tuple(shares))


def check_dataset(
    dataset: FileDataset,
    *,
    num_threads: int = 4,
    advance: Callable[[int, int], object] = lambda *_: None,
) -> DatasetReport:
    """Read every sample of the splits and report problems.

    Args:
        dataset: reads files.
        num_threads: files decoded at a time.
        advance: called with the number of samples that have been read, and that of all.
    """
    lists: dict[str, Names] = {}
    problems: list[str] = []
    notes: list[str] = []
    for split in dataset.splits:
        try:
            lists[split] = dataset.names(split)
        except InputError as error:
            (notes if dataset.repeats(split) else problems).append(str(error))

    def read(name: str) -> tuple[tuple[int, ...], PixelCounts | None] | str:
        try:
            sample = dataset.read(name)
        except InputError as error:
            return str(error)
        label = sample.label
        pixels = None if label is None else label_pixels(label, dataset.num_classes)
        return sample.thermal.shape, pixels

    listed = sorted(set().union(*lists.values()))
    contents = {}
    with ThreadPoolExecutor(num_threads) as pool:
        for done, (name, found) in enumerate(zip(listed, pool.map(read, listed), strict=True), 1):
            advance(done, len(listed))
            if isinstance(found, str):
                problems.append(found)
            else:
                contents[name] = found
    splits = {}
    for split, names in lists.items():
        own = [contents[name] for name in dict.fromkeys(names) if name in contents]
        labelled = [pixels for _, pixels in own if pixels is not None]
        counts = np.array(labelled, np.int64).reshape(-1, dataset.num_classes + 1)
        times = Counter(_time_of(dataset, name) for name in names if not _mirrored(dataset, name))
        splits[split] = SplitReport(
            names=len(names),
            read=len(own),
            unlabelled=len(own) - len(labelled),
            day=times["day"],
            night=times["night"],
            mirrored=sum(_mirrored(dataset, name) for name in names),
            sizes=dict(Counter(hw for hw, _ in own)),
            pixels=counts.sum(0),
            images=(counts > 0).sum(0),
        )
    problems += _list_problems(dataset, lists)
    unused = sorted(dataset.unused(lists))
    if unused:
        problems.append(
            f"{len(unused)} files belong to no image of a split; the first is {unused[0]}."
        )
    problems += dataset.own_problems(lists)
    sizes = sorted(set().union(*(each.sizes for each in splits.values())))
    if len(sizes) > 1:
        texts = ", ".join(f"{height}x{width}" for height, width in sizes)
        notes.append(f"images differ in size ({texts}); evaluate with data.eval_batch_size=1.")
    notes += [*dataset.own_notes(lists), *_uneven(dataset, splits)]
    return DatasetReport(splits, tuple(problems), tuple(notes))


def _mirrored(dataset: FileDataset, name: str) -> bool:
    return dataset.mirrored is not None and name.endswith(dataset.mirrored)


def _time_of(dataset: FileDataset, name: str) -> str:
    """Either "day" or "night", or "" if that is unknown."""
    try:
        nights = dataset.nights((name,))
    except InputError:  # reading it reports the problem
        nights = None
    return "" if nights is None else "night" if nights[0] else "day"


def _uneven(dataset: FileDataset, splits: dict[str, SplitReport]) -> list[str]:
    """What a split lacks that another split has: images by day or at night, or a class."""
    whole = {split: r for split, r in splits.items() if not split.endswith(("_day", "_night"))}
    notes = []
    for split, r in whole.items():
        others = [other for name, other in whole.items() if name != split]
        times = [
            f"{time} images"
            for time, own in (("day", r.day), ("night", r.night))
            if not own and any(getattr(other, time) for other in others)
        ]
        labelled = r.unlabelled < r.read
        classes = [
            f"'{name}'"
            for index, name in enumerate(dataset.classes)
            if labelled and not r.pixels[index] and any(other.pixels[index] for other in others)
        ]
        if times or classes:
            notes.append(
                f"split {split} has no {', '.join([*times, *classes])}, which other splits have; "
                "a score of it says nothing about them."
            )
    return notes


def _list_problems(dataset: FileDataset, lists: dict[str, Names]) -> list[str]:
    """Names listed twice, of another time of day, mirrored for testing, or in two splits.

    Two splits may share names if one is a part of the other by name, as "test_day" is of "test",
    or if both are made of one source; of such splits the last is checked.
    """
    problems = []
    of_source = {dataset.splits[split]: split for split in lists}
    lists = {split: lists[split] for split in of_source.values()}
    for split, names in lists.items():
        problems += [
            f"split {split} lists '{name}' {count} times."
            for name, count in Counter(names).items()
            if count > 1
        ]
        other = {"day": "night", "night": "day"}.get(split.rpartition("_")[2])
        problems += [
            f"split {split} lists '{name}', which is a {other} image."
            for name in dict.fromkeys(names)
            if other and _time_of(dataset, name) == other
        ]
        flipped = [name for name in names if _mirrored(dataset, name)]
        if flipped and "train" not in split:
            problems.append(f"split {split} lists {len(flipped)} mirrored copies: '{flipped[0]}'.")
    for one, other in combinations(lists, 2):
        words, other_words = set(one.split("_")), set(other.split("_"))
        is_part = words <= other_words or other_words <= words
        both = sorted(set(lists[one]) & set(lists[other]))
        if both and not is_part and set(dataset.sources(one)).isdisjoint(dataset.sources(other)):
            problems.append(
                f"splits {one} and {other} share {len(both)} names; the first is '{both[0]}'."
            )
    return problems


if __name__ == "__main__":
    main()
