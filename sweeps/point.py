"""A point of a table, grid or search: one or more runs of `python -m rgbt.run`."""

from __future__ import annotations

import colorsys
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sweeps.evaluation import ExtraEvaluation

Value = str | int | float | bool | None

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
    evaluations: tuple[ExtraEvaluation, ...] = ()

    def runs(self) -> tuple[tuple[str, ...], ...]:
        """Overrides of each run."""
        return tuple((*self.overrides, f"seed={seed}") for seed in self.seeds) or (self.overrides,)
