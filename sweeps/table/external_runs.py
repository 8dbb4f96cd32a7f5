"""Makes the counts of external rows by calling the commands, and keeps them for the next call.

They are in ``<runs_dir>/external/<hash>/``, with the names that counts of a run have. The hash
covers the content of the weights or predictions, the data set, and the overrides.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Unpack

from rgbt.checks import InputError
from rgbt.files.atomic import holding, write_atomic
from rgbt.metrics.counts import Counts
from rgbt.runs.provenance import code
from rgbt.runs.result import RunResult
from rgbt.terminal import info
from sweeps.point import Outcome, Point
from sweeps.table.cells import OWN_COUNTS
from sweeps.table.external import ExternalRow
from sweeps.table.external_data import Settings, TableData, data_of
from sweeps.table.external_evaluations import ExternalSource, PlannedEvaluation, hash_of
from sweeps.table.table import Table
from sweeps.worker.command_process import run_command
from sweeps.worker.running_trial import LOGS

FOLDER = "external"
"""Folder inside the folder of runs."""

DESCRIPTION = "external.json"
"""What the counts of a folder were made from; written before the first of them."""


def run_external(
    rows: Sequence[ExternalRow],
    table: Table,
    *,
    runs_dir: Path,
    dry_run: bool = False,
    **settings: Unpack[Settings],
) -> Mapping[str, Outcome]:
    """Evaluate external rows, or read the counts of a previous call.

    Weights are loaded into the network of `Row.network` at scale=paper, otherwise into that of the
    row's experiment at the scale of the table. The data set is that of the table's rows with
    `extra`. Of the other words in `extra`, a row with `Row.network` uses those of
    `external_evaluations.MACHINE`.

    Args:
        rows: what is evaluated.
        table: its columns name the evaluations.
        runs_dir: folder of runs.
        dry_run: whether missing counts are only reported as "waiting".
        settings: of the table's rows, see `Settings`.

    Returns:
        label -> its run: "failed" if no evaluation of the row gave counts. An evaluation that
        fails beside others is the reason of its columns alone.

    Raises:
        InputError: the data set or the overrides of a row are wrong.
    """
    if not rows:
        return {}
    data = data_of(table, settings)
    return {
        given.label: _run(
            ExternalSource.of(given, table, data, settings), runs_dir.absolute(), dry_run=dry_run
        )
        for given in rows
    }


def check_external(runs: Mapping[str, Outcome]) -> None:
    """Refuse external rows that could not be evaluated, before anything is trained.

    Raises:
        InputError: naming the first such row, with its reason.
    """
    for label, run in runs.items():
        if run.state == "failed":
            raise InputError(f"row '{label}': {run.reason}")


def _run(source: ExternalSource, runs_dir: Path, *, dry_run: bool) -> Outcome:
    description = source.description()
    folder, point = runs_dir / FOLDER / hash_of(description), Point(source.row.label, ())
    plans = list(source.evaluations())
    missing = [plan for plan in plans if plan.command and not _has(folder, plan, source.data)]
    if dry_run and missing:
        return Outcome(point, "waiting")
    reasons = {plan.path: plan.reason for plan in plans if plan.reason}
    if missing:
        folder.mkdir(parents=True, exist_ok=True)
        with holding(folder / "lock", wait_s=math.inf):
            noted = {**description, "path": str(source.given.path)}
            write_atomic(folder / DESCRIPTION, json.dumps(noted, indent=2).encode())
            write_atomic(
                folder / "provenance.json", json.dumps([{**code(), "diff": None}]).encode()
            )
            reasons |= _evaluate(missing, source, folder)
    if len(reasons) == len(plans):  # also without any evaluation
        first = next((reasons[plan.path] for plan in (*missing, *plans)), "no column is a score")
        return Outcome(point, "failed", first)
    return Outcome(point, "finished", results=(RunResult(folder),), missing=reasons)


def _evaluate(
    missing: Sequence[PlannedEvaluation], source: ExternalSource, folder: Path
) -> Iterator[tuple[str, str]]:
    """Make the missing counts; yields (path, reason) of those that could not be made."""
    log = folder.parents[1] / LOGS / f"{FOLDER}-{folder.name}.log"
    for plan in missing:
        if _has(folder, plan, source.data):  # made with another evaluation, or by another process
            continue
        info(f"row '{source.row.label}': evaluating {source.given.path} ({plan.label})")
        reason = _make(plan, source, folder, log)
        if reason:
            yield plan.path, reason
            if plan.path == OWN_COUNTS:  # nothing else can be made of it
                yield from ((other.path, reason) for other in missing[1:])
                return


def _make(plan: PlannedEvaluation, source: ExternalSource, folder: Path, log: Path) -> str:
    """Run one command in a folder of its own and move its counts; why it failed, or ""."""
    working = folder / "partial"
    shutil.rmtree(working, ignore_errors=True)
    working.mkdir()
    try:
        reason = run_command((*plan.command, f"out={working / plan.out}"), log)
        if not reason and not _is_counted_on(working / plan.made, source.data):
            reason = f"the command wrote no counts of {source.data.files['dataset']}; see {log}"
        if reason:
            return reason
        for path in sorted(working.glob("*.npz")):
            name = plan.path if path.name == plan.made else f"evaluations/{path.name}"
            if name == plan.path or path.name.startswith("consistency_"):
                (folder / name).parent.mkdir(exist_ok=True)
                path.replace(folder / name)
    finally:
        shutil.rmtree(working, ignore_errors=True)
    return ""


def _has(folder: Path, plan: PlannedEvaluation, data: TableData) -> bool:
    return _is_counted_on(folder / plan.path, data)


def _is_counted_on(path: Path, data: TableData) -> bool:
    """Whether `path` holds counts of the test split of the data set."""
    try:
        counts = Counts.load(path)
    except InputError:
        return False
    return counts.split == "test" and counts.dataset == data.fingerprint
