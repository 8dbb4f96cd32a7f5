"""The run folder, which holds everything that tables, figures and MLflow need later.

`docs/reference/run-folder.md` lists its files. ``result.json`` is written last, by rename: a run is
finished exactly if it exists. A folder may come from a stranger: one with a link out of it is
refused wherever it is opened.
"""

from __future__ import annotations

import json
import math
import re
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, cast

from annotated_types import Len
from typing_extensions import TypedDict  # pydantic takes no other before Python 3.12

from rgbt.checks import InputError, one_line
from rgbt.files.atomic import (
    holder_of,
    holding,
    is_held,
    naming_full_disk,
    remove_left_behind,
    write_atomic,
)
from rgbt.files.plain_files import (
    UNLIKE_SEAL,
    check_links,
    parse_json,
    read_json,
    sealed_text,
    write_json,
)
from rgbt.tables import ResultTables
from rgbt.terminal import info, warn

Kind = Literal["train", "val", "test"]

ADVICE = "restore it from a copy, or remove the run's folder to train it again"

# Folder and tag of finished runs that another training of the same key replaced (``fresh=true``),
# and the tag that the seeds of one configuration share.
REPLACED, REPLACED_TAG = "replaced", "rgbt.replaced"
GROUP, EXPERIMENT, SEED = "rgbt.group", "rgbt.experiment", "rgbt.seed"  # tags of every run


@dataclass(frozen=True)
class MetricLine:
    """One line of ``metrics.jsonl``.

    Attributes:
        step: optimiser steps done; increases strictly within a kind.
        kind: "train" (a logged step), "val" (an evaluation on the way), "test" (the last one).
        time: seconds since 1970.
        values: by name of the metric; NaN is written as null.
    """

    step: int
    kind: Kind
    time: float
    values: dict[str, float]

    @classmethod
    def read_all(cls, lines: Sequence[bytes]) -> list[MetricLine]:
        """Return the lines as objects; ValueError where one is damaged."""
        if any(line != _sealed_line(line[:-SEAL_LENGTH]) for line in lines):
            raise ValueError(UNLIKE_SEAL)
        bodies = (line[:-SEAL_LENGTH] + b"}" for line in lines)
        text = b"[" + b",".join(bodies).replace(b": null", b": NaN") + b"]"
        found = cast("list[MetricLine]", parse_json(text, list[cls]))  # type: ignore[valid-type]
        if len(found) != len(lines):
            raise ValueError("expected one object in each line")
        return found

    def text(self) -> bytes:
        """Return the line as it is written, with the checksum of its bytes as the last entry."""
        finite = {key: v if math.isfinite(v) else None for key, v in self.values.items()}
        body = json.dumps({**vars(self), "values": finite}).encode()
        return _sealed_line(body[:-1]) + b"\n"


def _sealed_line(body: bytes) -> bytes:
    return body + f', "crc32": "{zlib.crc32(body):08x}"}}'.encode()


# The end of a line of `MetricLine`, and its length.
SEALED = re.compile(rb', "crc32": "[0-9a-f]{8}"}')
SEAL_LENGTH = len(_sealed_line(b""))


@dataclass(frozen=True)
class Description:
    """``run.json``: how a tracker shows the run, and the overrides of its command."""

    name: str
    tags: dict[str, str]
    params: dict[str, str]
    overrides: list[str] = field(default_factory=list)


def lists_of(params: Mapping[str, str]) -> str:
    """Return which lists a run was trained and its checkpoint selected on, of its parameters.

    "trained on train.txt + val.txt, selected on val.txt"; a split without a list by its name.
    """

    def named(split: str) -> str:
        lists = (params.get(f"dataset.{key}.{split}") for key in ("splits", "lists", "folders"))
        found = next(filter(None, lists), split)
        return " + ".join(re.findall(r"[^\[\]', ]+", found)) if found[0] == "[" else found

    selected = f"selected on {named(params.get('trainer.selection_split', 'val'))}"
    if params.get("trainer.tested") == "last":
        selected = "last checkpoint"
    return f"trained on {named(params.get('domains.source.split', 'train'))}, {selected}"


class ResultForm(TypedDict, total=False):
    """``result.json`` (`rgbt.training.train`)."""

    name: str
    key: str
    dataset: str
    steps: int
    best_step: int
    best_score: float
    seconds_of_last_process: float
    skipped: list[str]
    val: dict[str, float | None]
    test: dict[str, float | None]


class Marker(TypedDict):
    """``dataset.json``: digests of names and files of the images, and what `auto` found in them."""

    names: str
    files: str
    thermal_range: NotRequired[tuple[float, float]]


# ``provenance.json``: an entry of every process; a list of them in the archive.
PROVENANCE = Annotated[dict[Literal["processes"], list[dict[str, Any]]], Len(1)]


