"""Reads a whole data set and reports its content and its problems.

Every listed sample is read once, in threads. `rgbt.data.check` prints the report; checks of one
data set are in `rgbt.data.report.mfnet`, `rgbt.data.report.kp` and so on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from rgbt.checks import InputError
from rgbt.data.report.values import (
    Checkable,
    DatasetChecks,
    DatasetReport,
    PixelCounts,
    SplitNames,
    SplitReport,
    ThermalStatistics,
)
from rgbt.dataset import LabelledDataset
from rgbt.types import IGNORE


@dataclass(frozen=True)
class _Content:
    """Content of a sample; `pixels` is None without a label."""

    hw: tuple[int, int]
    pixels: PixelCounts | None
    thermal: ThermalStatistics | None


def checks_of(dataset: LabelledDataset) -> DatasetChecks:
    """The checks that the data set declares; InputError if it declares none."""
    if isinstance(dataset, Checkable):
        return dataset.checks()
    raise InputError(
        f"dataset: {type(dataset).__name__} cannot be checked, it has no method `checks` "
        "(rgbt.data.report.values.Checkable); choose dataset=mfnet, freiburg, synth or another "
        "file of conf/dataset, or add the method."
    )


def check_dataset(
    dataset: LabelledDataset,
    *,
    num_threads: int = 4,
    advance: Callable[[], object] = lambda: None,
) -> DatasetReport:
    """Read every sample of the splits and report problems; none: nothing is wrong.

    Args:
        dataset: declares its checks (`Checkable`), or is refused.
        num_threads: files decoded at a time.
        advance: called once for every sample that has been read.
    """
    checks = checks_of(dataset)
    notes: list[str] = []
    problems: list[str] = []
    lists = _read_lists(dataset, checks, problems, notes)
    contents: dict[str, _Content] = {}
    listed = sorted(set().union(*lists.values()))
    results = _read_all(dataset, checks, listed, num_threads, advance)
    for name, result in zip(listed, results, strict=True):
        if isinstance(result, str):
            problems.append(result)
        else:
            contents[name] = result
    splits = tuple(
        _report_split(split, names, contents, dataset.num_classes, checks)
        for split, names in lists.items()
    )
    problems += checks.problems(lists)
    notes += [*_size_notes(splits), *checks.notes(splits)]
    return DatasetReport(splits, tuple(problems), tuple(notes))


def num_listed(dataset: LabelledDataset) -> int:
    """Samples that `check_dataset` will read."""
    return len(set().union(*_read_lists(dataset, checks_of(dataset), [], []).values()))


def _read_lists(
    dataset: LabelledDataset, checks: DatasetChecks, problems: list[str], notes: list[str]
) -> SplitNames:
    """Names of every readable split; problems of the others are appended."""
    lists = {}
    for split in dataset.splits:
        try:
            lists[split] = dataset.names(split)
        except InputError as error:
            (notes if checks.repeats(split) else problems).append(str(error))
    return lists


def _read_all(
    dataset: LabelledDataset,
    checks: DatasetChecks,
    names: list[str],
    num_threads: int,
    advance: Callable[[], object],
) -> Iterable[_Content | str]:
    """Content of every sample in order, or the message why it cannot be read."""

    def read(name: str) -> _Content | str:
        try:
            sample = dataset.read(name)
            thermal = checks.thermal(name)
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
    checks: DatasetChecks,
) -> SplitReport:
    read = [contents[name] for name in dict.fromkeys(names) if name in contents]
    times = checks.times(names)
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


def _together(images: list[ThermalStatistics]) -> ThermalStatistics | None:
    if not images:
        return None
    table = np.array(images, np.int64)
    pixels, empty, below, above = table[:, :4].sum(0).tolist()
    lowest = min((image.lowest for image in images if image.lowest), default=0)
    return ThermalStatistics(
        pixels, empty, below, above, lowest, max(image.highest for image in images)
    )


def _size_notes(splits: tuple[SplitReport, ...]) -> list[str]:
    sizes = set().union(*(split.sizes for split in splits))
    if len(sizes) < 2:
        return []
    listed = ", ".join(f"{height}x{width}" for height, width in sorted(sizes))
    return [f"images differ in size ({listed}); evaluate with data.eval_batch_size=1."]
