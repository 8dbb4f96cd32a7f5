"""Statistics of a split by region: what is measured once, and the file that holds it.

Letters: ``N`` images, ``R`` regions, ``K`` classes, ``P`` parts, ``H W`` pixels; the axis of length
2 is the modality (`MODALITIES`). What is computed from them is in `derive`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice
from rgbt.metrics.archive import Archive
from rgbt.metrics.names import DAY, NIGHT

MODALITIES = ("rgb", "thermal")
"""Order of the modality axis. RGB is measured as grey (ITU-R BT.601), rounded to 8 bits."""

ALL = "all"
NOISE = "noise/"
"""Beginning of the keys under which a file holds the noise, by estimator."""

ARRAYS = ("palette", "region_map", "labels", "ignored", "occupied", "laplacian", "mean")
TEXTS = ("dataset", "fingerprint", "split", "partition", "kernel")
LISTS = ("classes", "background", "names", "parts")

ARCHIVE = Archive(
    "rgbt spatial statistics 2",
    "statistics",
    "write it with rgbt spatial dataset=... out=...",
)


@dataclass(frozen=True, kw_only=True)
class SpatialStatistics:
    """Measurements of every image of a split, by region.

    Attributes:
        classes: names of the K classes.
        background: those that are no object, see `rgbt.dataset.LabelledDataset`.
        palette: (K, 3) uint8, red, green, blue.
        partition: name of the regions, e.g. "ring9" (`rgbt.metrics.metric.Regions.name`).
        region_map: (H, W) uint8, region index 0..R-1 of every pixel.
        kernel: of the Laplacian, "four" or "eight" neighbours.
        names: names of the N images.
        night: (N,) bool, taken at night; None where the data set does not say.
        labels: (N, R, K) int64, pixels of each class.
        ignored: (N, R) int64, pixels whose label is 255.
        parts: first axis of `occupied`: ("day", "night"), or ("all",) where `night` is None.
        occupied: (P, K, H, W) int32, images of the part that have class k at the pixel.
        laplacian: (N, 2, R) float64, variance of the Laplacian (Eq. 3), squared grey levels.
        mean: (N, 2, R) float64, mean pixel value, grey levels 0..255.
        noise: estimator -> (N, 2, R) float64, standard deviation of the noise, grey levels; NaN
            where a region holds no window of the estimator.

    Raises:
        ValueError: the sizes do not agree.
    """

    dataset: str
    fingerprint: str
    split: str
    classes: tuple[str, ...]
    background: tuple[str, ...]
    palette: NDArray[np.uint8]
    partition: str
    region_map: NDArray[np.uint8]
    kernel: str
    names: tuple[str, ...]
    night: NDArray[np.bool_] | None
    labels: NDArray[np.int64]
    ignored: NDArray[np.int64]
    parts: tuple[str, ...]
    occupied: NDArray[np.int32]
    laplacian: NDArray[np.float64]
    mean: NDArray[np.float64]
    noise: dict[str, NDArray[np.float64]]

    def __post_init__(self) -> None:
        images, regions, classes = len(self.names), self.num_regions, len(self.classes)
        by_modality = (images, len(MODALITIES), regions)
        expected: dict[str, tuple[tuple[int, ...], NDArray[Any]]] = {
            "palette": ((classes, 3), self.palette),
            "labels": ((images, regions, classes), self.labels),
            "ignored": ((images, regions), self.ignored),
            "occupied": ((len(self.parts), classes, *self.region_map.shape), self.occupied),
            "laplacian": (by_modality, self.laplacian),
            "mean": (by_modality, self.mean),
        }
        expected |= {f"noise['{key}']": (by_modality, each) for key, each in self.noise.items()}
        if self.night is not None:
            expected["night"] = ((images,), self.night)
        for name, (shape, values) in expected.items():
            if values.shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {values.shape}.")

    @property
    def num_regions(self) -> int:
        """R."""
        return int(self.region_map.max()) + 1

    @property
    def is_background(self) -> NDArray[np.bool_]:
        """(K,): which classes are background."""
        return np.array([name in self.background for name in self.classes], bool)

    @property
    def objects(self) -> tuple[int, ...]:
        """Indices of the classes that are not background."""
        return tuple(np.flatnonzero(~self.is_background).tolist())

    def subsets(self) -> tuple[str, ...]:
        """Parts of the images: ("all", "day", "night"), or ("all",) without images of both."""
        both = self.night is not None and 0 < int(self.night.sum()) < len(self.names)
        return (ALL, DAY, NIGHT) if both else (ALL,)

    def chosen(self, part: str) -> NDArray[np.bool_]:
        """(N,): which images belong to `part`: "all", "day" or "night".

        Raises:
            InputError: no such part, a data set without that information, or no such image.
        """
        check_choice("part", part, (ALL, DAY, NIGHT))
        if part == ALL:
            return np.ones(len(self.names), bool)
        if self.night is None:
            raise InputError(
                f"part={part}: {self.dataset} does not say which images were taken at night; use "
                "part=all."
            )
        wanted = self.night if part == NIGHT else ~self.night
        if not wanted.any():
            raise InputError(
                f"part={part}: split '{self.split}' of {self.dataset} holds no such image."
            )
        return wanted

    def select(self, part: str) -> SpatialStatistics:
        """The statistics of the images of `part`, see `chosen`; "all" is the whole."""
        wanted = self.chosen(part)
        if part == ALL:
            return self
        index = self.parts.index(part)
        by_image: dict[str, Any] = {
            key: getattr(self, key)[wanted]
            for key in ("night", "labels", "ignored", "laplacian", "mean")
        }
        return replace(
            self,
            names=tuple(np.array(self.names)[wanted].tolist()),
            parts=(part,),
            occupied=self.occupied[index : index + 1],
            noise={name: values[wanted] for name, values in self.noise.items()},
            **by_image,
        )

    def save(self, path: Path) -> None:
        """Write one compressed file under a temporary name, then rename: never half a file."""
        values: dict[str, Any] = {key: getattr(self, key) for key in ARRAYS}
        values |= {key: np.array(getattr(self, key), dtype=str) for key in (*TEXTS, *LISTS)}
        values |= {f"{NOISE}{name}": noise for name, noise in self.noise.items()}
        # Missing is stored as no value at all: npz without pickles knows no None.
        values["night"] = np.zeros(0, bool) if self.night is None else self.night
        ARCHIVE.save(path, values)

    @classmethod
    def load(cls, path: Path) -> SpatialStatistics:
        """Read what `save` wrote.

        Raises:
            InputError: no such file, or not a file of statistics.
        """
        return ARCHIVE.load(path, cls._of_arrays)

    @classmethod
    def _of_arrays(cls, values: dict[str, Any]) -> SpatialStatistics:
        night = values["night"].astype(bool)
        fields: dict[str, Any] = {key: values[key] for key in ARRAYS}
        fields |= {key: str(values[key]) for key in TEXTS}
        fields |= {key: tuple(values[key].tolist()) for key in LISTS}
        noise = (key for key in values if key.startswith(NOISE))
        fields["noise"] = {key.removeprefix(NOISE): values[key] for key in noise}
        return cls(night=night if len(night) else None, **fields)
