"""A data set seen under a degradation, so that everything which reads one runs unchanged."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.corruptions.corruption import Degradation, OfTime
from rgbt.randomness import numpy_generator
from rgbt.requirements import Record, record_of
from rgbt.types import Sample


class Source(Protocol):
    """The data set that is degraded (see `rgbt.data.dataset.LabelledDataset`)."""

    root: Path
    name: str
    num_classes: int
    classes: tuple[str, ...]
    palette: tuple[tuple[int, int, int], ...]
    unscored: tuple[str, ...]

    @property
    def splits(self) -> Mapping[str, str]:
        """Split -> what it is made of."""
        ...

    def has(self, split: str) -> bool:
        """Whether anything of `split` is there."""
        ...

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, in order."""
        ...

    def read(self, name: str) -> Sample:
        """One sample."""
        ...

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label alone."""
        ...

    def files(self, name: str) -> tuple[Path, ...]:
        """Every file that `read` opens."""
        ...

    def decoding(self) -> dict[str, Any]:
        """What decides, beside the files, what `read` makes of them."""
        ...

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether each image was taken at night."""
        ...

    def fingerprint(self) -> str:
        """Hash of names and files."""
        ...


class Degraded:
    """`source` under a degradation; it is a `rgbt.data.dataset.LabelledDataset` itself.

    Names, labels and the fingerprint are those of the source: scores are of the same images. What
    is drawn for an image follows from (seed, its name) alone, whatever is read before it.

    Args:
        source: the data set.
        degradation: what fails.
        severity: how much; 0: nothing, samples are those of the source.
        split: that is read; its order is the order of time.
        seed: of what is drawn.

    Raises:
        InputError: a severity out of range, an unknown or missing split.
    """

    def __init__(
        self,
        source: Source,
        degradation: Degradation,
        severity: float,
        *,
        split: str,
        seed: int = 0,
    ) -> None:
        if severity:
            degradation.check(severity)
        self.source = source
        self.degradation = degradation
        self.severity = severity
        self.split = split
        self.seed = seed
        self.root = source.root
        self.name = source.name
        self.num_classes = source.num_classes
        self.classes = source.classes
        self.palette = source.palette
        self.unscored = source.unscored
        self._names = source.names(split)
        self._shown = self._other_frames()

    @property
    def record(self) -> Record:
        """That of the source."""
        return record_of(self.source)

    @property
    def splits(self) -> Mapping[str, str]:
        """Those of the source."""
        return self.source.splits

    def has(self, split: str) -> bool:
        """Whether the source has anything of `split`."""
        return self.source.has(split)

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split of the source."""
        return self.source.names(split)

    def read(self, name: str) -> Sample:
        """The sample called `name` under the degradation.

        Raises:
            InputError: as the source; images of two sizes where one frame is shown for another; a
                severity that changes nothing of an image of this size.
        """
        sample = self.source.read(name)
        if not self.severity:
            return sample
        if isinstance(self.degradation, OfTime):
            return self._with_thermal_of(self.shown(name), sample)

        def rng_of(purpose: str) -> np.random.Generator:
            return numpy_generator(self.seed, f"degradation {purpose} of {name}")

        return self.degradation(sample, self.severity, rng_of)

    def shown(self, name: str) -> str:
        """Name of the frame whose thermal image `name` shows: itself, or an earlier one.

        Raises:
            InputError: the degradation is one of time, and `name` is not of its split.
        """
        if self._shown and name not in self._shown:
            raise InputError(
                f"'{name}' is not of split '{self.split}', whose order says which thermal image is "
                "shown; read the split that was degraded."
            )
        return self._shown.get(name, name)

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of the source."""
        return self.source.label(name)

    def files(self, name: str) -> tuple[Path, ...]:
        """Files of the source for `name`, and for the frame that is shown where it is another."""
        names = dict.fromkeys((name, self.shown(name)))
        return tuple(path for each in names for path in self.source.files(each))

    def decoding(self) -> dict[str, Any]:
        """What decides what `read` makes of files: as the source's, and the degradation."""
        listed = hashlib.sha256("\n".join(self._names).encode()).hexdigest()
        return {
            **self.source.decoding(),
            "degradation": type(self.degradation).__name__,
            "settings": settings_of(self.degradation),
            "severity": self.severity,
            "seed": self.seed,
            "listed": listed,
        }

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether each image was taken at night, as the source says."""
        return self.source.nights(names)

    def fingerprint(self) -> str:
        """That of the source."""
        return self.source.fingerprint()

    def _other_frames(self) -> dict[str, str]:
        """Name -> name of the frame whose thermal image it shows; {} where time does not matter."""
        if not self.severity or not isinstance(self.degradation, OfTime):
            return {}
        nights = self.source.nights(self._names) or (False,) * len(self._names)
        found: dict[str, str] = {}
        for dark in (False, True):
            frames = [n for n, night in zip(self._names, nights, strict=True) if night == dark]
            for place, name in enumerate(frames):
                found[name] = frames[self.degradation.shown(place, self.severity)]
        return found

    def _with_thermal_of(self, other: str, sample: Sample) -> Sample:
        if other == sample.name:
            return sample
        thermal = self.source.read(other).thermal
        if thermal.shape != sample.thermal.shape:
            sizes = [f"{image.shape[0]}x{image.shape[1]}" for image in (sample.thermal, thermal)]
            raise InputError(
                f"'{sample.name}' ({sizes[0]} pixels) cannot show the thermal image of '{other}' "
                f"({sizes[1]} pixels); images of one split must have one size for frozen and "
                "delayed."
            )
        return replace(sample, thermal=thermal)


def settings_of(degradation: Degradation) -> dict[str, Any]:
    """What a degradation was built with, as values of JSON; the ladder is no part of it."""
    known = ("title", "unit", "severities")
    return {key: value for key, value in vars(degradation).items() if key not in known}
