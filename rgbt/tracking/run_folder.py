"""Write the run folder, which holds everything that tables, figures and MLflow need later.

==================  ==============================================================================
config.yaml         the resolved configuration
provenance.json     a list: one entry per process that worked on the run (`provenance.py`)
diff.patch          uncommitted changes of the code at the first of these, if there were any
run.json            name, tags and parameters for trackers
metrics.jsonl       one JSON object per line, see `MetricLine`; metrics.jsonl.damaged: as it was
                    before a run that resumed left damaged lines out
counts_<split>.npz  integer counts that every score is derived from; counts_<split>_<view>.npz: of a
                    target domain that is seen in another view than the source
tables.json         the last region and class tables (`tables.py`)
figures/*.png       pictures
evaluations/*.npz   counts of later evaluations (`rgbt.evaluate`) and of pairs of frames
evaluations/robustness/<split>/  counts of corrupted images, and their inputs (`rgbt.robustness`)
last.pt best.pt     checkpoints: to resume from, and the best by the selection split;
                    last_previous.pt, checkpoints/: while training (`rgbt.engine.committed`)
dataset.json        the images that the run was started on (`rgbt.training.train`)
lock mlflow.json    the process that trains here now; record of the data sent to MLflow
result.json         written last, by rename: the run is finished exactly if it exists
==================  ==============================================================================
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from rgbt.checks import InputError, one_line
from rgbt.files.atomic import holder_of, holding, is_held, remove_left_behind, write_atomic
from rgbt.files.budgets import TEXT, parse_json, read_bytes, read_json, sealed
from rgbt.tracking.run_files import Description, Kind, LineForm, MarkerForm, read_provenance
from rgbt.tracking.tables import ResultTables

KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class MetricLine:
    """One line of ``metrics.jsonl``.

    On disk: ``{"step": 200, "kind": "val", "time": 1763690000.5, "values": {"mIoU": 0.41},
    "crc32": "0c1f94a2"}``; a value that is not finite is written as null and read as NaN.

    Attributes:
        step: optimiser steps done; increases strictly within a kind.
        kind: "train" (a logged step), "val" (an evaluation on the way), "test" (the last one).
        time: seconds since 1970.
        values: metric name -> value.
    """

    step: int
    kind: Kind
    time: float
    values: dict[str, float]


@dataclass(frozen=True)
class Truncation:
    """The result of `RunFolder.truncate_after`.

    Attributes:
        reached: last step of any line before, 0 without lines.
        damaged: of each line that cannot be read, its number and the reason.
    """

    reached: int
    damaged: list[str]


class RunFolder:
    """Writes one run's folder, which is made where it does not exist.

    `rgbt.tracking.run_files` reads the files.

    Args:
        path: the folder, usually ``runs/<config key>``.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path).resolve()
        self.path.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock this folder for training, and remove incomplete files of a killed process.

        Raises:
            InputError: another process does; the message names it and its machine.
        """
        with self._locked() as holder:
            if holder is not None:
                raise InputError(
                    f"{self.path} is being trained by {holder}. Wait for it, or stop it and rerun "
                    "the command to resume."
                )
            yield

    def clean(self) -> None:
        """Remove incomplete files of a killed process, unless another process trains here."""
        with self._locked():
            pass

    @contextmanager
    def _locked(self) -> Iterator[str | None]:
        before = holder_of(self.path / "lock")
        with holding(self.path / "lock") as holder:
            if holder is None:
                remove_left_behind(self.path, before)
            yield holder

    def is_locked(self) -> bool:
        """Whether a process is training here now."""
        return is_held(self.path / "lock")

    def write_config(self, text: str) -> None:
        """Write the resolved configuration (YAML text)."""
        write_atomic(self.path / "config.yaml", text.encode())

    def add_provenance(self, entry: Mapping[str, Any]) -> None:
        """Append one process's `provenance()`; its diff becomes a file that can be applied."""
        before = self._provenance()
        diff = entry.get("diff") or ""
        name = f"diff_{len(before) + 1}.patch" if before else "diff.patch"
        if diff:
            write_atomic(self.path / name, diff.encode())
        plain = {**entry, "diff": name if diff else None}
        self._write_json("provenance.json", [*map(sealed, before), sealed(plain)])

    def begin_at(self, step: int) -> None:
        """Note the step at which the last process of ``provenance.json`` began."""
        *before, last = self._provenance()
        entries = [*before, {**last, "from_step": step}]
        self._write_json("provenance.json", [*map(sealed, entries)])

    def _provenance(self) -> list[dict[str, Any]]:
        return read_provenance(self.path / "provenance.json")

    def describe(self, description: Description) -> None:
        """Write name, tags and parameters of this run for trackers."""
        self._write_json("run.json", sealed(vars(description)))

    def append(self, step: int, kind: Kind, values: Mapping[str, float]) -> None:
        """Add one line to ``metrics.jsonl`` and hand it to the operating system at once."""
        plain = {name: float(value) for name, value in values.items()}
        line = {
            "step": step,
            "kind": kind,
            "time": round(time.time(), 3),
            "values": {key: v if math.isfinite(v) else None for key, v in plain.items()},
        }
        with (self.path / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(sealed(line), allow_nan=False) + "\n")

    def lines(self) -> list[MetricLine]:
        """Lines of ``metrics.jsonl`` in order; one cut short by a crash is left out.

        Raises:
            InputError: a line is damaged, or its step does not follow that of the one before.
        """
        found, damaged = self._read_lines()
        if damaged:
            raise InputError(
                f"{self.path / 'metrics.jsonl'} is damaged ({damaged[0]}). Delete the line; an "
                "unfinished run deletes it when it resumes."
            )
        return found

    def truncate_after(self, step: int, evaluated_step: int | None = None) -> Truncation:
        """Remove lines that a run resuming at `step` will write again, and unreadable lines.

        These are the lines beyond `step`, every "test" line (the last evaluation is repeated), a
        line cut short by a crash, and damaged or repeated lines. Where there are any of the last,
        the file is kept as ``metrics.jsonl.damaged``.

        Args:
            step: of the checkpoint.
            evaluated_step: "val" lines beyond this one are dropped too; None: as `step`.
        """
        found, damaged = self._read_lines()
        if damaged:
            content = (self.path / "metrics.jsonl").read_bytes()
            write_atomic(self.path / "metrics.jsonl.damaged", content)
        ends = {"train": step, "val": step if evaluated_step is None else evaluated_step}
        plain = (
            {
                **vars(line),
                "values": {k: None if math.isnan(v) else v for k, v in line.values.items()},
            }
            for line in sorted(found, key=lambda line: line.step)
            if line.step <= ends.get(line.kind, -1)
        )
        text = "".join(json.dumps(sealed(line)) + "\n" for line in plain)
        write_atomic(self.path / "metrics.jsonl", text.encode())
        return Truncation(max((line.step for line in found), default=0), damaged)

    def _read_lines(self) -> tuple[list[MetricLine], list[str]]:
        """Whole lines, each step of a kind once; and what is wrong with the others."""
        path = self.path / "metrics.jsonl"
        if not path.exists():
            return [], []
        found: dict[tuple[Kind, int], MetricLine] = {}
        damaged = []
        last = {kind: -1 for kind in KINDS}
        for number, text in enumerate(read_bytes(path, TEXT).split(b"\n")[:-1], 1):
            try:
                line = metric_line(text)
            except ValueError as error:
                damaged.append(f"line {number}: {one_line(error)}")
                continue
            if line.step <= last[line.kind]:
                damaged.append(f"line {number}: step {line.step} comes after {last[line.kind]}")
            last[line.kind] = max(line.step, last[line.kind])
            found.setdefault((line.kind, line.step), line)
        return list(found.values()), damaged

    def figure_path(self, name: str) -> Path:
        """Path of the picture `name`; its folder is made."""
        folder = self.path / "figures"
        folder.mkdir(exist_ok=True)
        return folder / f"{name}.png"

    def write_tables(self, tables: ResultTables) -> None:
        """Write the tables."""
        self._write_json("tables.json", sealed(tables.to_json()))

    def finish(self, result: Mapping[str, Any]) -> None:
        """Mark the run as finished; everything else must be written before."""
        self._write_json("result.json", sealed(result))

    def mark(self, marker: MarkerForm) -> None:
        """Write ``dataset.json``, which identifies the images."""
        self._write_json("dataset.json", sealed(marker))

    def _write_json(self, name: str, value: Any) -> None:
        write_atomic(self.path / name, (json.dumps(value, indent=1) + "\n").encode())


