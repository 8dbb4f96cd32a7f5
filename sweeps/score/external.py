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

from analysis.uncertainty.contrasts import FIXED
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import SEARCH_PATH, compose, own_folders, searching
from rgbt.config.overrides import composing
from rgbt.files.atomic import write_atomic
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import read_measurement
from rgbt.metrics.pair_list import PAIR_LIST
from rgbt.runs.provenance import code
from rgbt.runs.result import OWN, RunResult
from rgbt.terminal import info
from sweeps.plan.measurement import Words, command_of, stored_at
from sweeps.plan.request import ExternalRow, RowSeed, TableRequest, row_named
from sweeps.plan.table import Row, Table, is_counted, words_of
from sweeps.point import Outcome, Point
from sweeps.run.local import run_command
from sweeps.score.reader import EXTERNAL

FOLDER = "external"  # inside the folder of runs
NODE_FILE = "of_the_table"  # file of conf/dataset and conf/metric, for the commands
# Overrides of the user that reach a row with a network of its own; others are for trainings.
MACHINE = ("data.", "trainer.accelerator=", "trainer.precision=", "trainer.threads=")

NEEDS_NETWORK = "needs the network: predictions of a folder are of clean images of both cameras"
NEEDS_PAIRS = (
    f"needs predictions of both frames and {PAIR_LIST} in the folder; write the images with rgbt "
    "consistency export=..."
)


def evaluate_external(
    request: TableRequest, base: Sequence[str], runs_dir: Path, trust: str
) -> dict[RowSeed, Outcome]:
    """Count the rows that are not trained, and return their outcomes.

    `base` are overrides that all runs have. InputError: a path that does not fit its row.
    """
    outcomes: dict[RowSeed, Outcome] = {}
    for given in request.external:
        run = ExternalRun.of(given, request, base, runs_dir)
        outcomes[given.label, FIXED] = run.outcome(request.table, trust)
    return outcomes


@dataclass(frozen=True)
class ExternalRun:
    """The evaluations of an external row.

    Attributes:
        config: of the data set and regions: of the row, or of the first row that can be run.
        arguments: of each command.
        folder: of the counts.
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
        """Name the commands of a row by all that its counts depend on, and write their nodes.

        Weights are loaded into the network of `Row.network` at scale=paper, otherwise into that of
        the row's experiment at the scale of the table.
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
        kept = [word for word in arguments if not word.startswith("dataset.root=")]
        description = {
            "content": content_hash(given.path),
            "dataset": [fingerprint, {**plain["dataset"], "root": None}],
            "metric": plain["metric"],
            "evaluated": [given.kind, *kept],
            "scale": "paper" if row.network and given.kind == "weights" else request.scale,
        }
        text = json.dumps(description, sort_keys=True, indent=1)
        folder = runs_dir.absolute() / FOLDER / hashlib.sha256(text.encode()).hexdigest()[:12]
        for group in ("dataset", "metric"):
            file = folder / "conf" / group / f"{NODE_FILE}.yaml"
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(file, OmegaConf.to_yaml(OmegaConf.create(plain[group])).encode())
        write_atomic(folder / EXTERNAL, text.encode())
        write_json(folder / "provenance.json", {"processes": [{**code(), "diff": None}]})
        return cls(given, row, config, arguments, folder)

    def outcome(self, table: Table, trust: str) -> Outcome:
        """Make the counts that columns of `table` need and lack, and return the outcome.

        A measurement that fails beside others is the reason of its columns alone. InputError: all
        fail.
        """
        needed: dict[Words, None] = {}
        for column in table.columns_of(self.row):
            if is_counted(column):
                needed[words_of(column, table)] = None
        result = RunResult(self.folder)
        reasons: dict[Words, str] = {}
        # Plain images first: other measurements of single frames are found by comparison with them.
        has_images = not all(_of_frames(words) for words in needed)
        for words in ({(): None} if has_images else {}) | needed:
            if () in reasons:  # nothing else can be made of it
                reasons[words] = reasons[()]
            elif not self._has(result, words):
                what = " ".join(words) or "test"
                info(f"row '{self.row.label}': evaluating {self.given.path} ({what})")
                if reason := self._make(result, words, trust):
                    reasons[words] = reason
        if all(words in reasons for words in needed):
            reason = next(iter(reasons.values()), "no column is a score")
            raise InputError(f"row '{self.row.label}': {reason}")
        point = Point(self.row.label, ())
        return Outcome(point, "finished", results=(result,), missing=reasons)

    def _has(self, result: RunResult, words: Words) -> bool:
        path = stored_at(result, words)
        return path is not None and (self.folder / path).is_file()

    def _make(self, result: RunResult, words: Words, trust: str) -> str:
        """Run the command that makes the counts of a measurement; return why it failed, or ""."""
        command, reason = self._command(words)
        if reason:
            return reason
        log = self.folder / "log.txt"
        folders = ",".join(filter(None, (own_folders(), str(self.folder / "conf"))))
        with tempfile.TemporaryDirectory(dir=self.folder) as made:
            out = f"out={made}/{OWN}" if command[0] == "rgbt.evaluate" else f"out={made}"
            own = [f"trust={trust}"] if trust and self.given.kind == "weights" else []
            with searching([f"{SEARCH_PATH}=[{folders}]"]):
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
        """Return the command of a measurement without its output, or why there is none."""
        is_of_frames = _of_frames(words)
        if self.given.kind == "weights":
            is_cut = any(word.startswith("regions=") for word in words)
            is_usual = self.row.network and not is_of_frames and not is_cut
            regions = [f"metric={NODE_FILE}"] if is_usual else []
            weights = f"model.weights={self.given.path}"
            return (*command_of(words), *self.arguments, *regions, weights), ""
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
        names = [word.removeprefix("regions=") for word in words if word.startswith("regions=")]
        return compose([f"metric={names[0]}"]).metric if names else self.config.metric


def _of_frames(words: Words) -> bool:
    return any(word.startswith("frames=") for word in words)


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file, or of names and contents of a folder's files.

    Hidden files, and those in hidden folders, do not count.
    """
    if path.is_file():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    lines = []
    for file in sorted(path.rglob("*")):
        name = file.relative_to(path)
        is_hidden = any(part.startswith(".") for part in name.parts)
        if file.is_file() and not is_hidden:
            lines.append(f"{content_hash(file)} {name.as_posix()}\n")
    return hashlib.sha256("".join(lines).encode()).hexdigest()
