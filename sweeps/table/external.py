"""Rows of a table that are evaluated and not trained: files of weights, folders of predictions.

The command line names them as ``weights.ROW=FILE`` and ``predictions.ROW=FOLDER``. Their counts are
in ``<runs_dir>/external/<hash>/`` with the names that counts of a run have: each file is there, or
its command is run. The hash covers the content of the weights or predictions, the data set and the
overrides.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.component import build
from rgbt.config.compose import SEARCH_PATH, compose, own_folders, searching
from rgbt.config.options import with_home
from rgbt.config.overrides import composing
from rgbt.files.atomic import write_atomic
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import read_measurement
from rgbt.metrics.pair_list import PAIR_LIST
from rgbt.runs.provenance import code
from rgbt.runs.result import OWN, RunResult
from rgbt.terminal import info
from sweeps.evaluation import Words, command_of, stored_at
from sweeps.point import Outcome, Point
from sweeps.run.local import run_command
from sweeps.table.cells import is_counted, words_of
from sweeps.table.request import TableRequest
from sweeps.table.table import Row, Table

FOLDER = "external"  # inside the folder of runs
NODE_FILE = "of_the_table"  # file of conf/dataset and conf/metric, for the commands
# Overrides of the user that reach a row with a network of its own; others are for trainings.
MACHINE = ("data.", "trainer.accelerator=", "trainer.precision=", "trainer.threads=")

NEEDS_NETWORK = "needs the network: predictions of a folder are of clean images of both cameras"
NEEDS_PAIRS = (
    f"needs predictions of both frames and {PAIR_LIST} in the folder; write the images with rgbt "
    "consistency export=..."
)


@dataclass(frozen=True)
class ExternalRow:
    """A row whose counts are made from a file of weights, or a folder of predictions."""

    label: str
    kind: str  # "weights" or "predictions"
    path: Path


def row_named(word: str, table: Table) -> Row:
    """The row with this label, or with this number from 1 on; InputError: there is none."""
    rows = {str(number): row for number, row in enumerate(table.rows, start=1)}
    rows |= {row.label: row for row in table.rows}
    if word not in rows:
        labels = [row.label for row in table.rows]
        raise InputError(f"there is no row '{word}' in the table; {nearest(word, labels)}.")
    return rows[word]


def external_rows(words: Sequence[str], table: Table) -> tuple[list[ExternalRow], list[str]]:
    """The external rows in the order of the table, and all words that are not about them."""
    found: dict[str, ExternalRow] = {}
    others = []
    for word in words:
        kind, _, rest = word.partition(".")
        if kind not in ("weights", "predictions"):
            others.append(word)
            continue
        labels = [row.label for row in table.rows if rest.startswith(f"{row.label}=")]
        name = max(labels, key=len, default=rest.partition("=")[0])  # a label may hold "="
        row, path = row_named(name, table), Path(with_home(rest[len(name) + 1 :])).absolute()
        if not (path.is_file() if kind == "weights" else path.is_dir() and rest[len(name) + 1 :]):
            what = "file of weights" if kind == "weights" else "folder of label images"
            raise InputError(f"'{word}': expected {kind}.ROW=PATH with the path of a {what}.")
        if kind == "weights" and not row.network and row.experiment is None:
            raise InputError(f"'{word}': the row has no network; give predictions.ROW=FOLDER.")
        found[row.label] = ExternalRow(row.label, kind, path)
    return [found[row.label] for row in table.rows if row.label in found], others


@dataclass(frozen=True)
class ExternalRun:
    """The evaluations of an external row: `arguments` of each command, `folder` of the counts.

    Data set and regions are those of the row, or of the first row that can be run (`config`).
    """

    given: ExternalRow
    row: Row
    config: DictConfig
    arguments: tuple[str, ...]
    folder: Path

    @classmethod
    def of(
        cls, given: ExternalRow, request: TableRequest, base: Sequence[str], runs_dir: Path
    ) -> ExternalRun:
        """Weights are loaded into the network of `Row.network` at scale=paper, otherwise into that
        of the row's experiment at the scale of the table.
        """
        row = row_named(given.label, request.table)
        trained = row if row.experiment else next(iter(request.table.runnable_rows), row)
        words = (f"scale={request.scale}", *request.extra)
        if trained.experiment:
            experiment, *others = request.overrides(trained.label, 0)
            words = (experiment, f"scale={request.scale}", *others)
        with composing(words):
            config = compose([*base, *words])
            fingerprint = build(config.dataset).fingerprint()
            plain: Any = OmegaConf.to_container(config, resolve=True)
        arguments: tuple[str, ...] = (f"dataset={NODE_FILE}",)
        if given.kind == "weights" and row.network:
            machine = (word for word in request.extra if word.startswith(MACHINE))
            arguments = (*row.network, *arguments, *machine)
        elif given.kind == "weights":
            arguments = tuple(word for word in words if not word.startswith("model.weights="))
        description = {
            "content": content_hash(given.path),
            "dataset": [fingerprint, {**plain["dataset"], "root": None}],
            "metric": plain["metric"],
            "evaluated": [given.kind, *(w for w in arguments if not w.startswith("dataset.root="))],
        }
        text = json.dumps(description, sort_keys=True, indent=1)
        folder = runs_dir.absolute() / FOLDER / hashlib.sha256(text.encode()).hexdigest()[:12]
        for group in ("dataset", "metric"):
            file = folder / "conf" / group / f"{NODE_FILE}.yaml"
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(file, OmegaConf.to_yaml(OmegaConf.create(plain[group])).encode())
        write_atomic(folder / "external.json", text.encode())
        write_json(folder / "provenance.json", {"processes": [{**code(), "diff": None}]})
        return cls(given, row, config, arguments, folder)

    def outcome(self, table: Table, trust: str) -> Outcome:
        """The outcome with all counts that columns of `table` need; missing ones are made.

        "failed" if there are none; one that fails beside others is the reason of its columns alone.
        """
        columns = filter(is_counted, table.columns_of(self.row))
        needed = dict.fromkeys(words_of(column, table) for column in columns)
        result, reasons = RunResult(self.folder), dict[Words, str]()
        # Plain images first: other measurements of single frames are found by comparison with them.
        first = [] if all(map(_of_frames, needed)) else [()]
        for words in dict.fromkeys([*first, *needed]):
            if () in reasons:  # nothing else can be made of it
                reasons[words] = reasons[()]
            elif not self._has(result, words):
                what = " ".join(words) or "test"
                info(f"row '{self.row.label}': evaluating {self.given.path} ({what})")
                if reason := self._make(result, words, trust):
                    reasons[words] = reason
        point = Point(self.row.label, ())
        if all(words in reasons for words in needed):
            return Outcome(point, "failed", next(iter(reasons.values()), "no column is a score"))
        return Outcome(point, "finished", results=(result,), missing=reasons)

    def _has(self, result: RunResult, words: Words) -> bool:
        path = stored_at(result, words)
        return path is not None and (self.folder / path).is_file()

    def _make(self, result: RunResult, words: Words, trust: str) -> str:
        """Run the command that makes the counts of a measurement; why it failed, or ""."""
        command, reason = self._command(words)
        if reason:
            return reason
        log = self.folder / "log.txt"
        folders = ",".join(filter(None, (own_folders(), str(self.folder / "conf"))))
        with tempfile.TemporaryDirectory(dir=self.folder) as made:
            is_one = command[0] == "rgbt.evaluate"
            own = [f"trust={trust}"] if trust and self.given.kind == "weights" else []
            with searching([f"{SEARCH_PATH}=[{folders}]"]):
                out = f"out={made}/{OWN}" if is_one else f"out={made}"
                reason = run_command((*command, *own, out), log)
            found = sorted(Path(made).glob("*.npz"))
            if command[0] == "analysis.score":  # it cuts images in three ways
                metric = self._metric(words)
                found = [Path(made, f"counts_{metric.partition}{metric.regions}.npz")]
            for file in () if reason else found:
                name = f"evaluations/{read_measurement(file).file_name}" if words else OWN
                target = self.folder / name
                target.parent.mkdir(exist_ok=True)
                file.replace(target)
        if not reason and not self._has(result, words):
            reason = f"the command wrote no counts; see {log}"
        return reason

    def _command(self, words: Words) -> tuple[Words, str]:
        """The command of a measurement without its output, or the reason why there is none."""
        is_of_frames = _of_frames(words)
        is_cut = any(word.startswith("regions=") for word in words)
        regions = [] if is_cut else [f"metric={NODE_FILE}"]
        if self.given.kind == "weights":
            of_network = regions if self.row.network and not is_of_frames else []
            weights = f"model.weights={self.given.path}"
            return (*command_of(words), *self.arguments, *of_network, weights), ""
        of_folder = (f"predictions={self.given.path}", *self.arguments)
        if is_of_frames:
            has_pairs = (self.given.path / PAIR_LIST).is_file()
            return (*command_of(words), *of_folder), "" if has_pairs else NEEDS_PAIRS
        if any(not word.startswith("regions=") and word != "modality=rgbt" for word in words):
            return (), NEEDS_NETWORK
        metric = self._metric(words)
        if metric.get("aspect") == "released_3_4":
            return (), f"predictions are not counted in regions {metric.regions}; choose ring5"
        return ("analysis.score", "resamples=0", f"regions={metric.regions}", *of_folder), ""

    def _metric(self, words: Words) -> Any:
        """The node of the configuration that says how a measurement cuts images into regions."""
        names = [word.removeprefix("regions=") for word in words if word.startswith("regions=")]
        return compose([f"metric={names[0]}"]).metric if names else self.config.metric


def _of_frames(words: Words) -> bool:
    return any(word.startswith("frames=") for word in words)


def content_hash(path: Path) -> str:
    """SHA-256 of a file, or of names and contents of the files in a folder that are not hidden."""
    if path.is_file():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    inside = ((each, each.relative_to(path)) for each in sorted(path.rglob("*")) if each.is_file())
    shown = ((each, name) for each, name in inside if not any(p[0] == "." for p in name.parts))
    lines = [f"{content_hash(each)} {name.as_posix()}\n" for each, name in shown]
    return hashlib.sha256("".join(lines).encode()).hexdigest()
