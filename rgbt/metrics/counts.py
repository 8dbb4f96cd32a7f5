"""The counts of a split, from which every score and table can be computed again."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.metrics.archive import Archive
from rgbt.metrics.details import details_of, regions_of
from rgbt.metrics.measurement import CONTROL, Measurement
from rgbt.metrics.metric import Absent, number_of_regions
from rgbt.metrics.names import DAY, NIGHT

# What partition, data set and run are written with.
WORD = re.compile(r"[\w.+-]*")

# More than the pixels of any image, in the units of `rgbt.metrics.details`; sums do not overflow.
MOST = 2**40

# Images, or blocks of neighbouring ones, below which an interval would rest on almost nothing.
FEWEST = 10

MEASUREMENT = "measurement"  # member of a file
ARCHIVE = Archive("rgbt counts 3", "counts", "evaluate the run to write it")


@dataclass(frozen=True, kw_only=True)
class Counts:
    """How often each class was predicted as which, per image and region.

    Attributes:
        counts: (N, R, K, K) int32 or int64, rows = label, columns = prediction. Pairs of frames
            (`rgbt.metrics.pairs`) and details (`rgbt.metrics.details`) have other rows.
        names: of the N images.
        night: whether each image was taken at night; None where the data set does not say.
        unscored: classes that are left out of every mean over classes; their pixels count.
        measurement: what was measured, how and on what.
    """

    counts: NDArray[np.integer]
    names: tuple[str, ...]
    night: tuple[bool, ...] | None
    classes: tuple[str, ...]
    measurement: Measurement
    unscored: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        shape, classes = self.counts.shape, len(self.classes)
        details = details_of(self.partition)
        rows = details.measures(classes) if details else classes
        groups = details.groups if details else 1
        expected = (len(self.names), *shape[1:2], rows, classes)
        if shape != expected or shape[1] % groups or self.counts.dtype.kind not in "iu":
            raise ValueError(
                f"counts: expected integers, N={len(self.names)} x R (a multiple of {groups}) x "
                f"{rows} x K={classes}, got {shape} {self.counts.dtype}."
            )
        if self.night is not None and len(self.night) != len(self.names):
            raise ValueError(f"night: expected {len(self.names)} values, got {len(self.night)}.")
        scored_classes(self.classes, self.unscored)

    @property
    def partition(self) -> str:
        """Return `Measurement.partition`."""
        return self.measurement.partition

    @property
    def dataset(self) -> str:
        """Return `Measurement.dataset`."""
        return self.measurement.dataset

    @property
    def split(self) -> str:
        """Return `Measurement.split`."""
        return self.measurement.split

    @property
    def absent(self) -> Absent:
        """Return `Measurement.absent`."""
        return self.measurement.absent

    @property
    def scored(self) -> NDArray[np.bool_]:
        """Return which classes take part in means over classes, (K,)."""
        return scored_classes(self.classes, self.unscored)

    def labelled(self) -> NDArray[np.int64]:
        """Count the pixels with each label, (N, R, K)."""
        return np.asarray(self.counts.sum(-1, dtype=np.int64))

    def by_region(self) -> NDArray[np.int64]:
        """Add all images, (R, K, K)."""
        return np.asarray(self.counts.sum(0, dtype=np.int64))

    def whole(self) -> NDArray[np.int64]:
        """Add all images and regions, (K, K); the regions cover every pixel once."""
        return np.asarray(self.counts.sum((0, 1), dtype=np.int64))

    def select(self, names: Iterable[str]) -> Counts:
        """Return the counts of images called `names`, in that order; InputError: unknown name."""
        index_of = {name: index for index, name in enumerate(self.names)}
        wanted = tuple(names)
        if missing := set(wanted) - index_of.keys():
            raise InputError(f"'{self.split}': image '{min(missing)}' is not counted.")
        return self._take([index_of[name] for name in wanted])

    def among(self, names: tuple[str, ...], night: tuple[bool, ...] | None) -> Counts:
        """Return the counts of these images, 0 for those that are not counted here.

        `night` says which of `names` were taken at night.
        """
        if self.names == names:
            return self
        index_of = {name: index for index, name in enumerate(names)}
        counts = np.zeros((len(names), *self.counts.shape[1:]), self.counts.dtype)
        counts[[index_of[name] for name in self.names]] = self.counts
        return replace(self, counts=counts, names=names, night=night)

    def added(self, number: int) -> Counts:
        """Add the counts of every `number` neighbours; day and night stay apart.

        Each is named after its first image and the number of the others: "00196D+9". Scores of all
        images stay equal; intervals draw so many images together.
        """
        if number == 1:
            return self
        night = np.array(self.night or np.zeros(len(self.names)), bool)
        kinds = np.flatnonzero(~night), np.flatnonzero(night)
        groups = [kind[at : at + number] for kind in kinds for at in range(0, len(kind), number)]
        firsts = self._take([int(group[0]) for group in groups])
        names = (f"{name}+{len(g) - 1}" for name, g in zip(firsts.names, groups, strict=True))
        sums = [self.counts[group].sum(0, dtype=self.counts.dtype) for group in groups]
        return replace(firsts, counts=np.stack(sums), names=tuple(names))

    def parts(self) -> dict[str, Counts]:
        """Return day and night, if the data set distinguishes them and the split holds both."""
        if self.night is None or len(set(self.night)) < 2:
            return {}
        at_night = np.array(self.night)
        chosen = {DAY: np.flatnonzero(~at_night), NIGHT: np.flatnonzero(at_night)}
        return {part: self._take(indices.tolist()) for part, indices in chosen.items()}

    def save(self, path: Path) -> None:
        """Write one compressed file."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        # npz without pickles knows no None.
        values["night"] = np.array(self.night or (), dtype=bool)
        values["unscored"] = np.array(self.unscored, dtype=str)
        values[MEASUREMENT] = np.array(self.measurement.to_json())
        ARCHIVE.save(path, values)

    @classmethod
    def load(cls, path: Path) -> Counts:
        """Read what `save` wrote; InputError: not a file of counts."""
        return ARCHIVE.load(path, cls._of_arrays)

    @classmethod
    def _of_arrays(cls, arrays: dict[str, NDArray[Any]]) -> Counts:
        given: dict[str, Any] = {MEASUREMENT: Measurement.from_json(str(arrays[MEASUREMENT]))}
        for key in ("names", "classes", "unscored"):
            given[key] = tuple(arrays[key].tolist())
        night = tuple(arrays["night"].astype(bool).tolist()) or None
        found = cls(counts=arrays["counts"], night=night, **given)
        found.check()
        return found

    def check(self) -> None:
        """Refuse what no evaluation writes, but somebody may have stored, by ValueError."""
        details = details_of(self.partition)
        rows = number_of_regions(regions_of(self.partition)) * (details.groups if details else 1)
        if rows and self.counts.shape[1] != rows:
            raise ValueError(f"counts: expected {rows} rows, as {self.partition} has.")
        ends = (self.counts.min(), self.counts.max()) if self.counts.size else (0, 0)
        if ends[0] < 0 or ends[1] > MOST:
            raise ValueError(f"counts: expected numbers of pixels, got {ends[0]} to {ends[1]}.")
        for key in ("partition", "dataset", "run"):
            if not WORD.fullmatch(getattr(self.measurement, key)):
                raise ValueError(f"{key}: expected letters, digits and _.+-.")
        for key, texts in (("names", self.names), ("classes", self.classes)):
            if len(set(texts)) < len(texts) or any(map(CONTROL.search, texts)):
                raise ValueError(f"{key}: expected different texts without control characters.")

    def _take(self, indices: list[int]) -> Counts:
        names = tuple(self.names[index] for index in indices)
        night = self.night and tuple(self.night[index] for index in indices)
        return replace(self, counts=self.counts[indices], names=names, night=night)


