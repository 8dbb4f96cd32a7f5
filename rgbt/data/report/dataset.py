"""What a data set holds and what is wrong with it, as values.

Reads every listed sample once, in threads. Printing is in `rgbt.data.check`; what depends on the
kind of data set in `rgbt.data.report.mfnet` and its like.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbt.checks import InputError
from rgbt.data.folder.dataset import Folder
from rgbt.data.freiburg import Freiburg
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import PST900
from rgbt.data.report.folder import FolderLayout
from rgbt.data.report.freiburg import FreiburgLayout
from rgbt.data.report.kp import KPLayout
from rgbt.data.report.mfnet import MFNetLayout
from rgbt.data.report.pst900 import PST900Layout
from rgbt.data.report.values import Counts, Layout, Lists, Report, SplitReport, Thermal
from rgbt.dataset import LabelledDataset
from rgbt.types import IGNORE


@dataclass(frozen=True)
class _Content:
    """What a readable sample holds; `pixels` is None without a label."""

    hw: tuple[int, int]
    pixels: Counts | None
    thermal: Thermal | None


LAYOUTS: tuple[tuple[type, Callable[[Any], Layout]], ...] = (
    (MFNet, MFNetLayout),
    (PST900, PST900Layout),
    (KP, KPLayout),
    (Freiburg, FreiburgLayout),
    (Folder, FolderLayout),
)
"""Kinds of data sets, and what is to be known about each."""


def layout_of(dataset: LabelledDataset) -> Layout:
    """What is particular about the data set; InputError where nothing is known about its kind."""
    for kind, layout in LAYOUTS:
        if isinstance(dataset, kind):
            return layout(dataset)
    raise InputError(
        "dataset: expected a data set whose layout is known "
        f"({', '.join(kind.__name__ for kind, _ in LAYOUTS)}), got {type(dataset).__name__}; "
        "choose dataset=mfnet, freiburg, synth or another file of conf/dataset."
    )


def check_dataset(
    dataset: LabelledDataset,
    *,
    num_threads: int = 4,
    advance: Callable[[], object] = lambda: None,
) -> Report:
    """Read everything that the splits name and compare it with what should be there.

    Args:
        dataset: in a known layout (`layout_of`).
        num_threads: files decoded at a time.
        advance: called once for every sample that has been read.

    Returns:
        Report; `problems` is empty where nothing is wrong.

    Raises:
        InputError: an unknown layout, or folders that cannot be made out at all.
    """
    layout = layout_of(dataset)
    notes: list[str] = []
    problems: list[str] = []
    lists = _read_lists(dataset, layout, problems, notes)
    contents: dict[str, _Content] = {}
    listed = sorted(set().union(*lists.values()))
    found_each = _read_all(dataset, layout, listed, num_threads, advance)
    for name, found in zip(listed, found_each, strict=True):
        if isinstance(found, str):
            problems.append(found)
        else:
            contents[name] = found
    splits = tuple(
        _report_split(split, names, contents, dataset.num_classes, layout)
        for split, names in lists.items()
    )
    problems += layout.problems(lists)
    notes += [*_size_notes(splits), *layout.notes(splits)]
    return Report(splits, tuple(problems), tuple(notes))


def num_listed(dataset: LabelledDataset) -> int:
    """Samples that `check_dataset` will read."""
    return len(set().union(*_read_lists(dataset, layout_of(dataset), [], []).values()))


def _read_lists(
    dataset: LabelledDataset, layout: Layout, problems: list[str], notes: list[str]
) -> Lists:
    """Names of every split that can be listed; what is wrong with the others is appended."""
    lists = {}
    for split in dataset.splits:
        try:
            lists[split] = dataset.names(split)
        except InputError as error:
            (notes if layout.repeats(split) else problems).append(str(error))
    return lists


def _read_all(
    dataset: LabelledDataset,
    layout: Layout,
    names: list[str],
    num_threads: int,
    advance: Callable[[], object],
) -> Iterable[_Content | str]:
    """Content of every name in order, or the sentence that says why it cannot be read."""

    def read(name: str) -> _Content | str:
        try:
            sample = dataset.read(name)
            thermal = layout.thermal(name)
        except InputError as error:
            return str(error)
        finally:
            advance()
        height, width = sample.thermal.shape
        if sample.label is None:
            return _Content((height, width), None, thermal)
        counts = np.bincount(sample.label.ravel(), minlength=IGNORE + 1)
        pixels = np.append(counts[: dataset.num_classes], counts[IGNORE])
        return _Content((height, width), pixels, thermal)

    with ThreadPoolExecutor(num_threads) as pool:
        yield from pool.map(read, names)


def _report_split(
    split: str,
    names: tuple[str, ...],
    contents: dict[str, _Content],
    num_classes: int,
    layout: Layout,
) -> SplitReport:
    read = [contents[name] for name in dict.fromkeys(names) if name in contents]
    times = layout.times(names)
    labelled = [content.pixels for content in read if content.pixels is not None]
    pixels = np.array(labelled, np.int64).reshape(-1, num_classes + 1)
    return SplitReport(
        split=split,
        num_names=len(names),
        num_read=len(read),
        num_unlabelled=len(read) - len(labelled),
        num_day=times.day,
        num_night=times.night,
        num_flipped=times.mirrored,
        sizes=dict(Counter(content.hw for content in read)),
        pixels=pixels.sum(0),
        images=(pixels > 0).sum(0),
        thermal=_together([each.thermal for each in read if each.thermal is not None]),
    )


def _together(images: list[Thermal]) -> Thermal | None:
    if not images:
        return None
    table = np.array(images, np.int64)
    pixels, empty, below, above = table[:, :4].sum(0).tolist()
    lowest = min((image.lowest for image in images if image.lowest), default=0)
    return Thermal(pixels, empty, below, above, lowest, max(image.highest for image in images))


def _size_notes(splits: tuple[SplitReport, ...]) -> list[str]:
    sizes = set().union(*(split.sizes for split in splits))
    if len(sizes) < 2:
        return []
    listed = ", ".join(f"{height}x{width}" for height, width in sorted(sizes))
    return [f"images differ in size ({listed}); evaluate with data.eval_batch_size=1."]
