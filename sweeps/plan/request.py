"""The runs that a table needs, as points: one per row and seed; rows of the same run share one."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rgbt.checks import InputError
from rgbt.config.options import readable_paths
from rgbt.runs.naming import MACHINE_OVERRIDES
from rgbt.runs.specify import CHECKOUT
from sweeps.plan.measurement import Words
from sweeps.plan.table import Form, Row, Table, is_counted, words_of, world_words
from sweeps.point import Point

if TYPE_CHECKING:
    from sweeps.point import Outcome

DEFAULT_SCALE = "demo"  # The scale of a run without ``scale=...``

TAG = "rgbt.table/"  # prefix of the tag that names the rows of a run
PRETRAINED = "pretrained."  # pretrained.NETWORK=FILE: initial weights of its rows
TAG_LENGTH = 5000

# Prefix of the tag that says how the rows were requested, where that is not plainly: their form,
# the digest of the settings of the row alone, and the words that were typed for all rows.
REQUESTED = "rgbt.requested/"

# Prefix of the tag of runs whose number depends on what earlier ones have shown: intervals of
# their table must be valid at any time.
UNTIL_DECIDED = "rgbt.until_decided/"


@dataclass(frozen=True)
class TableRequest:
    """A table to compute.

    Attributes:
        table: with the rows that are shown; see `sweeps.table_plan.select_rows`.
        extra: overrides that win over those of the rows.
        pretrained: files of initial weights by the name of the network.
        evaluated: labels of rows that are evaluated and not trained (`sweeps.score.external`).
        typed: further options that make it another table, as they were typed.
        until_decided: whether seeds are added until claims are decided, which runs record.
        digests: of the settings of the rows without `extra` and `pretrained`, by label.
    """

    name: str
    table: Table
    scale: str
    seeds: tuple[int, ...]
    extra: tuple[str, ...] = ()
    pretrained: Mapping[str, str] = field(default_factory=dict)
    form: Form = "paper"
    evaluated: tuple[str, ...] = ()
    typed: tuple[str, ...] = ()
    until_decided: bool = False
    digests: Mapping[str, str] = field(default_factory=dict)

    def overrides(self, label: str, seed: int) -> tuple[str, ...]:
        """Overrides of the run of row `label` with that seed."""
        (row,) = (row for row in self.table.rows if row.label == label)
        experiment, *others = self.table.overrides(row, self.scale, self.form)
        scale = () if self.scale == DEFAULT_SCALE else (f"scale={self.scale}",)
        file = self.pretrained.get(_model_of(others))
        weights = () if file is None else readable_paths([f"model.weights={file}"])
        return (experiment, *scale, *others, *self.extra, *weights, f"seed={seed}")

    def row_seeds(self) -> list[tuple[str, int]]:
        """(label, seed) of every run, seed by seed; columns of efficiency need none."""
        if not any(map(is_counted, self.table.columns)):
            return []
        return [(row.label, seed) for seed in self.seeds for row in self.trained_rows]

    @property
    def trained_rows(self) -> list[Row]:
        """The rows whose network is trained: those that can be run and are not evaluated."""
        return [row for row in self.table.runnable_rows if row.label not in self.evaluated]

    def points(self, row_seeds: Sequence[tuple[str, int]] | None = None) -> list[Point]:
        """The points of some rows and seeds, by default of all; equal runs share one point."""
        sharing: dict[tuple[str, ...], list[str]] = {}
        for label, seed in self.row_seeds() if row_seeds is None else row_seeds:
            sharing.setdefault(self.overrides(label, seed), []).append(label)
        points = []
        for overrides, labels in sharing.items():
            more = f" (and {len(labels) - 1} more)" if len(labels) > 1 else ""
            label, evaluations = f"{labels[0]}{more} {overrides[-1]}", self.evaluations(labels)
            points.append(Point(label, overrides, tags=self.tags(labels), evaluations=evaluations))
        return points

    def tags(self, labels: Sequence[str]) -> dict[str, str]:
        """MLflow tags of the run of the rows `labels`: what it was requested for, and how."""
        tags = {TAG + self.name: " | ".join(labels)[:TAG_LENGTH]}
        tags |= {UNTIL_DECIDED + self.name: "true"} if self.until_decided else {}
        words = self.deciding_words()
        if words or self.form != "paper":
            how = [self.form, self.digests.get(labels[0], ""), *words]
            tags[REQUESTED + self.name] = shlex.join(how)
        return tags

    def deciding_words(self) -> list[str]:
        """The words typed for all rows that are of the runs, and not of the machine."""
        typed = self.typed_overrides()
        machine = (*MACHINE_OVERRIDES, f"{CHECKOUT}=")
        return [word for word in typed if not word.lstrip("+~").startswith(machine)]

    def evaluations(self, labels: Collection[str] | None = None) -> tuple[Words, ...]:
        """Further measurements of the runs of the rows `labels`; None: of all that are run."""
        rows = self.table.runnable_rows
        named = [row for row in rows if labels is None or row.label in labels]
        names = {column.name for row in named for column in self.table.columns_of(row)}
        counted = (each for each in self.table.columns if is_counted(each) and each.name in names)
        every = [words_of(column, self.table) for column in counted]
        for row in named:
            every += world_words(self.table, row).values()
        return tuple(dict.fromkeys(filter(None, every)))

    def runs(self, outcomes: Sequence[Outcome]) -> Mapping[tuple[str, int], Outcome]:
        """The outcome of every row and seed."""
        by_overrides = {outcome.point.overrides: outcome for outcome in outcomes}
        seeds = sorted({seed_of(overrides) for overrides in by_overrides})
        pairs = ((row.label, seed) for row in self.trained_rows for seed in seeds)
        found = {each: by_overrides.get(self.overrides(*each)) for each in pairs}
        return {each: outcome for each, outcome in found.items() if outcome is not None}

    def typed_overrides(self) -> tuple[str, ...]:
        """Further overrides, as they were typed."""
        files = (f"{PRETRAINED}{model}={file}" for model, file in self.pretrained.items())
        return (*self.extra, *files)

    @property
    def variant(self) -> str:
        """The scale and the form; with a short hash where other words make it another table."""
        typed = (*self.typed_overrides(), *self.typed)
        shown = [word for word in typed if not word.startswith("dataset.root=")]
        digest = hashlib.sha256("\n".join(sorted(shown)).encode()).hexdigest()[:6]
        form = "" if self.form == "paper" else f"-{self.form}"
        return f"{self.scale}{form}-{digest}" if shown else f"{self.scale}{form}"

    def models(self) -> set[str]:
        """Networks (`model=...`) of the rows."""
        rows = self.table.runnable_rows
        return {_model_of(self.table.overrides(row, self.scale, self.form)) for row in rows} - {""}


def _model_of(overrides: Sequence[str]) -> str:
    """The network that is chosen last, or ""."""
    named = [word.partition("=")[2] for word in overrides if word.startswith("model=")]
    return named[-1] if named else ""


def seed_of(overrides: Sequence[str]) -> int:
    """The seed of the overrides of a row, which end with it."""
    return int(overrides[-1].removeprefix("seed="))


def seeds_of(text: str) -> tuple[int, ...]:
    """Seeds of ``seeds=3`` (these are 0, 1, 2), of ``seeds=0,4,7`` or of ``seeds=[7]``."""
    words = text.strip("[]").split(",")
    if all(word.strip().isdecimal() for word in words):
        numbers = tuple(map(int, words))
        seeds = tuple(range(numbers[0])) if text.isdecimal() else numbers
        if seeds and len(set(seeds)) == len(seeds):
            return seeds
    raise InputError(
        f"seeds={text}: expected a number (3: seeds 0, 1, 2), a list of different seeds (0,4,7), "
        "or until_decided."
    )
