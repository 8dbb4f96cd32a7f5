"""Fill one MLflow run from one run folder; later calls send only new data.

The folder's ``mlflow.json`` notes the last step that was sent per kind of line. A run that resumes
at an earlier step therefore does not send the same lines twice.
"""

from __future__ import annotations

import getpass
import hashlib
import json
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from rgbt.files.atomic import write_atomic
from rgbt.files.budgets import read_json, sealed
from rgbt.tracking.mlflow_client import MlflowStore
from rgbt.tracking.mlflow_inputs import inputs_digest, send_inputs
from rgbt.tracking.mlflow_metrics import later_scores, metrics_of, metrics_of_pairs, profile_of
from rgbt.tracking.mlflow_model import checkpoint_digest, send_model
from rgbt.tracking.replaced_runs import shown_description, shown_key
from rgbt.tracking.run_files import Description, read_provenance, read_result, read_tables
from rgbt.tracking.run_folder import RunFolder
from rgbt.tracking.tables import ResultTables, result_grids, subset_mious, without_nan
from rgbt.tracking.tracker import Status

NAME_LENGTH = 250
"""Characters of a run's name; PostgreSQL refuses more, SQLite does not."""

PARAM_LENGTH = 500
"""Characters of a parameter's value that are sent; MLflow's pages show far fewer."""

TAG_LENGTH = 5000

BATCH_LENGTH, BATCH_PARAMS = 1000, 100
"""Metrics and parameters in one call, MLflow's limits."""

FILES = (
    "config.yaml",
    "provenance.json",
    "result.json",
    "*.patch",
    "counts_*.npz",
    "evaluations/*.npz",
    "evaluations/robustness/*/*.npz",
    "evaluations/robustness/*/*.json",
    "figures/*.png",
)
TABLE_FILE = "tables/iou.json"


@dataclass
class UploadState:
    """The record of uploaded data of a run, stored in its folder as ``mlflow.json``.

    Attributes:
        uri: the store, passwords hidden.
        artifact_uri: where a new experiment keeps files, or None.
        experiment_id: "" before the first contact.
        run_id: "" before the first contact.
        steps: kind of line -> last step sent.
        files: path in the folder -> digest of the content sent.
        profile: whether the region profile was sent.
        later: scores of the result that no line holds and that were sent, e.g. "test/TC/aligned".
        shown: digest of name, tags, parameters and status that were sent; "" in older records.
        inputs: what identifies the data set that was sent; "" before.
        log_model: whether the best checkpoint is sent as a logged model.
        model: digest of the checkpoint that was sent so; "" before.
    """

    uri: str
    experiment: str
    artifact_uri: str | None = None
    experiment_id: str = ""
    run_id: str = ""
    steps: dict[str, int] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    profile: bool = False
    later: list[str] = field(default_factory=list)
    shown: str = ""
    inputs: str = ""
    log_model: bool = False
    model: str = ""


def read_upload_state(folder: RunFolder) -> UploadState | None:
    """The record of this folder, or None if nothing was sent.

    Raises:
        InputError: the file is damaged.
    """
    path = folder.path / "mlflow.json"
    advice = "remove the file; the MLflow run is then identified by its key"
    found: UploadState | None = read_json(path, UploadState, advice) if path.exists() else None
    return found


def write_upload_state(folder: RunFolder, sent: UploadState) -> None:
    """Write the record."""
    text = json.dumps(sealed(asdict(sent)), indent=1)
    write_atomic(folder.path / "mlflow.json", text.encode())


def upload(store: MlflowStore, folder: RunFolder, sent: UploadState, status: Status) -> None:
    """Bring the MLflow run of `folder` up to date; `sent` is changed and written.

    Args:
        store: open store.
        folder: its `describe` must have been called.
        sent: what that store has.
        status: the state to show.
    """
    description = shown_description(folder)
    assert description is not None, f"{folder.path}: describe() comes before upload()"
    run = _run_of(store, folder, sent, description)
    tables = read_tables(folder.path)
    every = folder.lines()
    lines = [line for line in every if line.step > sent.steps.get(line.kind, -1)]
    metrics = list(metrics_of(lines))
    if tables is not None and tables.split == "test" and not sent.profile:
        metrics += profile_of(tables, every)
        sent.profile = True
    later = later_scores(folder, every, sent.later)
    metrics += metrics_of_pairs(later, every)
    _send(store, folder, sent, (metrics, set(run.data.params), description, tables))
    sent.steps |= {line.kind: line.step for line in lines}
    sent.later += later
    _send_files(store, folder, sent, tables)
    if sent.inputs != (inputs := inputs_digest(folder.path)):
        send_inputs(store.client, sent.run_id, folder.path)
        sent.inputs = inputs
    if status == "FINISHED" and tables is not None and _lacks_model(folder, sent):
        send_model(store, sent.run_id, folder.path, len(tables.classes.names))
        sent.model = checkpoint_digest(folder.path)
    name = _short(description.name)
    if name != run.info.run_name:
        store.client.update_run(sent.run_id, name=name)
    if status == "RUNNING" and run.info.status != status:
        store.client.update_run(sent.run_id, status=status)
    elif status != run.info.status:
        written = (folder.path / each for each in ("result.json", "metrics.jsonl", "run.json"))
        end = max(path.stat().st_mtime for path in written if path.exists())
        store.client.set_terminated(sent.run_id, status=status, end_time=round(1000 * end))
    sent.shown = _shown(folder, description, tables, status)
    write_upload_state(folder, sent)