def is_finished(folder: Path) -> bool:
    """Say whether the run in `folder` is finished."""
    return (folder / "result.json").is_file()


def run_key(folder: Path) -> str:
    """Return the config key of the run in `folder`, which may be a replaced one: ``<key>-<n>``."""
    is_replaced = folder.parent.name == REPLACED
    return folder.name.rpartition("-")[0] if is_replaced else folder.name


def counts_name(split: str) -> str:
    """Return the name of the file of the counts that a run ended with."""
    return f"counts_{split}.npz"


def read_result(folder: Path) -> dict[str, Any] | None:
    """Read ``result.json``; None: not finished. This and the others: InputError if damaged."""
    return cast("dict[str, Any] | None", _read(folder / "result.json", ResultForm))


def read_description(folder: Path) -> Description | None:
    """Read ``run.json``; None: there is none."""
    return cast("Description | None", _read(folder / "run.json", Description))


def read_marker(folder: Path) -> Marker | None:
    """Read ``dataset.json``; None: there is none."""
    return cast("Marker | None", _read(folder / "dataset.json", Marker))


def read_tables(folder: Path) -> ResultTables | None:
    """Read ``tables.json``; None: there is none."""
    path = folder / "tables.json"
    plain = _read(path, dict[str, Any])
    try:
        return None if plain is None else ResultTables.from_json(plain)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({one_line(error)}); {ADVICE}.") from error


def read_provenance(file: Path) -> list[dict[str, Any]]:
    """Read a ``provenance.json``: an entry per process, the first one first; [] without a file."""
    found = _read(file, PROVENANCE | list[dict[str, Any]])
    entries = found["processes"] if isinstance(found, dict) else found or []
    return cast("list[dict[str, Any]]", entries)


def _read(path: Path, form: Any) -> Any:
    return read_json(path, form, ADVICE) if path.exists() else None


class RunFolder:
    """Writes one run's folder, made where it does not exist; InputError for a link out of it.

    Of several processes that train a run, one opens it with `writes`. In the others it can be read,
    and what would write does nothing.
    """

    def __init__(self, path: Path | str, *, writes: bool = True) -> None:
        self.path = Path(path).resolve()
        self.writes = writes
        if writes:
            self.path.mkdir(parents=True, exist_ok=True)
            check_links(self.path)

    def _write(self, name: str, content: bytes) -> None:
        if self.writes:
            write_atomic(self.path / name, content)

    def _write_json(self, name: str, value: Mapping[str, Any]) -> None:
        if self.writes:
            write_json(self.path / name, value)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock this folder for training, and remove incomplete files of a killed process.

        InputError where another process trains here; the message names it and its machine.
        """
        before = holder_of(self.path / "lock")
        with holding(self.path / "lock") as holder:
            if holder is not None:
                advice = "Wait for it, or stop it and rerun the command to resume."
                raise InputError(f"{self.path} is being trained by {holder}. {advice}")
            remove_left_behind(self.path, before)
            yield

    def clean(self) -> None:
        """Remove incomplete files of a killed process, unless another process trains here."""
        with suppress(InputError), self.lock():
            pass

    def is_locked(self) -> bool:
        """Say whether a process is training here now."""
        return is_held(self.path / "lock")

    def write_config(self, text: str) -> None:
        """Write the resolved configuration (YAML text), sealed."""
        self._write("config.yaml", sealed_text(text.encode()))

    def add_provenance(self, entry: Mapping[str, Any]) -> None:
        """Append one process's `provenance()`; its diff becomes a file that can be applied."""
        before = read_provenance(self.path / "provenance.json")
        diff = entry.get("diff") or ""
        name = f"diff_{len(before) + 1}.patch" if before else "diff.patch"
        if diff:
            self._write(name, diff.encode())
        entries = [*before, {**entry, "diff": name if diff else None}]
        self._write_json("provenance.json", {"processes": entries})

    def describe(self, description: Description) -> None:
        """Write name, tags and parameters of this run for trackers."""
        self._write_json("run.json", vars(description))

    def append(self, step: int, kind: Kind, values: Mapping[str, float]) -> None:
        """Add one line to ``metrics.jsonl`` and hand it to the operating system at once."""
        if not self.writes:
            return
        plain = {name: float(value) for name, value in values.items()}
        path = self.path / "metrics.jsonl"
        with naming_full_disk(path), path.open("ab") as file:
            file.write(MetricLine(step, kind, round(time.time(), 3), plain).text())

    def lines(self) -> list[MetricLine]:
        """Read ``metrics.jsonl``; InputError for a damaged line, but not for a cut last one."""
        path = self.path / "metrics.jsonl"
        *whole, last = path.read_bytes().split(b"\n") if path.exists() else [b""]
        if SEALED.search(last):  # whole but for its end
            whole.append(last)
        try:
            return MetricLine.read_all(whole) if whole else []
        except ValueError:
            return [self._line(number, text) for number, text in enumerate(whole, 1)]

    def _line(self, number: int, text: bytes) -> MetricLine:
        try:
            return MetricLine.read_all([text])[0]
        except ValueError as error:
            what = f"{self.path / 'metrics.jsonl'} is damaged (line {number}: {one_line(error)})"
            raise InputError(f"{what}; delete the line.") from error

    def truncate_after(self, step: int, evaluated_step: int | None = None) -> list[MetricLine]:
        """Remove the lines that a run resuming at `step` will write again.

        These are the lines beyond `step`, "val" lines beyond `evaluated_step` (None: `step`), every
        "test" line (the last evaluation is repeated), and a line cut short by a crash.

        Returns:
            the lines before.
        """
        found = self.lines()
        ends = {"train": step, "val": step if evaluated_step is None else evaluated_step}
        kept = (line.text() for line in found if line.step <= ends.get(line.kind, -1))
        self._write("metrics.jsonl", b"".join(kept))
        return found

    def figure_path(self, name: str) -> Path:
        """Return the path of the picture `name`; its folder is made."""
        folder = self.path / "figures"
        folder.mkdir(exist_ok=True)
        return folder / f"{name}.png"

    def write_tables(self, tables: ResultTables) -> None:
        """Write the tables."""
        self._write_json("tables.json", tables.to_json())

    def finish(self, result: Mapping[str, Any]) -> None:
        """Mark the run as finished; everything else must be written before."""
        self._write_json("result.json", result)

    def mark(self, marker: Marker) -> None:
        """Write ``dataset.json``, which identifies the images."""
        self._write_json("dataset.json", marker)


