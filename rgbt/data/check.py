"""The command ``rgbt check``, which reads a whole data set and reports its problems.

    rgbt check dataset=mfnet dataset.root=...

Progress goes to stderr, the report to stdout. Exit code 0: no problem, 1: problems, 2: wrong input.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig

from rgbt.checks import InputError
from rgbt.config.command import command
from rgbt.config.component import build
from rgbt.cores import usable_cores
from rgbt.data.file_dataset import DAY_OR_NIGHT, FileDataset, SplitNames, evenly_spaced
from rgbt.data.images import PairReader
from rgbt.data.labels import PixelCounts, label_pixels, of_one_class
from rgbt.data.thermal import TAIL, kind_of, mixed, points_of
from rgbt.geometry.alignment import GRID, estimated, grid_of, moved, root_mean_square
from rgbt.geometry.optical_flow import gray_of
from rgbt.tables import TextTable
from rgbt.terminal import plain_text, print_rich, rich_table, tracked

# Name of a sample, or "" for the whole data set, and a sentence about it.
Sentences = list[tuple[str, str]]

# In sentences of one kind: values, which are kept, and paths and other numbers, which are not.
VARYING = re.compile(r"((?:label|thermal) value -?[\d.e+-]+|colour \[[^]]*\])|\S*/\S*|\d+")
# Bins of a histogram, and their heights.
BINS, HEIGHTS = 24, " .:-=+*#@"
# Pairs that the misalignment is estimated from, distance in pixels that is not reported, and least
# shorter side of images.
ALIGNED_PAIRS, ALIGNED_PX, SMALLEST_ALIGNED = 24, 1.0, 64
OF_FILE = re.compile(r"'([^']+)'|(\S*/\S+)")


@dataclass(frozen=True)
class SplitReport:
    """Holds numbers of names of a split by kind, and what is in its images.

    `read` and `unlabelled` count each name once; `day` and `night` leave out mirrored copies.
    `sizes` has the number of images of each (height, width); `pixels` and `images` (K + 1,) the
    pixels of each class and the images that show it, ignored pixels last. `thermal` has stored
    values (`points_of`) of all images, "", and of those by "day" and at "night".
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
    thermal: dict[str, NDArray[np.float64]]


class Content(NamedTuple):
    """Says what the files of a sample hold; `pixels` as of `label_pixels`, None without a label."""

    hw: tuple[int, ...]
    pixels: PixelCounts | None
    thermal: str  # type of the stored values: uint8, uint16, float
    points: NDArray[np.float64]  # of the stored values
    problems: list[str]
    notes: list[str]


@dataclass(frozen=True)
class DatasetReport:
    """Holds the splits of a data set by name, and a sentence for each kind of problem and note."""

    splits: dict[str, SplitReport]
    problems: tuple[str, ...]
    notes: tuple[str, ...]


@command()
def main(config: DictConfig, _overrides: list[str]) -> int:
    """Read every file of the data set and report its problems; exit code 1: there are some."""
    dataset = build(config.dataset)
    if not isinstance(dataset, FileDataset):
        raise InputError(
            f"dataset: {type(dataset).__name__} cannot be checked, because it is not a "
            "rgbt.data.file_dataset.FileDataset."
        )
    report = check_dataset(dataset, num_threads=usable_cores(), is_shown=True)
    print_rich(plain_text(f"{dataset.name} ({type(dataset).__name__}): {dataset.root}"))
    for table in (*tables(dataset, report), thermal_table(dataset, report)):
        print_rich(rich_table(table))
    lines = [range_line(dataset.images)] if any(r.read for r in report.splits.values()) else []
    lines += [f"note: {note}" for note in report.notes]
    lines += [said] if (said := misalignment(dataset, report)) else []
    lines += [f"problem: {problem}" for problem in report.problems]
    lines += [f"{len(report.problems)} problem(s), {len(report.notes)} note(s)."]
    print_rich(plain_text("\n".join(lines)))
    return 1 if report.problems else 0