def is_up_to_date(folder: RunFolder, sent: UploadState, status: Status) -> bool:
    """Whether `upload` would send nothing, according to the record; MLflow is not imported."""
    description = shown_description(folder)
    if description is None or not sent.run_id:
        return False
    tables = read_tables(folder.path)
    every = folder.lines()
    return (
        sent.shown == _shown(folder, description, tables, status)
        and all(line.step <= sent.steps.get(line.kind, -1) for line in every)
        and (tables is None or tables.split != "test" or sent.profile)
        and not later_scores(folder, every, sent.later)
        and sent.inputs == inputs_digest(folder.path)
        and not _lacks_model(folder, sent)
        and not list(_changed_files(folder, sent, tables))
    )


def _lacks_model(folder: RunFolder, sent: UploadState) -> bool:
    """Whether the best checkpoint is to be logged as a model and was not."""
    return sent.log_model and sent.model != checkpoint_digest(folder.path)


def _shown(
    folder: RunFolder, description: Description, tables: ResultTables | None, status: Status
) -> str:
    """Digest of name, tags, parameters and status that the store shows."""
    tags = _tags(folder, description, tables)
    text = json.dumps([description.name, tags, description.params, status], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _run_of(
    store: MlflowStore, folder: RunFolder, sent: UploadState, description: Description
) -> Any:
    """The MLflow run of the folder: the one that ``mlflow.json`` names, an unnoted or a new one.

    A run that was deleted in the pages takes nothing more; its folder gets a new one.
    """
    from mlflow.exceptions import MlflowException

    try:
        run = store.client.get_run(sent.run_id) if sent.run_id else None
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise
        run = None
    if run is not None and run.info.lifecycle_stage == "active":
        return run
    # A process that was killed may have made the run without noting its id; it would stay in the
    # pages as running for ever. The start keeps runs of one key apart that were trained again.
    entry = (read_provenance(folder.path / "provenance.json") or [{}])[0]
    first = entry.get("started")
    seconds = time.time() if first is None else datetime.fromisoformat(first).timestamp()
    start = round(1000 * seconds)
    found = store.client.search_runs([store.experiment_id], f"attributes.start_time = {start}")
    # Compared here: MLflow's search cannot quote every path.
    tags = _identity(folder)
    run = next((each for each in found if tags.items() <= each.data.tags.items()), None)
    if run is None:
        run = store.client.create_run(
            store.experiment_id, start_time=start, tags=tags, run_name=_short(description.name)
        )
    sent.experiment_id, sent.run_id = store.experiment_id, run.info.run_id
    sent.steps, sent.files, sent.profile, sent.later, sent.shown = {}, {}, False, [], ""
    sent.inputs = sent.model = ""
    write_upload_state(folder, sent)
    return run


def _identity(folder: RunFolder) -> dict[str, str]:
    """Tags that are set in the call that makes a run, and by which it is found."""
    return {"rgbt.key": shown_key(folder), "rgbt.folder": str(folder.path)}


def _short(name: str) -> str:
    """A run's name as MLflow takes it; the whole one stays in the folder."""
    return name if len(name) <= NAME_LENGTH else f"{name[: NAME_LENGTH - 4]} ..."


def _send(
    store: MlflowStore,
    folder: RunFolder,
    sent: UploadState,
    found: tuple[list[Any], set[str], Description, ResultTables | None],
) -> None:
    """One call with metrics, tags and parameters; more only beyond MLflow's limits on one call."""
    from mlflow.entities import Param, RunTag

    metrics, known, description, tables = found
    # MLflow refuses to change a parameter.
    new = {name: value for name, value in description.params.items() if name not in known}
    params = [Param(name, value[:PARAM_LENGTH]) for name, value in new.items()]
    tags = _tags(folder, description, tables)
    client, run_id = store.client, sent.run_id
    client.log_batch(
        run_id,
        metrics=metrics[:BATCH_LENGTH],
        params=params[:BATCH_PARAMS],
        tags=[RunTag(name, value[:TAG_LENGTH]) for name, value in tags.items() if value],
    )
    for start in range(BATCH_LENGTH, len(metrics), BATCH_LENGTH):
        client.log_batch(run_id, metrics=metrics[start : start + BATCH_LENGTH])
    for start in range(BATCH_PARAMS, len(params), BATCH_PARAMS):
        client.log_batch(run_id, params=params[start : start + BATCH_PARAMS])


def _tags(
    folder: RunFolder, description: Description, tables: ResultTables | None
) -> dict[str, str]:
    """Tags of a run by name; those without a value are not sent."""
    first = (read_provenance(folder.path / "provenance.json") or [{}])[0]
    tags = {
        "mlflow.user": getpass.getuser(),
        "mlflow.source.type": "LOCAL",
        "mlflow.source.name": "rgbt",  # its pages show no more than the end of a path
        "rgbt.command": first.get("command", ""),
        "mlflow.source.git.commit": first.get("git_commit") or "",
        "rgbt.dataset": (read_result(folder.path) or {}).get("dataset", ""),
        **_identity(folder),
        **description.tags,
    }
    if tables is not None:
        tags["mlflow.note.content"] = "\n".join(g.to_markdown() for g in result_grids(tables))
        tags["mlflow.loggedArtifacts"] = json.dumps([{"path": TABLE_FILE, "type": "table"}])
    return tags


def artifact_table(tables: ResultTables) -> dict[str, list[Any]]:
    """The result in the form that MLflow's table view requires.

    That view groups by the first column, which must be unique, and compares the second between
    runs; it shows few rows on a screen, so summaries come first.

    Returns:
        ``columns`` and ``data``: row name, IoU in percent (for "Var" its own unit), accuracy.
    """
    classes, regions = tables.classes, tables.regions
    rows: list[tuple[str, float, float]] = [
        ("mIoU", 100 * regions.miou, math.nan),
        ("Var", regions.variance, math.nan),
    ]
    rows += [(f"mIoU {name}", 100 * v, math.nan) for name, v in subset_mious(classes).items()]
    pairs = zip(tables.region_names, regions.region_ious, strict=True)
    rows += [(f"mIoU {name}", 100 * iou, math.nan) for name, iou in pairs]
    triples = zip(classes.names, classes.ious, classes.accuracies, strict=True)
    rows += [(name, 100 * iou, 100 * accuracy) for name, iou, accuracy in triples]
    for name, by_region in zip(classes.names, classes.region_ious, strict=True):
        pairs = zip(tables.region_names, by_region, strict=True)
        rows += [(f"{name} / {region}", 100 * iou, math.nan) for region, iou in pairs]
    data = [[name, *without_nan([round(v, 2) for v in values])] for name, *values in rows]
    return {"columns": ["score", "IoU %", "accuracy %"], "data": data}


def _send_files(
    store: MlflowStore, folder: RunFolder, sent: UploadState, tables: ResultTables | None
) -> None:
    """Upload the table and files that are new or changed, under their path in the folder."""
    for name, digest in _changed_files(folder, sent, tables):
        if name == TABLE_FILE and tables is not None:
            text = json.dumps(artifact_table(tables))
            store.client.log_text(sent.run_id, text, TABLE_FILE)
        else:
            parent = None if "/" not in name else str(Path(name).parent)
            store.client.log_artifact(sent.run_id, str(folder.path / name), parent)
        sent.files[name] = digest


def _changed_files(
    folder: RunFolder, sent: UploadState, tables: ResultTables | None
) -> Iterator[tuple[str, str]]:
    """Path in the folder and digest of the table and of files that are new or changed."""
    if tables is not None:
        text = json.dumps(artifact_table(tables))
        digest = hashlib.sha256(text.encode()).hexdigest()
        if sent.files.get(TABLE_FILE) != digest:
            yield TABLE_FILE, digest
    for path in sorted(found for pattern in FILES for found in folder.path.glob(pattern)):
        name = str(path.relative_to(folder.path))
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if sent.files.get(name) != digest:
            yield name, digest
