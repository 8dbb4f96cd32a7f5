"""The counts of a split, from which every score and table can be computed again."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, nearest
from rgbt.metrics.archive import Archive
from rgbt.metrics.details import details_of
from rgbt.metrics.metric import Absent
from rgbt.metrics.names import DAY, NIGHT

ARCHIVE = Archive("rgbt counts 2", "counts", "evaluate the run to write it")


@dataclass(frozen=True, kw_only=True)
class Counts:
    """How often each class was predicted as which, per image and region.

    Attributes:
        counts: (N, R, K, K) int32 or int64, rows = label, columns = prediction. Of pairs of frames
            they hold something else: see `rgbt.metrics.pairs`; and so do those of boundaries,
            calibration, distance and size, (N, R G, M, K): see `rgbt.metrics.details`.
        names: names of the N images.
        night: whether each image was taken at night; None where the data set does not say.
        classes: names of the K classes.
        partition: name of the regions, e.g. "ring5" (`rgbt.metrics.metric.Regions.name`); of pairs
            of frames protocol and number of sets, e.g. "aligned3"; of details their kind and
            setting too, e.g. "ring5-boundary-0.02".
        dataset: fingerprint of the data set.
        unscored: names of the classes that are left out of every mean over classes. Their pixels
            count as all others do: what is labelled so and predicted as another class is a false
            positive of that class, and the other way round a miss.
        absent: convention for absent classes (`rgbt.metrics.scores`) of the evaluation that counted
            them; scores that are derived later follow it unless another one is requested.
        run: key of the run whose network predicted; "" for others.

    Raises:
        ValueError: the sizes do not agree, `unscored` names no class or all of them, or there is
            no such convention.
    """

    counts: NDArray[np.integer]
    names: tuple[str, ...]
    night: tuple[bool, ...] | None
    classes: tuple[str, ...]
    partition: str
    dataset: str
    split: str
    unscored: tuple[str, ...] = ()
    absent: Absent = "released"
    run: str = ""

    def __post_init__(self) -> None:
        shape = self.counts.shape
        classes = len(self.classes)
        details = details_of(self.partition)
        rows = classes if details is None else details.measures(classes)
        groups = 1 if details is None else details.groups
        expected = (len(self.names), *shape[1:2], rows, classes)
        if shape != expected or shape[1] % groups or self.counts.dtype.kind not in "iu":
            raise ValueError(
                f"counts: expected integers, N={len(self.names)} x R (a multiple of {groups}) x "
                f"{rows} x K={classes}, got {shape} {self.counts.dtype}."
            )
        if self.night is not None and len(self.night) != len(self.names):
            raise ValueError(f"night: expected {len(self.names)} values, got {len(self.night)}.")
        scored_classes(self.classes, self.unscored)
        if self.absent not in get_args(Absent):
            raise ValueError(f"absent: expected released or exclude, got '{self.absent}'.")

    @property
    def scored(self) -> NDArray[np.bool_]:
        """(K,): which classes take part in means over classes."""
        return scored_classes(self.classes, self.unscored)

    def by_region(self) -> NDArray[np.int64]:
        """(R, K, K): all images together."""
        summed: NDArray[np.int64] = self.counts.sum(0, dtype=np.int64)
        return summed

    def whole(self) -> NDArray[np.int64]:
        """(K, K): all images, whole image (the regions cover every pixel once)."""
        summed: NDArray[np.int64] = self.counts.sum((0, 1), dtype=np.int64)
        return summed

    def select(self, names: Iterable[str]) -> Counts:
        """The counts of the images called `names`, in that order.

        Raises:
            InputError: a name that is not among the counted images.
        """
        index_of = {name: index for index, name in enumerate(self.names)}
        wanted = tuple(names)
        if missing := [name for name in wanted if name not in index_of]:
            raise InputError(
                f"image '{missing[0]}' is not among the {len(self.names)} counted images of split "
                f"'{self.split}'; {nearest(missing[0], self.names[:20])}."
            )
        return self._take([index_of[name] for name in wanted])

    def parts(self) -> dict[str, Counts]:
        """Day and night, if the data set distinguishes them and the split holds both."""
        if self.night is None or len(set(self.night)) < 2:
            return {}
        at_night = np.array(self.night)
        chosen = {DAY: np.flatnonzero(~at_night), NIGHT: np.flatnonzero(at_night)}
        return {part: self._take(indices.tolist()) for part, indices in chosen.items()}

    def save(self, path: Path) -> None:
        """Write one compressed file."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        # Missing is stored as no value at all: npz without pickles knows no None.
        values["night"] = np.array(self.night if self.night is not None else (), dtype=bool)
        values["unscored"] = np.array(self.unscored, dtype=str)
        ARCHIVE.save(path, values)

    @classmethod
    def load(cls, path: Path) -> Counts:
        """Read what `save` wrote.

        Raises:
            InputError: no such file, or not a file of counts.
        """
        return ARCHIVE.load(path, cls._of_arrays)

    @classmethod
    def _of_arrays(cls, arrays: dict[str, NDArray[Any]]) -> Counts:
        lists = {key: tuple(arrays[key].tolist()) for key in ("names", "classes", "unscored")}
        texts = {
            key: str(arrays[key]) for key in ("partition", "dataset", "split", "absent", "run")
        }
        night = tuple(arrays["night"].astype(bool).tolist()) or None
        given: dict[str, Any] = {**lists, **texts}
        return cls(counts=arrays["counts"], night=night, **given)

    def _take(self, indices: list[int]) -> Counts:
        night = None if self.night is None else tuple(self.night[index] for index in indices)
        names = tuple(self.names[index] for index in indices)
        return replace(self, counts=self.counts[indices], names=names, night=night)


def scored_classes(classes: Sequence[str], unscored: Collection[str]) -> NDArray[np.bool_]:
    """(K,) bool: which classes take part in means over classes, at least one.

    Raises:
        ValueError: `unscored` names what is no class, or every class.
    """
    unknown = [name for name in unscored if name not in classes]
    scored = np.array([name not in unscored for name in classes], bool)
    if unknown or not scored.any():
        raise ValueError(
            f"unscored: expected some, but not all, of the classes {', '.join(classes)}, got "
            f"{', '.join(unscored)}."
        )
    return scored


def check_same_means(first: Counts, other: Counts) -> None:
    """Refuse to compare counts whose means are over different classes.

    Raises:
        InputError: they leave different classes out.
    """
    if set(first.unscored) == set(other.unscored):
        return
    left_out = [", ".join(each.unscored) or "no class" for each in (first, other)]
    raise InputError(
        f"counts whose means leave out {left_out[0]} cannot be compared with counts whose means "
        f"leave out {left_out[1]}. Evaluate both with the same dataset.unscored."
    )


def convention(every: Iterable[Counts]) -> Absent:
    """The convention for absent classes that all counts were made with.

    Raises:
        InputError: they were made with both.
    """
    found = {counts.absent for counts in every}
    if len(found) > 1:
        raise InputError(
            "the counts use different conventions for absent classes (released: they score 0; "
            "exclude: they are left out of means). Choose absent=released or absent=exclude."
        )
    return found.pop()