def misalignment(dataset: FileDataset, report: DatasetReport) -> str:
    """Say how far thermal lies from RGB, estimated from a few pairs; "" if it is little.

    It is little if a side or the middle is off by at most `ALIGNED_PX`, or twice its uncertainty.
    """
    sizes = sum((Counter(r.sizes) for r in report.splits.values()), Counter[tuple[int, ...]]())
    names = [n for split in report.splits for n in dataset.names(split)]
    names = list(dict.fromkeys(names))
    if not sizes or min(hw := sizes.most_common(1)[0][0]) < SMALLEST_ALIGNED:
        return ""
    pairs = []
    for name in evenly_spaced(names, ALIGNED_PAIRS):
        with suppress(InputError):  # it is among the problems
            sample = dataset.pair(name)
            if sample.thermal.shape == hw:
                pairs.append((gray_of(sample.rgb), sample.thermal))
    found = estimated(pairs) if pairs else None
    if found is None or found.reason((hw[0], hw[1])):
        return f"alignment: cannot be estimated from {len(pairs)} pairs."
    points = grid_of((hw[0], hw[1]), GRID)
    shifts = np.linalg.norm(moved(found.matrix, points) - points, axis=1).reshape(GRID, GRID)
    middle = GRID // 2
    places: dict[str, Any] = {
        "at the right edge": np.s_[:, -1],
        "at the left edge": np.s_[:, 0],
        "at the top edge": np.s_[0],
        "at the bottom edge": np.s_[-1],
        "in the middle": np.s_[middle, middle],
    }
    means = {place: float(shifts[where].mean()) for place, where in places.items()}
    place = max(means, key=means.__getitem__)
    off, error = means[place], root_mean_square(found.uncertainty[places[place]])
    if off <= max(ALIGNED_PX, 2 * error):
        return ""
    return (
        f"alignment: thermal is off by about {off:.1f} px {place} (standard error {error:.1f} px, "
        f"{len(pairs)} pairs); rgbt align measures and corrects it."
    )


