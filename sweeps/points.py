"""What shall be run: points, each one or more runs of `python -m rgbt.run`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Value = str | int | float | bool | None


@dataclass(frozen=True)
class Evaluation:
    """A further evaluation of a finished run, made by `python -m rgbt.evaluate`.

    Attributes:
        modality: "rgbt", "rgb" or "thermal"; "default": what the network is made for.
        regions: a file of ``conf/metric``, or "as trained".
    """

    modality: str = "default"
    regions: str = "as trained"

    @property
    def path(self) -> str:
        """Path of its counts inside the run folder, and among the run's files in MLflow."""
        return f"evaluations/table_{self.modality}_{self.regions.replace(' ', '-')}.npz"


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
