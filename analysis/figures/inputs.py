"""All figures by name, the types of their options, and the files that these name."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import pandas as pd
from annotated_types import Interval
from matplotlib.figure import Figure

from analysis.arguments import MOST, dataset_of
from analysis.bar import progress
from analysis.predictions.maps import PixelMaps
from analysis.results import Frames, open_counts
from analysis.statistics.collect import MeasurementSettings, SpatialStatistics, collect
from rgbt.checks import InputError, nearest, split_list
from rgbt.config.command import built
from rgbt.config.options import Help
from rgbt.metrics.counts import Counts, check_same_means
from rgbt.metrics.metric import Regions

if TYPE_CHECKING:
    from rgbt.dataset import LabelledDataset

Drawn = tuple[Figure, pd.DataFrame]
"""A figure, and the numbers that it shows."""

Count = Annotated[int, Interval(ge=1, le=MOST)]
Maps = Annotated[str, Help("output of rgbt score: folder or maps.npz")]
Statistics = Annotated[
    str,
    Help(
        "output of rgbt spatial: folder or statistics.npz; or dataset=... to measure the data set"
    ),
]
Scored = Annotated[
    str, Help("methods, label:folder,label:folder: output of rgbt score, or predicted label images")
]
Runs = Annotated[
    str,
    Help(
        "runs, groups or files of counts, separated by commas; label:run,label:run sets their "
        "labels; entries with the same label are seeds of one method"
    ),
]
RunsDir = Annotated[str, Help("folder of runs (default: runs)")]
Split = Annotated[
    str, Help("split of the data set or the runs (default: test; of statistics: train)")
]
Part = Annotated[Literal["all", "day", "night"], Help("images: all, day or night")]
Names = Annotated[str, Help("names of the images to show, separated by commas")]
Pick = Annotated[
    Literal["first", "largest_difference"],
    Help("images that are shown: first, or largest_difference of the first and the last method"),
]
Rows = Annotated[Count, Help("number of images")]
Layout = Annotated[
    Literal["rows", "columns"], Help("one row or one column per image: rows or columns")
]
Form = Annotated[Literal["index", "colour"], Help("format of predictions: index or colour")]
Palette = Annotated[str, Help("palette of coloured predictions, as in `rgbt score`")]
Prefix = Annotated[str, Help("beginning of the file names of predictions")]
Suffix = Annotated[str, Help("end of the file names of predictions, NAME<suffix>.png")]
AbsentClasses = Annotated[
    Literal["released", "exclude"] | None,
    Help(
        "class without pixels: released: it scores 0; exclude: it is in no mean; default: as the "
        "counts say"
    ),
]


@dataclass(frozen=True)
class FigureSpec:
    """One figure.

    Attributes:
        make: from a `Config` and options to a figure and its numbers.
        groups: groups of the configuration that take effect.
        metric: the partition unless ``metric=`` is given, a file of ``conf/metric/``.
    """

    make: Callable[..., Drawn]
    shows: str
    groups: tuple[str, ...] = ()
    metric: str = "ring5"

    @property
    def options(self) -> dict[str, inspect.Parameter]:
        """The parameters of `make` after the configuration, by name."""
        signature = inspect.signature(self.make, eval_str=True)
        return dict([*signature.parameters.items()][1:])

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the options without a default."""
        return tuple(name for name, each in self.options.items() if each.default is each.empty)


FIGURES: dict[str, FigureSpec] = {}


def figure(name: str, shows: str, *groups: str, metric: str = "ring5") -> Any:
    """Decorator that registers a figure; see `FigureSpec`."""

    def register(make: Callable[..., Drawn]) -> Callable[..., Drawn]:
        FIGURES[name] = FigureSpec(make, shows, groups, metric)
        return make

    return register


@dataclass(frozen=True)
class Config:
    """What overrides such as ``dataset=mfnet`` and ``metric=ring9`` choose, built when needed."""

    overrides: Sequence[str] = ()
    defaults: Mapping[str, str] = field(default_factory=dict)

    def chooses(self, group: str) -> bool:
        """Whether a file of the group was chosen."""
        return any(word.lstrip("+~").startswith(f"{group}=") for word in self.overrides)

    @cached_property
    def dataset(self) -> LabelledDataset:
        """The data set; InputError where none was chosen."""
        return dataset_of([*self._defaults, *self.overrides])

    @cached_property
    def regions(self) -> Regions:
        """The partition of the image."""
        regions: Regions = self.built("metric")
        return regions

    def built(self, node: str, *more: str) -> Any:
        """The object of one node of the configuration."""
        return built(node, [*self._defaults, *self.overrides, *more])

    @property
    def _defaults(self) -> list[str]:
        return [f"{key}={name}" for key, name in self.defaults.items() if not self.chooses(key)]

    def names(self, names: str, split: str, number: int = 1) -> tuple[str, ...]:
        """The named images of a split, else its first `number`.

        Raises:
            InputError: a name that the split lacks, or fewer images than requested.
        """
        listed = self.dataset.names(split)
        chosen = tuple(split_list(names, "names")) if names else listed[:number]
        for name in chosen:
            if name not in listed:
                near = nearest(name, listed[:20])
                raise InputError(f"names: split '{split}' has no image '{name}'; {near}.")
        if not names and len(chosen) < number:
            raise InputError(f"rows={number}, but split '{split}' has {len(listed)} images.")
        return chosen