def scored_classes(classes: Sequence[str], unscored: Collection[str]) -> NDArray[np.bool_]:
    """Return which classes are in means, (K,); ValueError: none, or `unscored` names no class."""
    scored = np.array([name not in unscored for name in classes], bool)
    if set(unscored) - set(classes) or not scored.any():
        names = ", ".join(classes), ", ".join(unscored)
        raise ValueError(f"unscored: expected some, not all, of {names[0]}, got {names[1]}.")
    return scored


def check_same_means(first: Counts, other: Counts) -> None:
    """Refuse to compare counts whose means are over different classes, by InputError."""
    if set(first.unscored) != set(other.unscored):
        left_out, others = (", ".join(counts.unscored) or "no class" for counts in (first, other))
        raise InputError(
            f"counts whose means leave out {left_out} cannot be compared with those that leave "
            f"out {others}. Evaluate both with the same dataset.unscored."
        )


def convention(every: Iterable[Counts]) -> Absent:
    """Return the convention for absent classes of all counts; InputError: made with both."""
    found = {counts.absent for counts in every}
    if len(found) > 1:
        raise InputError(
            "absent: the counts use both conventions. Choose absent=released or absent=exclude."
        )
    return found.pop()


def read_measurement(path: Path) -> Measurement:
    """Read what a file of counts is of, without the counts; InputError: as `Counts.load`."""
    return ARCHIVE.read_text(path, MEASUREMENT, Measurement.from_json)
