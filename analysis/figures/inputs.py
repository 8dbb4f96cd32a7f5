"""The inputs of a figure from the command line, opened when the figure needs them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from analysis.bar import progress
from rgbt.checks import InputError, nearest, split_list
from rgbt.config.command import built

if TYPE_CHECKING:  # the list of figures is there at once
    from analysis.predictions.maps import PixelMaps
    from analysis.results import Frames, NamedCounts
    from analysis.robustness import Training
    from analysis.statistics.data import SpatialStatistics
    from rgbt.dataset import LabelledDataset
    from rgbt.metrics.counts import Counts
    from rgbt.metrics.metric import Absent, Regions

T = TypeVar("T")
Labelled = TypeVar("Labelled", "NamedCounts", "Training")


@dataclass(frozen=True)
class FigureInput:
    """The arguments of one figure.

    Attributes:
        values: options that were given, by key.
        overrides: of the configuration: ``dataset=...``, ``metric=...``.
        metric: the partition where no ``metric=`` is given, a file of ``conf/metric/``.
    """

    figure: str
    values: Mapping[str, Any]
    overrides: tuple[str, ...]
    metric: str

    def need(self, key: str, what: str) -> Any:
        """The value of a key; without one, an InputError that describes the key by `what`."""
        if key not in self.values:
            raise InputError(f"figure={self.figure} needs {key}=..., {what}.")
        return self.values[key]

    def get(self, key: str, default: T) -> T:
        """The value of a key, or `default`."""
        return cast(T, self.values.get(key, default))

    def absent(self, every: Iterable[Counts]) -> Absent:
        """The convention for absent classes of ``absent=``; without it that of the counts.

        Raises:
            InputError: counts made with both.
        """
        from rgbt.metrics.counts import convention

        return cast(
            "Absent", self.values["absent"] if "absent" in self.values else convention(every)
        )

    def named(self, key: str, what: str) -> dict[str, str]:
        """Label -> place, of ``label:place,label:place``; without a label the place's last name.

        Raises:
            InputError: not given, an empty entry, or a label twice.
        """
        found: dict[str, str] = {}
        for entry in split_list(self.need(key, what), what):
            label, colon, place = entry.partition(":")
            place = place if colon else label
            label = label if colon else Path(place).name
            if not label or not place:
                raise InputError(f"{key}={self.values[key]}: expected label:place, got '{entry}'.")
            if label in found:
                raise InputError(f"{key}: two entries are called '{label}'; give other labels.")
            found[label] = place
        return found

    @property
    def has_dataset(self) -> bool:
        """Whether a data set was chosen."""
        return any(word.startswith("dataset=") for word in self.overrides)

    @cached_property
    def dataset(self) -> LabelledDataset:
        """The data set; InputError where none was chosen."""
        if not self.has_dataset:
            raise InputError(
                f"figure={self.figure} needs dataset=..., for example dataset=mfnet "
                "dataset.root=/data/MFNet."
            )
        made: LabelledDataset = self._built("dataset")
        return made

    @cached_property
    def regions(self) -> Regions:
        """The partition: of the figure unless another one was given."""
        made: Regions = self._built("metric")
        return made

    @cached_property
    def consistency(self) -> Any:
        """The virtual views (`rgbt.transforms.views.ViewSets`): published unless given."""
        return self._built("consistency")

    def _built(self, node: str) -> Any:
        usual = {"metric": self.metric, "consistency": "views"}
        given = {word.partition("=")[0] for word in self.overrides}
        words = [f"{group}={name}" for group, name in usual.items() if group not in given]
        return built(node, [*words, *self.overrides])

    def names(self, number: int) -> tuple[str, ...]:
        """The images of ``names=``, or the first `number` of the split.

        Raises:
            InputError: a name that the split lacks, or fewer images than requested.
        """
        split = self.get("split", "test")
        listed = self.dataset.names(split)
        if "names" not in self.values:
            if len(listed) < number:
                raise InputError(f"rows={number}, but split '{split}' has {len(listed)} images.")
            return listed[:number]
        chosen = tuple(split_list(self.values["names"], "names of images"))
        for name in chosen:
            if name not in listed:
                near = nearest(name, listed[:20])
                raise InputError(f"names: split '{split}' has no image '{name}'; {near}.")
        return chosen

    def name(self) -> str:
        """The one image of ``names=``, or the first of the split; InputError for several."""
        names = self.names(1)
        if len(names) > 1:
            raise InputError(f"names: figure={self.figure} shows one image, got {len(names)}.")
        return names[0]

    def refuse(self, keys: Sequence[str], without: str) -> None:
        """Refuse keys that have an effect only together with a missing option.

        Raises:
            InputError: one of `keys` was given; `without` says what is missing.
        """
        words = [word.lstrip("+~").partition("=")[0] for word in self.overrides]
        for key in keys:
            if key in self.values or key in words:
                raise InputError(
                    f"'{key}' has no effect on figure={self.figure} without {without}; omit it, "
                    "or give both."
                )

    def check_split(self, stored: str, source: object) -> None:
        """Refuse a ``split=`` that is not the `stored` one of an opened file, `source`."""
        if self.get("split", stored) != stored:
            raise InputError(
                f"split={self.values['split']}: {source} has split '{stored}'; omit split=, "
                "or give a file of that split."
            )

    def maps(self) -> PixelMaps:
        """The pixel maps of ``maps=``, a file or a folder of `analysis.score`."""
        from analysis.predictions.maps import PixelMaps

        what = "the folder (or its maps.npz) that rgbt score wrote"
        return PixelMaps.load(_file(self.need("maps", what), "maps.npz"))

    def statistics(self, *, by_region: bool = False) -> SpatialStatistics:
        """Those of ``statistics=``, a file or a folder of `analysis.spatial`, or of ``dataset=``.

        Args:
            by_region: the figure shows the regions that were measured, so that a ``metric=`` that
                was given must be these. (Heat maps are cut anew.)

        Raises:
            InputError: neither or both were given, or a stored file of another split or partition
                than requested.
        """
        from analysis.statistics.collect import MeasurementSettings, collect
        from analysis.statistics.data import SpatialStatistics

        if ("statistics" in self.values) == self.has_dataset:
            raise InputError(
                f"figure={self.figure} needs statistics=..., the folder that rgbt spatial "
                "wrote, or dataset=... to measure one now (not both)."
            )
        if self.has_dataset:
            split = self.get("split", "train")
            settings = MeasurementSettings(regions=self.regions)
            with progress("measuring", len(self.dataset.names(split))) as advance:
                return collect(self.dataset, split, settings, advance)
        path = _file(self.values["statistics"], "statistics.npz")
        stored = SpatialStatistics.load(path)
        self.check_split(stored.split, path)
        has_metric = any(word.lstrip("+~").startswith("metric") for word in self.overrides)
        if by_region and has_metric and self.regions.name != stored.partition:
            raise InputError(
                f"metric: {path} was measured over {stored.partition}, not over "
                f"{self.regions.name}; omit metric=, or measure again with "
                "rgbt spatial partition=... regions=..."
            )
        return stored

    def runs(self, frames: Frames = "") -> dict[str, list[Counts]]:
        """Label -> counts of its seeds, of ``runs=``; entries with one label are one method's.

        Args:
            frames: see `analysis.results.open_counts`.

        Raises:
            InputError: not given, no such counts, or methods on different images.
        """
        from analysis.results import open_counts

        what = "runs, groups or files of counts, with commas; label:run names one"
        opened = self.opened_runs(what, partial(open_counts, frames=frames))
        found = {label: [named.counts for named in each] for label, each in opened.items()}
        check_same_images(found)
        return found

    def opened_runs(
        self, what: str, open_runs: Callable[[str, Path, str], Iterable[Labelled]]
    ) -> dict[str, list[Labelled]]:
        """Label -> what `open_runs` gives for (run, folder of runs, split), of ``runs=``."""
        runs_dir, split = _path(self.get("runs_dir", "runs")), self.get("split", "")
        found: dict[str, list[Labelled]] = {}
        for word in split_list(self.need("runs", what), what):
            label, colon, path = word.partition(":")
            for each in open_runs(path if colon else label, runs_dir, split):
                found.setdefault(label if colon else each.label, []).append(each)
        return found

    def counts(self, key: str, partition: str) -> dict[str, Counts]:
        """Label -> counts over a partition, of the folders or files that `key` names.

        Raises:
            InputError: there are none, or of different images.
        """
        from rgbt.metrics.counts import Counts

        found = {}
        what = "label:folder of what rgbt score wrote, with commas between methods"
        for label, text in self.named(key, what).items():
            place, path = _path(text), _file(text, f"counts_{partition}.npz")
            if place.is_dir() and not path.is_file():
                files = sorted(each.name for each in place.glob("counts*.npz"))
                raise InputError(
                    f"{place} does not contain {path.name} "
                    f"(it contains {', '.join(files) or 'no counts'}); "
                    "score the predictions over that partition with rgbt score."
                )
            found[label] = Counts.load(path)
        check_same_images({label: [counts] for label, counts in found.items()})
        return found


def check_same_images(methods: Mapping[str, Sequence[Counts]]) -> None:
    """Refuse a figure that would show methods on different images, or with means over different
    classes, side by side.

    Raises:
        InputError: naming the two.
    """
    from rgbt.metrics.counts import check_same_means

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
            f"the statistics are of {statistics.dataset}, split '{statistics.split}', and the "
            f"scores of another data set (images such as '{counts.names[0]}'); measure the data "
            "set that was scored."
        )


def _file(text: str, name: str) -> Path:
    """A file, or the one called `name` in a folder that the other commands wrote."""
    path = _path(text)
    return path / name if path.is_dir() else path


def _path(text: str) -> Path:
    return Path(text).expanduser()