def tables(dataset: FileDataset, report: DatasetReport) -> tuple[TextTable, TextTable]:
    """Return a table of names and sizes by split, and one of pixels and images by class."""
    rows = [
        (
            split,
            *map(str, (r.names, r.read, r.day, r.night, r.mirrored, r.unlabelled)),
            _in_words(r.sizes),
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


def thermal_table(dataset: FileDataset, report: DatasetReport) -> TextTable:
    """Return a table of the thermal values of each split, by day and at night, with a histogram.

    Each histogram has the same ends, between which all but `TAIL` of the values lie on each side,
    and the height of its own largest bin.
    """
    unit = dataset.images.unit
    form = "{:.5g}" if unit is None else "{:.1f}"
    found: dict[str, NDArray[np.float64]] = {}
    for split, report_of in report.splits.items():
        for time, points in report_of.thermal.items():
            if points.size and not dataset.repeats(split):
                found[f"{split} {time}".strip()] = points if unit is None else unit.degrees(points)
    if not found:
        return TextTable("", ("thermal",), ())
    every = np.concatenate(list(found.values()))
    ends = np.quantile(every, (TAIL, 1 - TAIL))
    rows = []
    for name, points in found.items():
        values = [points.min(), *np.quantile(points, (TAIL, 0.5, 1 - TAIL)), points.max()]
        counts = np.histogram(points.clip(*ends), BINS, tuple(ends))[0]
        heights = np.ceil(counts / counts.max() * (len(HEIGHTS) - 1)).astype(int)
        bars = "".join(HEIGHTS[height] for height in heights)
        rows.append((name, *(form.format(value) for value in values), bars))
    share = f"{TAIL:.1%}", "median", f"{1 - TAIL:.1%}"
    what = "thermal values" if unit is None else "thermal, Celsius"
    histogram = " to ".join(map(form.format, ends))
    return TextTable("", (what, "lowest", *share, "highest", histogram), tuple(rows))


def range_line(images: PairReader) -> str:
    """Say which thermal values become black and white."""
    if images.chosen_range is None:
        return "thermal: grey levels of 8 bits, used as they are."
    low, high = images.chosen_range
    of_unit = "" if images.unit is None else " degrees Celsius"
    by = "" if images.find_range is None else ", found by auto in images of the split train"
    return f"thermal: {low:g} becomes black, {high:g}{of_unit} white{by}."


def _in_words(sizes: Mapping[tuple[int, ...], int]) -> str:
    """Write sizes with their number of images; of many, the smallest and the largest."""
    texts = [f"{height}x{width} ({number})" for (height, width), number in sorted(sizes.items())]
    if len(texts) > 3:
        return f"{texts[0]} to {texts[-1]}, {len(texts)} sizes"
    return ", ".join(texts)


def check_dataset(
    dataset: FileDataset, *, num_threads: int = 4, is_shown: bool = False
) -> DatasetReport:
    """Read every sample of the splits, in threads, and report problems; progress goes to stderr.

    InputError: `auto` finds no thermal range.
    """
    dataset.settle_range(None)  # once, before threads need it
    lists: dict[str, tuple[str, ...]] = {}
    problems: Sentences = []
    notes: Sentences = []
    for split in dataset.splits:
        try:
            lists[split] = dataset.names(split)
        except InputError as error:
            (notes if dataset.repeats(split) else problems).append(("", str(error)))
    names = tuple(dict.fromkeys(name for names in lists.values() for name in names))
    contents: dict[str, Content] = {}
    for name, found in zip(names, _read(dataset, names, num_threads, is_shown), strict=True):
        if isinstance(found, str):
            problems.append((name, found))
        else:
            contents[name] = found
    problems += [(name, text) for name, found in contents.items() for text in found.problems]
    stored = {name: (content.thermal, content.points) for name, content in contents.items()}
    problems += mixed(stored, dataset.images.unit)
    notes += [(name, text) for name, found in contents.items() for text in found.notes]
    splits = {split: _report(dataset, names, contents) for split, names in lists.items()}
    problems += _list_problems(dataset, lists)
    unused = sorted(dataset.unused(lists))
    if unused:
        text = f"{len(unused)} files belong to no image of a split; the first is {unused[0]}."
        problems.append(("", text))
    for text in dataset.own_problems(lists):
        of_file = OF_FILE.search(text)
        name = of_file[1] or of_file[2] if of_file else ""
        problems.append((name.removeprefix(f"{dataset.root}/"), text))
    notes += [("", text) for text in (*_mixed_sizes(splits), *_same_lists(dataset, lists))]
    pixels = sum((report.pixels for report in splits.values()), np.zeros(1, np.int64))
    shown = dict(zip(dataset.classes, pixels, strict=False))
    absent = [f"'{n}'" for n in shown if not shown[n] and n not in dataset.unscored]
    if alone := of_one_class(pixels, dataset.classes, dataset.codes):
        problems.append(("", f"{alone}."))
    elif absent and pixels.any():
        notes.append(("", f"no label shows {', '.join(absent)}; no score says anything about it."))
    notes += [("", text) for text in (*dataset.own_notes(lists), *_uneven(dataset, splits))]
    return DatasetReport(splits, grouped(problems), grouped(notes))


def _read(
    dataset: FileDataset, names: Sequence[str], num_threads: int, is_shown: bool
) -> Iterator[Content | str]:
    """Return the content of every sample, or why it cannot be read, in order."""

    def read(name: str) -> Content | str:
        try:
            return _content_of(dataset, name)
        except InputError as error:
            return str(error)

    with ThreadPoolExecutor(num_threads) as pool:
        results = pool.map(read, names)
        yield from tracked(results, "reading", len(names)) if is_shown else results


def _content_of(dataset: FileDataset, name: str) -> Content:
    """Read the files of a sample; InputError as of `FileDataset.read`."""
    whole = dataset.whole(name)
    sample, values = dataset.made(name, whole), dataset.images.cut(whole[1], name)
    pixels = None if sample.label is None else label_pixels(sample.label, dataset.num_classes)
    kind = kind_of(values)
    problems = []
    if sample.thermal.min() == sample.thermal.max():
        is_flat = values.min() == values.max()
        remedy = "replace the image" if is_flat else "see dataset.thermal_range"
        problems = [f"thermal is one grey level everywhere; {remedy}."]
    notes = [
        f"thermal value {value:g} is far from all others (no data?), and used as it is."
        for value in (() if kind == "uint8" else lonely_values(values))
    ]
    return Content(sample.thermal.shape, pixels, kind, points_of(values), problems, notes)


def lonely_values(values: NDArray[Any]) -> list[float]:
    """Return the lowest and the highest value, if farther from the others than these differ."""
    found, rest = [], values.astype(np.float64)
    for sign in (1, -1, 1, -1):  # a second time without what was found
        end = (sign * rest).min()
        others = sign * rest[sign * rest > end]
        if others.size and others.min() - end > others.max() - others.min() > 0:
            found.append(float(sign * end))
            rest = sign * others
    return found


def _report(
    dataset: FileDataset, names: Sequence[str], contents: Mapping[str, Content]
) -> SplitReport:
    own = [contents[name] for name in dict.fromkeys(names) if name in contents]
    labelled = [content.pixels for content in own if content.pixels is not None]
    counts = np.array(labelled, np.int64).reshape(-1, dataset.num_classes + 1)
    times = {name: _kind_of(dataset, name) for name in names}
    kinds = Counter(times[name] for name in names)
    points: dict[str, list[NDArray[np.float64]]] = {"": [], "day": [], "night": []}
    for name in dict.fromkeys(names):
        if name in contents:
            points[""].append(contents[name].points)
            points.get(times[name], []).append(contents[name].points)
    return SplitReport(
        names=len(names),
        read=len(own),
        unlabelled=len(own) - len(labelled),
        day=kinds["day"],
        night=kinds["night"],
        mirrored=kinds["mirrored"],
        sizes=dict(Counter(content.hw for content in own)),
        pixels=counts.sum(0),
        images=(counts > 0).sum(0),
        thermal={time: np.array(values) for time, values in points.items()},
    )


def grouped(found: Sentences) -> tuple[str, ...]:
    """Return a sentence a kind: the first, after the number of images and the names of three.

    Sentences of a kind differ in the name, in paths, and in numbers that are no values of images.
    """
    kinds: dict[str, Sentences] = defaultdict(list)
    for name, text in found:
        plain = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", "", text) if name else text
        kinds[VARYING.sub(lambda match: match[1] or "", plain)].append((name, text))
    lines = []
    for (name, text), *others in kinds.values():
        names = ", ".join((name, *(other for other, _ in others[:2])))
        more = ", ..." if len(others) > 2 else ""
        before = f"{name}: " if name and name not in text else ""
        lines.append(
            f"{len(others) + 1} times ({names}{more}): {text}" if others else before + text
        )
    return tuple(lines)


def _kind_of(dataset: FileDataset, name: str) -> str:
    """Return "mirrored", "day", "night", or "" if that is unknown."""
    if dataset.mirrored is not None and name.endswith(dataset.mirrored):
        return "mirrored"
    try:
        nights = dataset.nights((name,))
    except InputError:  # reading it reports the problem
        nights = None
    if nights is None:
        return ""
    return "night" if nights[0] else "day"


def _uneven(dataset: FileDataset, splits: dict[str, SplitReport]) -> list[str]:
    """Say what a split lacks that another split has: images by day or at night, or a class."""
    whole = {split: r for split, r in splits.items() if not split.endswith(DAY_OR_NIGHT)}
    notes = []
    for split, r in whole.items():
        others = [other for name, other in whole.items() if name != split]
        lacking = [
            f"{time} images"
            for time, own in (("day", r.day), ("night", r.night))
            if not own and any(getattr(other, time) for other in others)
        ]
        labelled = r.unlabelled < r.read
        lacking += [
            f"'{name}'"
            for index, name in enumerate(dataset.classes)
            if labelled and not r.pixels[index] and any(other.pixels[index] for other in others)
        ]
        if lacking:
            notes.append(
                f"split {split} has no {', '.join(lacking)}, which other splits have; a score of "
                "it says nothing about them."
            )
    return notes


def _mixed_sizes(splits: Mapping[str, SplitReport]) -> Iterator[str]:
    """Name the settings that images of several sizes need."""
    sizes = sorted({size for report in splits.values() for size in report.sizes})
    if len(sizes) > 1:
        ends = " to ".join(f"{height}x{width}" for height, width in (sizes[0], sizes[-1]))
        crop = f"{min(height for height, _ in sizes)},{min(width for _, width in sizes)}"
        yield (
            f"images differ in size ({ends}); train with 'scale.crop_hw=[{crop}]' or less, and "
            "data.eval_batch_size=1."
        )


def _same_lists(dataset: FileDataset, lists: SplitNames) -> Iterator[str]:
    """Name the splits that are read from one list, such as a `val` that is the test part."""
    for one, other in combinations(lists, 2):
        if dataset.splits[one] == dataset.splits[other]:
            yield f"splits {one} and {other} are one list: {other} has no image unseen in {one}."


def _list_problems(dataset: FileDataset, lists: SplitNames) -> Sentences:
    """Find names listed twice, of another time of day, mirrored for testing, or in two splits.

    Two splits may share names if one is a part of the other by name, as "test_day" is of "test",
    or if both are made of one source; of such splits the last is checked.
    """
    problems: Sentences = []
    of_source = {dataset.splits[split]: split for split in lists}
    lists = {split: lists[split] for split in of_source.values()}
    for split, names in lists.items():
        other = {"day": "night", "night": "day"}.get(split.rpartition("_")[2])
        kinds = {name: _kind_of(dataset, name) for name in names}
        for name, count in Counter(names).items():
            if count > 1:
                problems.append((name, f"split {split} lists '{name}' {count} times."))
            if kinds[name] == other:
                text = f"split {split} lists '{name}', which is a {other} image."
                problems.append((name, text))
        flipped = [name for name in names if kinds[name] == "mirrored"]
        if flipped and "train" not in split:
            text = f"split {split} lists {len(flipped)} mirrored copies: '{flipped[0]}'."
            problems.append(("", text))
    for one, other in combinations(lists, 2):
        words, other_words = set(one.split("_")), set(other.split("_"))
        is_part = words <= other_words or other_words <= words
        both = sorted(set(lists[one]) & set(lists[other]))
        if both and not is_part:
            text = f"splits {one} and {other} share {len(both)} names; the first is '{both[0]}'."
            problems.append(("", text))
    return problems


if __name__ == "__main__":
    main()