def labelled(text: str, what: str) -> dict[str, str]:
    """Label -> place, of ``label:place,label:place``; without a label the place's last name.

    Raises:
        InputError: an empty entry, or a label twice.
    """
    found: dict[str, str] = {}
    for entry in split_list(text, what):
        label, colon, place = entry.partition(":")
        label, place = (label, place) if colon else (Path(entry).name, entry)
        if not label or not place or label in found:
            raise InputError(f"{what}: expected label:place with different labels, got '{entry}'.")
        found[label] = place
    return found


def open_maps(place: str, split: str) -> PixelMaps:
    """A file of pixel maps or a folder of ``rgbt score``; InputError: of another split."""
    maps = PixelMaps.load(_file(place, "maps.npz"))
    _check_split(split, maps.split, place)
    return maps


def open_statistics(
    config: Config, place: str, split: str, *, by_region: bool = False
) -> SpatialStatistics:
    """A file of statistics or a folder of ``rgbt spatial``, or those of the chosen data set.

    Args:
        config: chooses the data set and the regions.
        place: "": measure the data set.
        split: "": that of the file, or train.
        by_region: the figure shows the regions that were measured, so that a ``metric=`` that was
            given must be these. (Heat maps are cut anew.)

    Raises:
        InputError: a file and a data set, or a file of another split or partition than requested.
    """
    if bool(place) == config.chooses("dataset"):
        raise InputError(
            "statistics: expected either statistics=..., the folder that rgbt spatial wrote, or "
            "dataset=... to measure one now."
        )
    if not place:
        split = split or "train"
        settings = MeasurementSettings(regions=config.regions)
        with progress("measuring", len(config.dataset.names(split))) as advance:
            return collect(config.dataset, split, settings, advance)
    path = _file(place, "statistics.npz")
    stored = SpatialStatistics.load(path)
    _check_split(split, stored.split, path)
    if by_region and config.chooses("metric") and config.regions.name != stored.partition:
        raise InputError(
            f"metric: {path} was measured over {stored.partition}, not over {config.regions.name}; "
            "omit metric=, or measure again with rgbt spatial partition=... regions=..."
        )
    return stored


def open_runs(text: str, runs_dir: str, split: str, frames: Frames = "") -> dict[str, list[Counts]]:
    """Label -> counts of its seeds, of ``runs=``; see `analysis.results.open_counts`.

    Raises:
        InputError: no such counts, or methods on different images.
    """
    found: dict[str, list[Counts]] = {}
    for word in split_list(text, "runs"):
        label, colon, place = word.partition(":")
        for each in open_counts(place if colon else word, runs_dir, split, frames):
            found.setdefault(label if colon else each.label, []).append(each.counts)
    check_same_images(found)
    return found


def open_scored(text: str, partition: str) -> dict[str, Counts]:
    """Label -> counts over a partition, of folders of ``rgbt score`` or files.

    Raises:
        InputError: there are none, or of different images.
    """
    places = labelled(text, "methods").items()
    found = {label: Counts.load(_file(each, f"counts_{partition}.npz")) for label, each in places}
    check_same_images({label: [counts] for label, counts in found.items()})
    return found


def check_same_images(methods: Mapping[str, Sequence[Counts]]) -> None:
    """Refuse a figure that would show methods on different images, or with means over different
    classes, side by side.

    Raises:
        InputError: naming the two.
    """
    every = [(label, counts) for label, seeds in methods.items() for counts in seeds]
    (first, reference), *others = every
    for label, counts in others:
        if counts.dataset != reference.dataset or set(counts.names) != set(reference.names):
            raise InputError(
                f"'{first}' was scored on {len(reference.names)} images of split "
                f"'{reference.split}', such as '{reference.names[0]}', but '{label}' on "
                f"{len(counts.names)} of '{counts.split}', such as '{counts.names[0]}'; a figure "
                "shows methods on the same images of one data set."
            )
        check_same_means(reference, counts)


def check_one_dataset(statistics: SpatialStatistics, counts: Counts) -> None:
    """Refuse statistics of one data set beside scores on another; splits may differ."""
    if statistics.fingerprint != counts.dataset:
        raise InputError(
            f"statistics: they are of {statistics.dataset}, split '{statistics.split}', but the "
            f"scores of another data set (images such as '{counts.names[0]}')."
        )


def _check_split(wanted: str, stored: str, source: object) -> None:
    if wanted not in ("", stored):
        raise InputError(f"split={wanted}: {source} has split '{stored}'; omit split=.")


def _file(text: str, name: str) -> Path:
    """A file, or the one called `name` in a folder that the other commands wrote."""
    path = Path(text).expanduser()
    return path / name if path.is_dir() else path
