"""The commands that make the counts of an external row, and the hash of what they depend on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from rgbt.metrics.pair_list import PAIR_LIST
from rgbt.runs.provenance import without_passwords
from sweeps.evaluation import ExtraEvaluation
from sweeps.table.cells import OWN_COUNTS, evaluation_of, is_counted
from sweeps.table.external import ExternalRow
from sweeps.table.external_data import Settings, TableData
from sweeps.table.table import Row, Table

MACHINE = ("data.", "trainer.accelerator=", "trainer.precision=", "trainer.threads=")
"""Overrides of the user that reach a row with a network of its own; others are for trainings."""

NEEDS_NETWORK = "needs the network: predictions of a folder are of clean images of both cameras"
NEEDS_PAIRS = (
    f"needs predictions of both frames and {PAIR_LIST} in the folder; write the images with rgbt "
    "consistency export=..."
)


@dataclass(frozen=True)
class PlannedEvaluation:
    """An evaluation of an external row.

    Attributes:
        label: as shown.
        path: of its counts, relative to the folder of the row.
        command: without its output; () where there is none.
        reason: why there is no command.
        made: path of the counts that the command writes, relative to its output folder.
        out: the output of the command, relative to that folder.
    """

    label: str
    path: str
    command: tuple[str, ...] = ()
    reason: str = ""
    made: str = ""
    out: str = ""


@dataclass(frozen=True)
class ExternalSource:
    """An external row with everything that its evaluations depend on."""

    row: Row
    given: ExternalRow
    table: Table
    data: TableData
    words: tuple[str, ...]

    @classmethod
    def of(
        cls, given: ExternalRow, table: Table, data: TableData, settings: Settings
    ) -> ExternalSource:
        """The row of `table` that `given` names."""
        (row,) = (row for row in table.rows if row.label == given.label)
        return cls(row, given, table, data, _words(given, row, table, data, settings))

    def evaluations(self) -> Iterator[PlannedEvaluation]:
        """All evaluations that its columns need, that of plain images first."""
        columns = filter(is_counted, self.table.columns_of(self.row))
        distinct = dict.fromkeys(evaluation_of(column, self.table) for column in columns)
        make = self._of_weights if self.given.kind == "weights" else self._of_predictions
        for each in sorted(distinct, key=lambda extra: extra is not None):
            extra = each or ExtraEvaluation()
            path = OWN_COUNTS if each is None else extra.path
            yield make(extra, PlannedEvaluation(extra.label, path))

    def _of_weights(self, extra: ExtraEvaluation, plan: PlannedEvaluation) -> PlannedEvaluation:
        module, *arguments = extra.command
        words = self.words
        if extra.frames is None and extra.regions == "as trained":
            arguments.remove("regions=as trained")
            words = (*words, *self.data.words("metric", "paper"))
        command = (module, *arguments, *words)
        if extra.frames is None:
            made = extra.details_path("counts.npz")
            return replace(plan, command=command, made=made, out="counts.npz")
        return replace(plan, command=command, made=Path(plan.path).name)

    def _of_predictions(self, extra: ExtraEvaluation, plan: PlannedEvaluation) -> PlannedEvaluation:
        of_folder = (f"predictions={self.given.path}", *self.words)
        if extra.frames is not None:
            if not (self.given.path / PAIR_LIST).is_file():
                return replace(plan, reason=NEEDS_PAIRS)
            return replace(plan, command=(*extra.command, *of_folder), made=Path(plan.path).name)
        plain = ExtraEvaluation(regions=extra.regions)
        if extra not in (plain, replace(plain, modality="rgbt")):
            return replace(plan, reason=NEEDS_NETWORK)
        regions = self.data.regions(extra.regions)
        if regions.aspect == "released_3_4":
            return replace(
                plan, reason=f"predictions are not counted in regions {regions.name}; choose ring5"
            )
        shape = (f"partition={regions.partition}", f"regions={regions.regions}")
        command = ("analysis.score", "resamples=0", *shape, *of_folder)
        return replace(plan, command=command, made=f"counts_{regions.name}.npz")

    def description(self) -> dict[str, object]:
        """What the counts depend on, without the folders that hold it."""
        placed = (f"{prefix}.root=" for prefix in ("dataset", "+dataset"))
        starts = (*placed, "model.weights=")
        return {
            "kind": self.given.kind,
            "content": content_hash(self.given.path),
            "dataset": self.data.fingerprint,
            "overrides": [
                without_passwords(word) for word in self.words if not word.startswith(starts)
            ],
            "metric": self.data.values("metric"),
        }


def hash_of(description: dict[str, object]) -> str:
    """Twelve hexadecimal digits that name the folder of counts."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()[:12]


def content_hash(path: Path) -> str:
    """SHA-256 in hexadecimal of a file, or of names and contents of all files in a folder.

    Hidden files and folders inside it are left out.
    """
    if path.is_file():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    inside = ((each, each.relative_to(path)) for each in sorted(path.rglob("*")) if each.is_file())
    shown = ((each, name) for each, name in inside if not any(p[0] == "." for p in name.parts))
    lines = [f"{content_hash(each)} {name.as_posix()}\n" for each, name in shown]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _words(
    given: ExternalRow, row: Row, table: Table, data: TableData, settings: Settings
) -> tuple[str, ...]:
    """Overrides that all evaluations of a row have."""
    if given.kind == "predictions":
        return tuple(data.words("dataset", "demo"))
    weights = f"model.weights={given.path}"
    if row.network:
        machine = (word for word in settings["extra"] if word.startswith(MACHINE))
        return (*row.network, *data.words("dataset", "paper"), *machine, weights)
    scale = settings["scale"]
    experiment, *others = table.overrides(row, scale, settings["form"])
    return (experiment, f"scale={scale}", *others, *settings["extra"], weights)
