"""What shall be run: points, each one or more runs of `python -m rgbt.run`."""

from __future__ import annotations

import colorsys
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from rgbt.metrics.pairs import Protocol, file_name
from rgbt.spec.corruption_names import row_name

Value = str | int | float | bool | None

Head = Literal["as trained", "own", "source", "target"]
"""Which head of a network predicts: that of an image's own domain, or one domain's for all."""


@dataclass(frozen=True)
class Evaluation:
    """A further evaluation of a finished run.

    Attributes:
        modality: "rgbt", "rgb" or "thermal"; "default": what the network is made for.
        regions: a file of ``conf/metric``, or "as trained".
        frames: protocol of pairs of frames, see `rgbt.metrics.pairs`; None: single frames.
        head: see `Head`; of single frames alone.
        corruption: of the images, NAME or NAME:IMAGE with a file of ``conf/corruption``; None:
            clean, as the run's own.
        severity: of the corruption; None: the only one that it has.
    """

    modality: str = "default"
    regions: str = "as trained"
    frames: Protocol | None = None
    head: Head = "as trained"
    corruption: str | None = None
    severity: float | None = None

    @property
    def label(self) -> str:
        """For people: "thermal, ring9", "rgb, ring5, source head" or "consistency, aligned".

        Under a corruption: "default, ring5, occluded-0.5".
        """
        if self.frames is not None:
            return f"consistency, {self.frames}"
        head = "" if self.head == "as trained" else f", {self.head} head"
        corrupted = f", {self._corrupted}" if self.corruption else ""
        return f"{self.modality}, {self.regions}{head}{corrupted}"

    @property
    def command(self) -> tuple[str, ...]:
        """Module that makes it and what it is asked, beside the run.

        One call makes both protocols of virtual views, aligned and released.
        """
        if self.frames is not None:
            return ("rgbt.consistency", f"frames={'next' if self.frames == 'next' else 'virtual'}")
        head = () if self.head == "as trained" else (f"head={self.head}",)
        corruption = () if self.corruption is None else (f"corruption={self.corruption}",)
        severity = () if self.severity is None else (f"severity={self.severity:g}",)
        asked = (f"modality={self.modality}", f"regions={self.regions}")
        return ("rgbt.evaluate", *asked, *head, *corruption, *severity)

    @property
    def path(self) -> str:
        """Path of its counts inside the run folder, and among the run's files in MLflow."""
        if self.frames is not None:
            return file_name(self.frames, "test")
        head = "" if self.head == "as trained" else f"_{self.head}-head"
        corrupted = f"_{self._corrupted}" if self.corruption else ""
        regions = self.regions.replace(" ", "-")
        return f"evaluations/table_{self.modality}_{regions}{head}{corrupted}.npz"

    @property
    def _corrupted(self) -> str:
        """The corruption with its severity, as part of a name."""
        return row_name(self.corruption or "") + (
            "" if self.severity is None else f"-{self.severity:g}"
        )


COLOUR = "mlflow.runColor"
"""Tag with the colour of a run in MLflow's charts, which else comes from a hash of its id: of
twenty colours two runs of four share one in every fourth grid."""


def colour(study: str, index: int) -> str:
    """Colour of the point `index` of a study, "#rrggbb"; neighbours differ in hue and lightness."""
    first = hashlib.sha256(study.encode()).digest()[0] / 256
    hue = (first + index * GOLDEN) % 1.0
    channels = colorsys.hls_to_rgb(hue, LIGHTNESSES[index % len(LIGHTNESSES)], SATURATION)
    return "#" + "".join(f"{round(255 * channel):02x}" for channel in channels)


GOLDEN = 0.618034
"""Golden ratio: its multiples, modulo 1, never come close to each other soon."""

LIGHTNESSES = (0.36, 0.56, 0.46)
SATURATION = 0.62


def varied_keys(points: Sequence[Point]) -> list[str]:
    """Keys of the overrides that not all points have, in order."""
    common = set.intersection(*(set(point.overrides) for point in points)) if points else set()
    words = (word for point in points for word in point.overrides if word not in common)
    return list(dict.fromkeys(word.lstrip("+").partition("=")[0] for word in words))


@dataclass(frozen=True)
class Point:
    """One cell of a table, point of a grid or trial of a search.

    Attributes:
        label: what a person sees, e.g. "Ny/4 seed=1".
        overrides: of `python -m rgbt.run`.
        params: what a grid or a search chose, by key.
        tags: MLflow tags that the runs get.
        seeds: one run per seed, whose mean is the value of the point; (): the overrides say it.
        evaluations: made of every run once it is finished.
    """

    label: str
    overrides: tuple[str, ...]
    params: Mapping[str, Value] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)
    seeds: tuple[int, ...] = ()
    evaluations: tuple[Evaluation, ...] = ()

    def runs(self) -> tuple[tuple[str, ...], ...]:
        """Overrides of each run."""
        return tuple((*self.overrides, f"seed={seed}") for seed in self.seeds) or (self.overrides,)
