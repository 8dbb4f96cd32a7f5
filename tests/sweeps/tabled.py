"""Small tables, counts and outcomes with values that can be followed by hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rgbt.metrics.counts import Counts
from rgbt.metrics.measurement import Measurement
from rgbt.runs.result import OWN
from sweeps.plan.measurement import Words, measurement_of
from sweeps.plan.table import Column, Row, Table
from sweeps.point import Outcome, Point
from sweeps.score.cells import CellId, ScoredTable, score
from tests.measured import measurement

DAY = [[[2, 0], [0, 2]], [[1, 1], [0, 2]]]
NIGHT = [[[2, 0], [2, 0]], [[2, 0], [0, 2]]]
"""Two regions of two classes. Together: [[4, 0], [2, 2]] and [[3, 1], [0, 4]]."""


def counts_of(*images: Any, night: tuple[bool, ...] | None = (False, True)) -> Counts:
    """Counts of the images, by default one by day and one by night."""
    array = np.array(images or (DAY, NIGHT), np.int64)
    return Counts(
        counts=array,
        names=tuple(f"{index:05d}" for index in range(len(array))),
        night=night,
        classes=("road", "car"),
        measurement=measurement(partition="ring2", dataset="d"),
    )


def right(share: int) -> Counts:
    """One region and image whose pixel accuracy is `share` percent."""
    return counts_of([[[share, 100 - share], [0, 0]]], night=None)


@dataclass(frozen=True)
class FakeResult:
    """Stands for `rgbt.runs.result.RunResult`."""

    key: str
    by_path: Mapping[str, Counts]
    commit: str | None = "aaaaaaaaaa"
    other_code: str | None = None
    tags: Mapping[str, str] = field(default_factory=dict)
    folder: Path = Path("nowhere")
    lists: str = ""
    machine: str = ""

    def measurements(self) -> dict[str, Measurement]:
        return {path: counts.measurement for path, counts in self.by_path.items()}

    def counts(self, path: str = OWN) -> Counts:
        return self.by_path[path]


def measured(counts: Counts, words: Words, own: Counts) -> Counts:
    """Counts as those of the measurement `words` of the run that ended with `own`."""
    found = measurement_of(words, own.measurement)
    if found.dataset_words:  # the data set that they make has another fingerprint
        found = replace(found, dataset="another", changed=("dataset",))
    return replace(counts, measurement=found)


def outcome(
    key: str,
    made: Counts | Mapping[Words, Counts],
    commit: str | None = "aaaaaaaaaa",
) -> Outcome:
    """A finished run."""
    every = {(): made} if isinstance(made, Counts) else made
    by_path = {
        f"evaluations/{' '.join(words)}.npz": measured(counts, words, every[()])
        for words, counts in every.items()
        if words
    }
    by_path |= {OWN: every[()]}
    result: Any = FakeResult(key, by_path, commit)
    return Outcome(Point(key, ()), "finished", results=(result,))


def failed(reason: str) -> Outcome:
    """A run that failed."""
    return Outcome(Point("", ()), "failed", reason)


def table(rows: tuple[Row, ...], columns: tuple[Column, ...] = (), **others: Any) -> Table:
    """A table with one column of pixel accuracy unless others are given."""
    accuracy = Column(name="acc", metric="pixel_accuracy")
    given = {"paper": "own", "number": "TABLE I", "caption": "Rows", "data": "somewhere", **others}
    return Table(columns=columns or (accuracy,), rows=rows, **given)


@dataclass(frozen=True)
class Made:
    """A table of pixel accuracies in percent: label -> (ours by seed, printed)."""

    rows: Mapping[str, tuple[tuple[int, ...], float | None]]
    others: Mapping[str, Any] = field(default_factory=dict)

    def table(self) -> Table:
        rows = tuple(
            Row(label=label, experiment="crm", values={} if printed is None else {"acc": printed})
            for label, (_, printed) in self.rows.items()
        )
        return table(rows, **self.others)

    def runs(self) -> dict[tuple[str, int], Outcome]:
        return {
            (label, seed): outcome(f"{label}{seed}", right(share))
            for label, (shares, _) in self.rows.items()
            for seed, share in enumerate(shares)
        }

    def scored(self, marks: Mapping[CellId, int] | None = None) -> ScoredTable:
        found = score("own/made", self.table(), self.runs(), scale="demo")
        return replace(found, marks=marks or {})
