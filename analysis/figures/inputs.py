"""All figures by name, their options, and the files that these name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from functools import cached_property
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_type_hints

import pandas as pd
from annotated_types import Interval
from matplotlib.figure import Figure

from analysis.commands import MOST, dataset_of
from analysis.results import Frames, Levels, open_counts, trainings
from analysis.statistics.collect import SpatialStatistics, collect
from analysis.uncertainty.same_images import in_order
from rgbt.checks import InputError, nearest, split_list
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.overrides import built
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Regions
from rgbt.terminal import counting, warn

if TYPE_CHECKING:
    from rgbt.dataset import LabelledDataset

# A figure, and the numbers that it shows.
Drawn = tuple[Figure, pd.DataFrame]

Make = TypeVar("Make", bound=Callable[..., Drawn])

Count = Annotated[int, Interval(ge=1, le=MOST)]
Split = Annotated[
    str, Help("split of the data set or the runs (default: test; of statistics: train)")
]
Part = Annotated[Literal["all", "day", "night"], Help("images: all, day or night")]
Names = Annotated[str, Help("names of the images to show, separated by commas")]
Methods = Annotated[
    str, Help("label:folder,label:folder: output of rgbt score, or predicted label images")
]
AbsentClasses = Annotated[
    Literal["released", "exclude"] | None,
    Help("class without pixels: released: 0; exclude: in no mean; default: as the counts say"),
]


@dataclass(frozen=True)
class FigureSpec:
    """One figure.

    `make` takes a `Config` called `config`, dataclasses of options, and further options as
    keywords, as far as it has these parameters. `groups` of the configuration take effect; `metric`
    is the partition unless ``metric=`` is given.
    """

    make: Callable[..., Drawn]
    shows: str
    groups: tuple[str, ...]
    metric: str

    @cached_property
    def options(self) -> type[Any]:
        """The dataclass of all options, by the signature of the function."""
        hints = get_type_hints(self.make, include_extras=True)
        own: list[tuple[str, Any, Any]] = []
        bases: list[type] = []
        for parameter in signature(self.make).parameters.values():
            name = parameter.name
            if parameter.kind is Parameter.KEYWORD_ONLY:
                default = MISSING if parameter.default is Parameter.empty else parameter.default
                own.append((name, hints[name], default))
            elif name != "config":
                bases.append(hints[name])
        return make_dataclass("Options", own, bases=tuple(bases), frozen=True, kw_only=True)

    @property
    def words(self) -> list[str]:
        """Names of the options; those without a default are followed by "=..."."""
        found = []
        for option in fields(self.options):
            found.append(f"{option.name}=..." if option.default is MISSING else option.name)
        return found

    def __call__(self, config: Config, values: Mapping[str, Any]) -> Drawn:
        """Draw with the values of options that were given; InputError where one is missing."""
        for word in self.words:
            if word.endswith("=...") and word[:-4] not in values:
                raise InputError(f"the figure needs {word}")
        given = self.options(**values)
        arguments: dict[str, Any] = {}
        for name, parameter in signature(self.make).parameters.items():
            if parameter.kind is Parameter.KEYWORD_ONLY:
                arguments[name] = getattr(given, name)
            else:
                arguments[name] = config if name == "config" else given
        return self.make(**arguments)


FIGURES: dict[str, FigureSpec] = {}


def figure(name: str, shows: str, *groups: str, metric: str = "ring5") -> Callable[[Make], Make]:
    """Register a function as a figure, as a decorator; see `FigureSpec`."""

    def register(make: Make) -> Make:
        FIGURES[name] = FigureSpec(make, shows, groups, metric)
        return make

    return register


@dataclass(frozen=True)
class Config:
    """What overrides such as ``dataset=mfnet`` and ``metric=ring9`` choose, built when needed."""

    overrides: Sequence[str] = ()
    defaults: Mapping[str, str] = field(default_factory=dict)

    def chooses(self, group: str) -> bool:
        """Say whether a file of the group was chosen."""
        return any(word.lstrip("+~").startswith(f"{group}=") for word in self.overrides)

    def built(self, node: str, *more: str) -> Any:
        """Build the object of one node of the configuration."""
        usual = [f"{key}={name}" for key, name in self.defaults.items() if not self.chooses(key)]
        return built(node, [*usual, *self.overrides, *more])

    @cached_property
    def dataset(self) -> LabelledDataset:
        """The data set; InputError where none was chosen."""
        return dataset_of(self.overrides)

    @cached_property
    def regions(self) -> Regions:
        """The partition of the image."""
        regions: Regions = self.built("metric")
        return regions

    def names(self, names: str, split: str, number: int = 1) -> list[str]:
        """Return the named images of a split, else its first `number`; see `chosen_names`."""
        return chosen_names(names, self.dataset.names(split or "test"), number)


@dataclass(frozen=True, kw_only=True)
class StatisticsOptions:
    """Statistics of a data set, stored or measured now."""

    statistics: Annotated[
        str,
        Help("output of rgbt spatial: folder or statistics.npz; or dataset=... to measure it now"),
    ] = ""
    split: Split = ""

    def open(self, config: Config, *, by_region: bool = False) -> SpatialStatistics:
        """Load the statistics, or measure them.

        Raises:
            InputError: a file and a data set, or a file of another split than requested; or,
                `by_region`, of other regions than requested. (Heat maps are cut anew.)
        """
        if bool(self.statistics) == config.chooses("dataset"):
            raise InputError(
                "statistics: expected either statistics=..., the folder that rgbt spatial wrote, "
                "or dataset=... to measure one now."
            )
        if not self.statistics:
            split = self.split or "train"
            with counting("measuring", len(config.dataset.names(split))) as advance:
                return collect(config.dataset, split, config.regions, advance=advance)
        path = file_in(self.statistics, "statistics.npz")
        stored = SpatialStatistics.load(path)
        check_split(self.split, stored.split, path)
        if by_region and config.chooses("metric") and config.regions.name != stored.partition:
            raise InputError(f"metric: {path} was measured over {stored.partition}.")
        return stored


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Counts of runs."""

    runs: Annotated[
        str,
        Help(
            "runs, groups or files of counts, separated by commas; label:run,label:run sets their "
            "labels; entries with the same label are seeds of one method"
        ),
    ]
    runs_dir: RunsDir = Path("runs")
    split: Split = ""
    absent: AbsentClasses = None

    def counts(self, frames: Frames = "") -> dict[str, list[Counts]]:
        """Open the counts of the seeds of each method, by its label."""
        found: dict[str, list[Counts]] = {}
        for label, word in self.entries():
            for opened in open_counts(word, self.runs_dir, self.split, frames):
                found.setdefault(label or opened.label, []).append(opened.counts)
        return found

    def trainings(self) -> dict[str, list[Levels]]:
        """Open what rgbt robustness measured of the seeds of each method, by its label."""
        found: dict[str, list[Levels]] = {}
        for label, word in self.entries():
            for own_label, levels in trainings(word, self.runs_dir, self.split):
                found.setdefault(label or own_label, []).append(levels)
        return found

    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield the label ("": its own) and the name of each entry."""
        for word in split_list(self.runs, "runs"):
            label, colon, place = word.partition(":")
            yield (label, place) if colon else ("", word)


def chosen_names(names: str, known: Sequence[str], number: int) -> list[str]:
    """Return the names of a list with commas, else the first `number` of those that are known.

    Raises:
        InputError: an unknown name, or fewer images than requested.
    """
    chosen = split_list(names, "names") if names else [*known[:number]]
    for name in chosen:
        if name not in known:
            raise InputError(f"names: there is no image '{name}'; {nearest(name, known[:20])}.")
    if not names and len(chosen) < number:
        raise InputError(f"rows={number}, but there are {len(known)} images.")
    return chosen


def labelled(text: str) -> dict[str, Path]:
    """Read ``label:place,label:place``; InputError: an empty entry, or a label twice."""
    found: dict[str, Path] = {}
    for entry in split_list(text, "methods"):
        label, colon, place = entry.partition(":")
        label, place = (label, place) if colon else (Path(entry).name, entry)
        if not label or not place or label in found:
            raise InputError(f"methods: expected different label:folder, got '{entry}'.")
        found[label] = Path(place).expanduser()
    return found


def open_scored(methods: str, partition: str) -> dict[str, Counts]:
    """Load counts over a partition by label, of folders of ``rgbt score`` or files.

    Raises:
        InputError: there are none, or of different images.
    """
    found = {}
    for label, place in labelled(methods).items():
        found[label] = Counts.load(file_in(place, f"counts_{partition}.npz"))
    check_same_images(found.values())
    return found


def check_same_images(every: Iterable[Counts], *, alike: bool = True) -> Counts:
    """Return the first counts; InputError: others on other images, by other classes or regions.

    With `alike`, a warning says what differs between the measurements beside the networks.
    """
    reference, *others = every
    unlike: dict[str, None] = {}
    for other in others:
        if other.dataset != reference.dataset:
            raise InputError("a figure shows methods on the images of one data set.")
        in_order(reference, other, "names")
        unlike |= dict.fromkeys(reference.measurement.unlike(other.measurement))
    if alike and unlike:
        warn(f"what the figure shows is measured differently ({'; '.join(unlike)}).")
    return reference


def check_one_dataset(statistics: SpatialStatistics, counts: Counts) -> None:
    """Refuse statistics of one data set beside scores on another; splits may differ."""
    if statistics.fingerprint != counts.dataset:
        raise InputError(
            f"statistics: they are of {statistics.dataset}, split '{statistics.split}', but the "
            f"scores of another data set (images such as '{counts.names[0]}')."
        )


def check_split(wanted: str, stored: str, source: object) -> None:
    """Refuse a file of another split than the one that is named."""
    if wanted not in ("", stored):
        raise InputError(f"split={wanted}: {source} has split '{stored}'; omit split=.")


def file_in(place: Path | str, name: str) -> Path:
    """Return the path of a file, or of `name` in a folder that the other commands wrote."""
    path = Path(place).expanduser()
    return path / name if path.is_dir() else path
