"""What shall be run: points, each one or more runs of `python -m rgbt.run`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from rgbt.metrics.pairs import Protocol, file_name

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
    """

    modality: str = "default"
    regions: str = "as trained"
    frames: Protocol | None = None
    head: Head = "as trained"

    @property
    def label(self) -> str:
        """For people: "thermal, ring9", "rgb, ring5, source head" or "consistency, aligned"."""
        if self.frames is not None:
            return f"consistency, {self.frames}"
        head = "" if self.head == "as trained" else f", {self.head} head"
        return f"{self.modality}, {self.regions}{head}"

    @property
    def command(self) -> tuple[str, ...]:
        """Module that makes it and what it is asked, beside the run.

        One call makes both protocols of virtual views, aligned and released.
        """
        if self.frames is not None:
            return ("rgbt.consistency", f"frames={'next' if self.frames == 'next' else 'virtual'}")
        head = () if self.head == "as trained" else (f"head={self.head}",)
        return ("rgbt.evaluate", f"modality={self.modality}", f"regions={self.regions}", *head)

    @property
    def path(self) -> str:
        """Path of its counts inside the run folder, and among the run's files in MLflow."""
        if self.frames is not None:
            return file_name(self.frames, "test")
        head = "" if self.head == "as trained" else f"_{self.head}-head"
        return f"evaluations/table_{self.modality}_{self.regions.replace(' ', '-')}{head}.npz"


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
