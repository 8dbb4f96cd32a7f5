"""The run folder, complete in itself: everything that a table, a figure or MLflow needs later.

==================  ==============================================================================
config.yaml         the resolved configuration
provenance.json     a list: one entry per process that worked on the run (`provenance.py`)
diff.patch          uncommitted changes of the code at the first of these, if there were any
run.json            name, tags and parameters, as a tracker shall show them
metrics.jsonl       one JSON object per line, see `MetricLine`
counts_<split>.npz  integer counts that every score is derived from; counts_<split>_<view>.npz: of a
                    target domain that is seen in another view than the source
tables.json         the last region and class tables (`tables.py`)
figures/*.png       pictures
evaluations/*.npz   counts of later evaluations (`rgbt.evaluate`) and of pairs of frames
evaluations/robustness/<split>/  counts of failing images, and what made them (`rgbt.robustness`)
last.pt best.pt     checkpoints: to continue from, and the best by the selection split
dataset.json        which images the run was begun on (`rgbt.training`)
lock mlflow.json    who trains here now; what MLflow has been sent
result.json         written last, by rename: the run is finished exactly if it exists
==================  ==============================================================================
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from rgbt.checks import InputError
from rgbt.tracking.files import holding, is_held, write_atomic

Kind = Literal["train", "val", "test"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class MetricLine:
    """One line of ``metrics.jsonl``.

    On disk: ``{"step": 200, "kind": "val", "time": 1763690000.5, "values": {"mIoU": 0.41}}``;
    a value that is not finite is written as null and read as NaN.

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
class Description:
    """How a tracker shows the run: its name, tags (text) and parameters (text)."""

    name: str
    tags: dict[str, str]
    params: dict[str, str]


class RunFolder:
    """One run's folder; made where it does not exist.

    Args:
        path: the folder, usually ``runs/<config key>``.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path).resolve()
        self.path.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes from training in this folder.

        Raises:
            InputError: another process does; the sentence says which one, on which machine.
        """
        with holding(self.path / "lock") as holder:
            if holder is not None:
                raise InputError(
                    f"{self.path} is being trained by {holder}; wait for it, or stop it and give "
                    "the same command again to continue."
                )
            yield

    def is_locked(self) -> bool:
        """Whether a process is training here now."""
        return is_held(self.path / "lock")

    def write_config(self, text: str) -> None:
        """Write the resolved configuration (YAML text)."""
        write_atomic(self.path / "config.yaml", text.encode())

    def add_provenance(self, entry: Mapping[str, Any]) -> None:
        """Append one process's `provenance()`; its diff becomes a file that can be applied."""
        earlier = self.provenance()
        diff = entry.get("diff") or ""
        name = f"diff_{len(earlier) + 1}.patch" if earlier else "diff.patch"
        if diff:
            write_atomic(self.path / name, diff.encode())
        plain = {**entry, "diff": name if diff else None}
        self._write_json("provenance.json", [*earlier, plain])

    def provenance(self) -> list[dict[str, Any]]:
        """Entries of all processes that worked on this run, first one first."""
        entries = self._read_json("provenance.json")
        return list(entries) if entries else []

    def begin_at(self, step: int) -> None:
        """Note the step at which the last process of `provenance` began."""
        entries = self.provenance()
        self._write_json("provenance.json", [*entries[:-1], {**entries[-1], "from_step": step}])

    def describe(self, description: Description) -> None:
        """Write how a tracker shall show this run."""
        self._write_json("run.json", vars(description))

    def description(self) -> Description | None:
        """What `describe` wrote, or None."""
        plain = self._read_json("run.json")
        return None if plain is None else Description(**plain)

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
            file.write(json.dumps(line, allow_nan=False) + "\n")

    def lines(self) -> list[MetricLine]:
        """Lines of ``metrics.jsonl`` in order; one cut short by a crash is left out."""
        path = self.path / "metrics.jsonl"
        if not path.exists():
            return []
        whole, newline, _ = path.read_text().rpartition("\n")
        return [metric_line(text) for text in (whole + newline).splitlines()]

    def truncate_after(self, step: int) -> None:
        """Drop what a run that resumes at `step` will write again.

        These are the lines beyond `step`, every "test" line (the last evaluation is repeated) and
        a line cut short by a crash.
        """
        kept = [line for line in self.lines() if line.step <= step and line.kind != "test"]
        plain = (
            {
                **vars(line),
                "values": {k: None if math.isnan(v) else v for k, v in line.values.items()},
            }
            for line in kept
        )
        text = "".join(json.dumps(line) + "\n" for line in plain)
        write_atomic(self.path / "metrics.jsonl", text.encode())

    def counts_path(self, split: str) -> Path:
        """Where the counts of a split lie."""
        return self.path / f"counts_{split}.npz"

    def figure_path(self, name: str) -> Path:
        """Where the picture `name` lies; the folder exists afterwards."""
        folder = self.path / "figures"
        folder.mkdir(exist_ok=True)
        return folder / f"{name}.png"

    def write_tables(self, tables: Mapping[str, Any]) -> None:
        """Write the tables (`ResultTables.to_json`)."""
        self._write_json("tables.json", tables)

    def tables(self) -> dict[str, Any] | None:
        """What `write_tables` wrote last, or None."""
        plain = self._read_json("tables.json")
        return None if plain is None else dict(plain)

    def finish(self, result: Mapping[str, Any]) -> None:
        """Mark the run as finished; everything else must be written before."""
        self._write_json("result.json", result)

    def result(self) -> dict[str, Any] | None:
        """What the finished run returned; None while it is not finished."""
        plain = self._read_json("result.json")
        return None if plain is None else dict(plain)

    def _write_json(self, name: str, value: Any) -> None:
        write_atomic(self.path / name, (json.dumps(value, indent=1) + "\n").encode())

    def _read_json(self, name: str) -> Any:
        path = self.path / name
        if not path.exists():
            return None
        try:
            return json.loads(path.read_text())
        except json.JSONDecodeError as error:
            raise InputError(f"{path} is not JSON ({error}); remove it or the run.") from error


def metric_line(text: str) -> MetricLine:
    """One line of ``metrics.jsonl``, read."""
    plain = json.loads(text)
    values = {name: math.nan if v is None else float(v) for name, v in plain["values"].items()}
    return MetricLine(plain["step"], plain["kind"], plain["time"], values)


def runs_in(runs_dir: Path | str) -> list[RunFolder]:
    """Every run folder directly inside `runs_dir`, by name.

    Raises:
        InputError: there is no such folder.
    """
    root = Path(runs_dir)
    if not root.is_dir():
        raise InputError(f"{root}: there is no such folder; runs_dir=... names the folder of runs.")
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
        if _sent_as(sent) == run:
            return sent.parent.resolve()
    raise InputError(
        f"run={run}: neither a run folder (with a config.yaml), nor a key or an MLflow run id in "
        f"{runs_dir.resolve()}; list that folder to see the runs, or name another with runs_dir=..."
    )


def _sent_as(sent: Path) -> str | None:
    """The MLflow run id in ``mlflow.json``; None where the file is damaged."""
    try:
        found = json.loads(sent.read_text())
    except ValueError:
        return None
    return found.get("run_id") if isinstance(found, dict) else None