def runs_in(runs_dir: Path | str) -> list[RunFolder]:
    """Return every run folder in `runs_dir`, by name, with a warning for one that is refused."""
    root, found = Path(runs_dir), []
    if not root.is_dir():
        raise InputError(f"runs_dir={root}: the folder does not exist.")
    for path in sorted(root.glob("*/run.json")):
        try:
            found.append(RunFolder(path.parent))
        except InputError as error:
            warn(f"{path.parent} is left out: {error}")
    return found


def find_run(run: str, runs_dir: Path) -> Path:
    """Find the folder of a run by folder, key or MLflow run id; InputError: there is none."""
    for folder in (Path(run), runs_dir / run):
        if (folder / "config.yaml").is_file():
            return RunFolder(folder).path
    for sent in sorted((*runs_dir.glob("*/mlflow.json"), *runs_dir.glob("replaced/*/mlflow.json"))):
        with suppress(InputError):  # a damaged file does not identify a run
            if (_read(sent, dict[str, Any]) or {}).get("run_id") == run:
                return RunFolder(sent.parent).path
    where = f"a key or an MLflow run id in runs_dir={runs_dir.resolve()}"
    raise InputError(f"run={run} is neither a run folder (with a config.yaml), nor {where}.")


def set_aside(folder: RunFolder) -> RunFolder | None:
    """Move a finished run to ``<runs_dir>/replaced/<key>-<n>``, where run=FOLDER opens it.

    Returns its new folder, for the tracker; None where the run is not finished (any more).
    """
    with folder.lock():
        if not is_finished(folder.path):
            return None
        home, number = folder.path.parent / REPLACED, 1
        while (kept := home / f"{folder.path.name}-{number}").exists():
            number += 1
        home.mkdir(exist_ok=True)
        folder.path.rename(kept)
    info(f"the finished run was moved to {kept}; open it with run={kept}.")
    return RunFolder(kept)


def runs_dir_of(folder: RunFolder) -> Path:
    """Return the folder of runs that a run belongs to, replaced or not."""
    return folder.path.parents[folder.path.parent.name == REPLACED]


def shown_key(folder: RunFolder) -> str:
    """Return the key of a run as a tracker shows it: `<key>`, or `replaced/<key>-<n>`."""
    return str(folder.path.relative_to(runs_dir_of(folder)))


def shown_description(folder: RunFolder) -> Description | None:
    """Describe a run for a tracker; a replaced one is in no group, and its key is its folder."""
    known = read_description(folder.path)
    if known is None or folder.path.parent.name != REPLACED:
        return known
    group = f"{known.tags.get(GROUP, known.name)} (replaced)"
    tags = {**known.tags, REPLACED_TAG: "true", GROUP: group, "rgbt.key": shown_key(folder)}
    return replace(known, name=f"{known.name} (replaced)", tags=tags)
