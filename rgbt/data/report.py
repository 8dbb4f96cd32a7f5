"""Read a whole data set and report its content and its problems.

Every listed sample is read once, in threads. `rgbt.data.check` prints the report. The numbers of a
published data set, and what only one data set can check, are in its class
(`rgbt.data.file_dataset.FileDataset`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.class_pixels import PixelCounts, label_pixels
from rgbt.data.file_dataset import Expected, FileDataset, SplitNames
from rgbt.data.images import plain


class ThermalStatistics(NamedTuple):
    """Pixels of thermal images by their values.

    Attributes:
        pixels: all.
        empty: of these, those of value 0, which margins have.
        below: others below the range that is read.
        above: above it.
        lowest: smallest value that is not 0; 0 where there is none.
        highest: largest of them.
    """

    pixels: int
    empty: int
    below: int
    above: int
    lowest: float
    highest: float

    @classmethod
    def of(cls, values: NDArray[Any], low: float, high: float) -> ThermalStatistics:
        """Those of one image (H, W), read from `low` to `high`."""
        filled = values[values != 0]
        return cls(
            pixels=values.size,
            empty=values.size - filled.size,
            below=int(np.count_nonzero(filled < low)),
            above=int(np.count_nonzero(filled > high)),
            lowest=filled.min().item() if filled.size else 0,
            highest=filled.max().item() if filled.size else 0,
        )

    @classmethod
    def together(cls, images: list[ThermalStatistics]) -> ThermalStatistics | None:
        """Those of several images; None without any."""
        if not images:
            return None
        pixels, empty, below, above = np.array(images, np.int64)[:, :4].sum(0).tolist()
        lowest = min((image.lowest for image in images if image.lowest), default=0)
        highest = max(image.highest for image in images)
        return cls(pixels, empty, below, above, lowest, highest)


@dataclass(frozen=True)
class SplitReport:
    """One split.

    Attributes:
        split: its name.
        num_names: lines of the list, or frames of the folders.
        num_read: names that could be read, each counted once.
        num_unlabelled: of these, those without a label.
        num_day: names of day images without mirrored copies.
        num_night: names of night images without mirrored copies.
        num_flipped: names of mirrored copies.
        sizes: (height, width) -> number of images.
        pixels: (K + 1,) pixels per class; the last are ignored.
        images: (K + 1,) images in which a class occurs.
        thermal: statistics of the thermal values; None if the data set has no range of them.
    """

    split: str
    num_names: int
    num_read: int
    num_unlabelled: int
    num_day: int
    num_night: int
    num_flipped: int
    sizes: dict[tuple[int, int], int]
    pixels: PixelCounts
    images: PixelCounts
    thermal: ThermalStatistics | None


@dataclass(frozen=True)
class DatasetReport:
    """A data set: its splits, and one sentence for each problem and each note."""

    splits: tuple[SplitReport, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Content:
    """Content of a sample; `pixels` is None without a label."""

    hw: tuple[int, int]
    pixels: PixelCounts | None
    thermal: ThermalStatistics | None


def check_dataset(
    dataset: FileDataset,
    *,
    num_threads: int = 4,
    advance: Callable[[], object] = lambda: None,
) -> DatasetReport:
    """Read every sample of the splits and report problems.

    Args:
        dataset: reads files.
        num_threads: files decoded at a time.
        advance: called once for every sample that has been read.
    """

    def read(name: str) -> _Content | str:
        try:
            return _content(dataset, name)
        except InputError as error:
            return str(error)
        finally:
            advance()

    lists, problems, notes = read_lists(dataset)
    listed = sorted(set().union(*lists.values()))
    with ThreadPoolExecutor(num_threads) as pool:
        results = dict(zip(listed, pool.map(read, listed), strict=True))
    problems += [result for result in results.values() if isinstance(result, str)]
    contents = {name: each for name, each in results.items() if isinstance(each, _Content)}
    splits = tuple(_report_split(dataset, split, lists[split], contents) for split in lists)
    problems += [
        *_list_problems(dataset, lists),
        *_unused(dataset, lists),
        *dataset.own_problems(lists),
        *_clipped(dataset, splits),
    ]
    sizes = sorted(set().union(*(split.sizes for split in splits)))
    if len(sizes) > 1:
        texts = ", ".join(f"{height}x{width}" for height, width in sizes)
        notes.append(f"images differ in size ({texts}); evaluate with data.eval_batch_size=1.")
    notes += dataset.own_notes(lists)
    if dataset.expected is not None and dataset.expected.name == dataset.name:
        own = tuple(split for split in splits if not dataset.repeats(split.split))
        notes += _other_numbers(own, dataset.expected)
    return DatasetReport(splits, tuple(problems), (*notes, *_thermal_notes(dataset, splits)))


def read_lists(
    dataset: FileDataset,
) -> tuple[dict[str, tuple[str, ...]], list[str], list[str]]:
    """Names of every readable split; and problems and notes about the others."""
    lists: dict[str, tuple[str, ...]] = {}
    problems: list[str] = []
    notes: list[str] = []
    for split in dataset.splits:
        try:
            lists[split] = dataset.names(split)
        except InputError as error:
            (notes if dataset.repeats(split) else problems).append(str(error))
    return lists, problems, notes


def _content(dataset: FileDataset, name: str) -> _Content:
    sample = dataset.read(name)
    thermal = None
    if dataset.clipping is not None:
        thermal = ThermalStatistics.of(dataset.thermal_values(name), *dataset.clipping)
    height, width = sample.thermal.shape
    if sample.label is None:
        return _Content((height, width), None, thermal)
    return _Content((height, width), label_pixels(sample.label, dataset.num_classes), thermal)


def _report_split(
    dataset: FileDataset, split: str, names: tuple[str, ...], contents: Mapping[str, _Content]
) -> SplitReport:
    read = [contents[name] for name in dict.fromkeys(names) if name in contents]
    originals = [name for name in names if not _is_mirrored(dataset, name)]
    times = Counter(_time_of(dataset, name) for name in originals)
    labelled = [content.pixels for content in read if content.pixels is not None]
    pixels = np.array(labelled, np.int64).reshape(-1, dataset.num_classes + 1)
    return SplitReport(
        split=split,
        num_names=len(names),
        num_read=len(read),
        num_unlabelled=len(read) - len(labelled),
        num_day=times["day"],
        num_night=times["night"],
        num_flipped=len(names) - len(originals),
        sizes=dict(Counter(content.hw for content in read)),
        pixels=pixels.sum(0),
        images=(pixels > 0).sum(0),
        thermal=ThermalStatistics.together([c.thermal for c in read if c.thermal is not None]),
    )


def _is_mirrored(dataset: FileDataset, name: str) -> bool:
    return dataset.mirrored is not None and name.endswith(dataset.mirrored)


def _time_of(dataset: FileDataset, name: str) -> str:
    """Either "day" or "night", or "" if that is unknown."""
    try:
        nights = dataset.nights((name,))
    except InputError:  # reading it reports the problem
        nights = None
    return "" if nights is None else "night" if nights[0] else "day"


def _list_problems(dataset: FileDataset, lists: dict[str, tuple[str, ...]]) -> list[str]:
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
        flipped = [name for name in names if _is_mirrored(dataset, name)]
        if flipped and "train" not in split:
            problems.append(
                f"split {split} lists {len(flipped)} mirrored copies; the first is "
                f"'{flipped[0]}'. Only training splits may list them."
            )
    for one, other in combinations(lists, 2):
        words, other_words = set(one.split("_")), set(other.split("_"))
        is_part = words <= other_words or other_words <= words
        if is_part or not set(dataset.sources(one)).isdisjoint(dataset.sources(other)):
            continue
        in_other = set(lists[other])
        both = [name for name in lists[one] if name in in_other]
        if both:
            problems.append(
                f"splits {one} and {other} share {len(both)} names; the first is '{both[0]}'."
            )
    return problems


def _unused(dataset: FileDataset, lists: SplitNames) -> list[str]:
    unused = sorted(dataset.unused(lists))
    return [
        f"{len(unused)} files belong to no image of a split; the first is {path}."
        for path in unused[:1]
    ]


def _clipped(dataset: FileDataset, splits: tuple[SplitReport, ...]) -> list[str]:
    """Splits of which most thermal values lie outside the range that is read."""
    problems = []
    for split in splits:
        thermal, limits = split.thermal, dataset.clipping
        if thermal is None or limits is None:
            continue
        filled, outside = thermal.pixels - thermal.empty, thermal.below + thermal.above
        if outside > dataset.most_clipped * filled:
            problems.append(
                f"split {split.split}: {outside / filled:.2%} of the thermal values other than 0 "
                f"lie outside dataset.thermal_range={plain(limits)} and become black or white. "
                f"They range from {thermal.lowest:g} to {thermal.highest:g}; choose a range among "
                "them."
            )
    return problems


def _thermal_notes(dataset: FileDataset, splits: tuple[SplitReport, ...]) -> list[str]:
    notes = []
    for split in splits:
        thermal, limits = split.thermal, dataset.clipping
        if thermal is None or limits is None or dataset.repeats(split.split):
            continue
        empty, below, above = (f"{each / thermal.pixels:.2%}" for each in thermal[1:4])
        others = f"{below} lie below and {above} above dataset.thermal_range={plain(limits)}"
        if dataset.images.thermal_range is None:
            others = "which marks pixels without a measurement"
        notes.append(
            f"split {split.split}: {empty} of the thermal pixels are 0, {others}; the others "
            f"range from {thermal.lowest:g} to {thermal.highest:g}."
        )
    return notes


def _other_numbers(splits: tuple[SplitReport, ...], expected: Expected) -> list[str]:
    """Differences from the published numbers."""
    times = dict(expected.day_night)
    for name, (day, night) in expected.day_night.items():
        times |= {f"{name}_day": (day, 0), f"{name}_night": (0, night)}
    notes = []
    for split in splits:
        found = (split.num_day, split.num_night)
        official = times.get(split.split, found)
        if official != found:
            notes.append(
                f"split {split.split} has {found[0]} day and {found[1]} night images, but the "
                f"official list has {official[0]} and {official[1]} ({sum(official)} in total)."
            )
        num_images = expected.images.get(split.split, split.num_names)
        if num_images != split.num_names:
            notes.append(
                f"split {split.split} has {split.num_names} images, but the archive has "
                f"{num_images}."
            )
    others = sorted(set().union(*(split.sizes for split in splits)) - {expected.hw})
    if expected.hw and others:
        listed = ", ".join(f"{height}x{width}" for height, width in others)
        notes.append(
            f"images are {listed}, but the original images are {expected.hw[0]}x{expected.hw[1]}. "
            "Scores on resized images are not comparable with those on original images."
        )
    return notes