def metric_line(text: bytes) -> MetricLine:
    """One line of ``metrics.jsonl``, read; ValueError where it is damaged."""
    plain = parse_json(text, LineForm)
    values = {name: math.nan if v is None else float(v) for name, v in plain["values"].items()}
    return MetricLine(plain["step"], plain["kind"], plain["time"], values)


def runs_in(runs_dir: Path | str) -> list[RunFolder]:
    """Every run folder directly inside `runs_dir`, by name.

    Raises:
        InputError: there is no such folder.
    """
    root = Path(runs_dir)
    if not root.is_dir():
        raise InputError(
            f"the folder {root} does not exist; name the folder of runs with runs_dir=..."
        )
    return [RunFolder(path.parent) for path in sorted(root.glob("*/run.json"))]


def find_run(run: str, runs_dir: Path) -> Path:
    """The folder of a run given as a folder, a config key, or an MLflow run id.

    Raises:
        InputError: there is no such run.
    """
    for folder in (Path(run), runs_dir / run):
        if (folder / "config.yaml").is_file():
            return folder.resolve()
    for sent in sorted((*runs_dir.glob("*/mlflow.json"), *runs_dir.glob("replaced/*/mlflow.json"))):
        with suppress(InputError):  # a damaged file does not identify a run
            if str(read_json(sent, dict[str, Any], "").get("run_id")) == run:
                return sent.parent.resolve()
    raise InputError(
        f"run={run} is neither a run folder (with a config.yaml), nor a key or an MLflow run id "
        f"in {runs_dir.resolve()}. List that folder to see the runs, or name another folder with "
        "runs_dir=..."
    )
