"""A data set wrapper that applies a corruption to every image."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rgbt.checks import InputError
from rgbt.corruptions.corruption import Corruption, OfPixels, OfTime
from rgbt.dataset import DatasetWrapper, LabelledDataset
from rgbt.randomness import numpy_generator
from rgbt.types import Sample


class CorruptedDataset(DatasetWrapper):
    """`source` under a corruption; a `rgbt.dataset.LabelledDataset`.

    Names, labels and the fingerprint are those of the source: scores refer to the same images.
    Random draws for an image depend only on (seed, image name).

    Args:
        severity: 0 returns the samples of the source.
        split: the split to read, in the order of time.

    Raises:
        InputError: a severity out of range, an unknown or missing split.
    """

    def __init__(
        self,
        source: LabelledDataset,
        corruption: Corruption,
        severity: float,
        *,
        split: str,
        seed: int = 0,
    ) -> None:
        if severity:
            corruption.check(severity)
        super().__init__(source)
        self.corruption = corruption
        self.severity = severity
        self.split = split
        self.seed = seed
        self._names = source.names(split)
        self._shown = self._other_frames()

    def read(self, name: str) -> Sample:
        """The sample called `name` under the corruption; errors are those of `corrupted`."""
        return self.corrupted(name, self.source.read)

    def corrupted(self, name: str, read: Callable[[str], Sample]) -> Sample:
        """The sample called `name` under the corruption.

        Args:
            name: of an image of the split.
            read: name -> sample; for example one that reads no labels.

        Raises:
            InputError: as `read`; images of two sizes where one frame is shown for another; a
                severity that changes nothing of an image of this size.
        """
        sample = read(name)
        if not self.severity:
            return sample
        if isinstance(self.corruption, OfTime):
            other = self.shown(name)
            thermal = sample.thermal if other == name else read(other).thermal
            if thermal.shape != sample.thermal.shape:
                own, its = (
                    f"{each.shape[0]}x{each.shape[1]}" for each in (sample.thermal, thermal)
                )
                raise InputError(
                    f"'{name}' ({own} pixels) cannot show the thermal image of '{other}' ({its} "
                    "pixels). The corruptions frozen and delayed require images of one size in a "
                    "split."
                )
            return replace(sample, thermal=thermal)
        return corrupt(name, sample, self.corruption, self.severity, self.seed)

    def shown(self, name: str) -> str:
        """Name of the frame whose thermal image `name` shows: itself, or an earlier one.

        Raises:
            InputError: the corruption is one of time, and `name` is not of its split.
        """
        if self._shown and name not in self._shown:
            raise InputError(
                f"'{name}' is not in split '{self.split}', whose order determines the thermal "
                "image. Read an image of that split."
            )
        return self._shown.get(name, name)

    def files(self, name: str) -> tuple[Path, ...]:
        """Files of the source for `name`, and for the frame that is shown where it is another."""
        names = dict.fromkeys((name, self.shown(name)))
        return tuple(path for each in names for path in self.source.files(each))

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` returns: those of the source, and the corruption."""
        listed = hashlib.sha256("\n".join(self._names).encode()).hexdigest()
        return {
            **self.source.decoding(),
            "corruption": type(self.corruption).__name__,
            "settings": settings_of(self.corruption),
            "severity": self.severity,
            "seed": self.seed,
            "listed": listed,
        }

    def _other_frames(self) -> dict[str, str]:
        """Name -> name of the frame whose thermal image it shows; {} where time does not matter."""
        if not self.severity or not isinstance(self.corruption, OfTime):
            return {}
        nights = self.source.nights(self._names) or (False,) * len(self._names)
        found: dict[str, str] = {}
        for dark in (False, True):
            frames = [n for n, night in zip(self._names, nights, strict=True) if night == dark]
            for index, name in enumerate(frames):
                found[name] = frames[self.corruption.shown(index, self.severity)]
        return found


def corrupt(name: str, sample: Sample, corruption: OfPixels, severity: float, seed: int) -> Sample:
    """`sample` under a corruption of its pixels; draws depend on seed and name."""

    def rng_of(purpose: str) -> np.random.Generator:
        # This word is part of the seed and must not change.
        return numpy_generator(seed, f"degradation {purpose} of {name}")

    return corruption(sample, severity, rng_of)


def settings_of(corruption: Corruption) -> dict[str, Any]:
    """The settings of a corruption as JSON values, without its severities."""
    known = ("title", "unit", "severities")
    return {key: value for key, value in vars(corruption).items() if key not in known}
