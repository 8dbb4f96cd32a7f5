"""The runs that a table needs, as points: one per row and seed; rows of the same run share one."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rgbt.checks import InputError
from rgbt.config.options import readable_paths
from sweeps.evaluation import ExtraEvaluation
from sweeps.point import Point
from sweeps.table.cells import evaluation_of, is_counted
from sweeps.table.table import Table

if TYPE_CHECKING:
    from sweeps.worker.trial_sources import Outcome

DEFAULT_SCALE = "demo"
"""The scale of a run without ``scale=...``."""

TAG = "rgbt.table/"
"""Prefix of the tag that names a run's row: rgbt.table/spatialseg/table3 = "Ny/4"."""

SEPARATOR = " | "
TAG_LENGTH = 5000


@dataclass(frozen=True)
class TableRequest:
    """A table to compute.

    Attributes:
        scale: "demo" or "paper".
        seeds: of every row.
        extra: overrides that win over those of the rows.
        weights: files of weights by the name of the network, for tables of several backbones.
    """

    name: str
    table: Table
    scale: str
    seeds: tuple[int, ...]
    extra: tuple[str, ...] = ()
    weights: Mapping[str, str] = field(default_factory=dict)

    def overrides(self, label: str, seed: int) -> tuple[str, ...]:
        """Overrides of the run of row `label` with that seed."""
        (row,) = (row for row in self.table.rows if row.label == label)
        experiment, *others = self.table.overrides(row, self.scale)
        scale = () if self.scale == DEFAULT_SCALE else (f"scale={self.scale}",)
        file = self.weights.get(_model_of(others) or "")
        weights = () if file is None else readable_paths([f"model.weights={file}"])
        return (experiment, *scale, *others, *self.extra, *weights, f"seed={seed}")

    def row_seeds(self) -> list[tuple[str, int]]:
        """(label, seed) of every run; all rows of a seed before the next seed.

        Empty where no column is a score: columns of efficiency need no run.
        """
        if not any(map(is_counted, self.table.columns)):
            return []
        rows = self.table.runnable_rows
        return [(row.label, seed) for seed in self.seeds for row in rows]

    def points(self) -> list[Point]:
        """The points; rows with equal overrides share one."""
        sharing: dict[tuple[str, ...], list[str]] = {}
        for label, seed in self.row_seeds():
            sharing.setdefault(self.overrides(label, seed), []).append(label)
        points = []
        for overrides, labels in sharing.items():
            more = f" (and {len(labels) - 1} more)" if len(labels) > 1 else ""
            label = f"{labels[0]}{more} {overrides[-1]}"
            tags = {TAG + self.name: SEPARATOR.join(labels)[:TAG_LENGTH]}
            evaluations = self.evaluations(labels)
            points.append(Point(label, overrides, tags=tags, evaluations=evaluations))
        return points

    def evaluations(self, labels: Collection[str] | None = None) -> tuple[ExtraEvaluation, ...]:
        """Further evaluations of the runs of the rows `labels`; None: of all rows that are run."""
        rows = self.table.runnable_rows
        named = [row for row in rows if labels is None or row.label in labels]
        names = {column.name for row in named for column in self.table.columns_of(row)}
        counted = (each for each in self.table.columns if is_counted(each) and each.name in names)
        evaluations = (evaluation_of(column, self.table) for column in counted)
        return tuple(dict.fromkeys(each for each in evaluations if each is not None))

    def runs(self, outcomes: Sequence[Outcome]) -> Mapping[tuple[str, int], Outcome]:
        """The outcome of every row and seed."""
        by_overrides = {outcome.point.overrides: outcome for outcome in outcomes}
        return {run: by_overrides[self.overrides(*run)] for run in self.row_seeds()}

    def typed_overrides(self) -> tuple[str, ...]:
        """Further overrides, as they were typed."""
        return (*self.extra, *(f"weights.{model}={file}" for model, file in self.weights.items()))

    @property
    def variant(self) -> str:
        """The scale; with a short hash where further overrides make it another table."""
        shown = [word for word in self.typed_overrides() if not word.startswith("dataset.root=")]
        digest = hashlib.sha256("\n".join(sorted(shown)).encode()).hexdigest()[:6]
        return f"{self.scale}-{digest}" if shown else self.scale

    def models(self) -> set[str]:
        """Networks (`model=...`) of the rows."""
        rows = self.table.runnable_rows
        models = (_model_of(self.table.overrides(row, self.scale)) for row in rows)
        return {model for model in models if model is not None}


def _model_of(overrides: Sequence[str]) -> str | None:
    named = [word.partition("=")[2] for word in overrides if word.startswith("model=")]
    return named[-1] if named else None


def seeds_of(text: str) -> tuple[int, ...]:
    """Seeds of ``seeds=3`` (these are 0, 1, 2) or of ``seeds=0,4,7``.

    Raises:
        InputError: something else.
    """
    is_list = text.startswith("[") and text.endswith("]")
    words = (text[1:-1] if is_list else text).split(",")
    numbers = tuple(int(word) for word in words if word.strip().isdecimal())
    counted = len(numbers) == 1 and not is_list
    if (
        len(numbers) != len(words)
        or len(set(numbers)) != len(numbers)
        or (counted and not any(numbers))
    ):
        raise InputError(
            f"seeds={text}: expected a number of seeds (3: seeds 0, 1, 2) or a list of different "
            "seeds (0,4,7)."
        )
    return tuple(range(numbers[0])) if counted else numbers
