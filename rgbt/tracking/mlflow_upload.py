"""Fills one MLflow run from one run folder; called again, it sends only what is new.

What was sent is remembered in the folder's ``mlflow.json``: per kind of line the last step, so that
a run which resumes at an earlier step and writes the same lines again does not send them twice.
"""

from __future__ import annotations

import getpass
import hashlib
import json
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rgbt.files.atomic import write_atomic
from rgbt.files.budgets import read_json, sealed
from rgbt.metrics import names
from rgbt.metrics.names import shown
from rgbt.tracking.mlflow_client import MlflowStore
from rgbt.tracking.mlflow_run import identity, new_run, noted_run, short_name, unnoted_run
from rgbt.tracking.replaced_runs import shown_description
from rgbt.tracking.run_files import read_provenance, read_result, read_tables
from rgbt.tracking.run_folder import MetricLine, RunFolder
from rgbt.tracking.tables import ResultTables, result_grids, without_nan
from rgbt.tracking.tracker import Status

PARAM_LENGTH = 500
"""Characters of a parameter's value that are sent; MLflow's pages show far fewer."""

BATCH_LENGTH = 1000
"""Metrics in one call, MLflow's limit."""

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
    """What was uploaded of a run; kept in its folder as ``mlflow.json``.

    Attributes:
        uri: the store, passwords hidden.
        artifact_uri: where a new experiment keeps files, or None.
        experiment_id: "" before the first contact.
        run_id: "" before the first contact.
        steps: kind of line -> last step sent.
        files: path in the folder -> digest of the content sent.
        profile: whether the region profile was sent.
        later: scores of the result that no line holds and that were sent, e.g. "test/TC/aligned".
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


def read_upload_state(folder: RunFolder) -> UploadState | None:
    """What was sent from this folder, or None if nothing ever was.

    Raises:
        InputError: the file is damaged.
    """
    path = folder.path / "mlflow.json"
    advice = "remove it: the MLflow run is then found by its key"
    found: UploadState | None = read_json(path, UploadState, advice) if path.exists() else None
    return found


def write_upload_state(folder: RunFolder, sent: UploadState) -> None:
    """Remember what was sent."""
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
    known_params, seen, name = _find_run(store, folder, sent)
    tables = read_tables(folder.path)
    every = folder.lines()
    lines = [line for line in every if line.step > sent.steps.get(line.kind, -1)]
    metrics = list(_metrics(lines))
    if tables is not None and tables.split == "test" and not sent.profile:
        metrics += _profile(tables, every)
        sent.profile = True
    later = _later(folder, every, sent)
    metrics += later.values()
    _send(store, sent, (metrics, _params(folder, known_params), _tags(folder, tables)))
    sent.steps |= {line.kind: line.step for line in lines}
    sent.later += later
    _send_table(store, sent, tables)
    _send_files(store, folder, sent)
    description = shown_description(folder)
    if description is not None and short_name(description.name) != name:
        store.client.update_run(sent.run_id, name=short_name(description.name))
    if status == "RUNNING" and seen != status:
        store.client.update_run(sent.run_id, status=status)
    elif status != seen:
        store.client.set_terminated(sent.run_id, status=status, end_time=_end_time(folder))
    write_upload_state(folder, sent)


def _find_run(
    store: MlflowStore, folder: RunFolder, sent: UploadState
) -> tuple[set[str], str, str]:
    """Its parameters' names, status and name; the run is made if the store does not know it."""
    run = noted_run(store, sent.run_id)
    if run is None:
        run = unnoted_run(store, folder) or new_run(store, folder)
        sent.experiment_id, sent.run_id = store.experiment_id, run.info.run_id
        sent.steps, sent.files, sent.profile, sent.later = {}, {}, False, []
        write_upload_state(folder, sent)
    return set(run.data.params), str(run.info.status), str(run.info.run_name)


def _send(
    store: MlflowStore, sent: UploadState, entities: tuple[list[Any], list[Any], list[Any]]
) -> None:
    """One call with everything new; more only beyond MLflow's limits on one call."""
    metrics, params, tags = entities
    store.client.log_batch(
        sent.run_id, metrics=metrics[:BATCH_LENGTH], params=params[:100], tags=tags
    )
    for start in range(BATCH_LENGTH, len(metrics), BATCH_LENGTH):
        store.client.log_batch(sent.run_id, metrics=metrics[start : start + BATCH_LENGTH])
    for start in range(100, len(params), 100):
        store.client.log_batch(sent.run_id, params=params[start : start + 100])


def _metrics(lines: list[MetricLine]) -> Iterator[Any]:
    """Finite values as MLflow metrics.

    The time is the line's own: MLflow's databases drop a metric that is equal in every field, so
    that a batch sent again after a crash leaves no duplicate.
    """
    from mlflow.entities import Metric

    # The compare page draws the metric that came first: scores before losses.
    for line in sorted(lines, key=lambda line: ("test", "val", "train").index(line.kind)):
        last = line.kind == "test"
        prefix = "" if last else f"{line.kind}/"
        # The pages draw bars over runs for a metric that has step 0 only, else a line over steps.
        step = 0 if last else line.step
        for name, value in line.values.items():
            if math.isfinite(value):
                yield Metric(f"{prefix}{name}", shown(name, value), round(1000 * line.time), step)


def _later(folder: RunFolder, lines: list[MetricLine], sent: UploadState) -> dict[str, Any]:
    """Scores of pairs of frames in the result that no line holds and that were not sent yet.

    Those of the selection split, and those that `rgbt.consistency` added to a finished run.
    """
    from mlflow.entities import Metric

    result = read_result(folder.path)
    if result is None:
        return {}
    held = {f"{line.kind}/{name}" for line in lines if line.kind == "test" for name in line.values}
    found = {}
    for kind in ("val", "test"):
        for name, value in (result.get(kind) or {}).items():
            key = f"{kind}/{name}"
            if name.split("/")[0] not in (names.TC, names.CA) or key in held or key in sent.later:
                continue
            if value is not None:
                label = name if kind == "test" else key
                time_ms = round(1000 * lines[-1].time)
                found[key] = Metric(label, shown(name, value), time_ms, 0)
    return found


def _profile(tables: ResultTables, lines: list[MetricLine]) -> list[Any]:
    """IoU over the regions as a line: the step is the region's number."""
    from mlflow.entities import Metric

    times = [line.time for line in lines] or [time.time()]
    return [
        Metric(names.REGION_PROFILE, round(100 * iou, 2), round(1000 * times[-1]), region)
        for region, iou in enumerate(tables.regions.region_ious, start=1)
        if math.isfinite(iou)
    ]


def _params(folder: RunFolder, known: set[str]) -> list[Any]:
    """Parameters the run does not have yet; MLflow refuses to change one."""
    from mlflow.entities import Param

    description = shown_description(folder)
    params = {} if description is None else description.params
    return [Param(k, v[:PARAM_LENGTH]) for k, v in params.items() if k not in known]


def _tags(folder: RunFolder, tables: ResultTables | None) -> list[Any]:
    from mlflow.entities import RunTag

    description = shown_description(folder)
    first = (read_provenance(folder.path / "provenance.json") or [{}])[0]
    tags = {
        "mlflow.user": getpass.getuser(),
        "mlflow.source.type": "LOCAL",
        "mlflow.source.name": "rgbt",  # its pages show no more than the end of a path
        "rgbt.command": first.get("command", ""),
        "mlflow.source.git.commit": first.get("git_commit") or "",
        "rgbt.dataset": (read_result(folder.path) or {}).get("dataset", ""),
        **identity(folder),
        **({} if description is None else description.tags),
    }
    if tables is not None:
        tags["mlflow.note.content"] = "\n".join(g.to_markdown() for g in result_grids(tables))
        tags["mlflow.loggedArtifacts"] = json.dumps([{"path": TABLE_FILE, "type": "table"}])
    return [RunTag(name, value[:5000]) for name, value in tags.items() if value]


def artifact_table(tables: ResultTables) -> dict[str, list[Any]]:
    """The result as MLflow's table view wants it.

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
    rows += [(f"mIoU {name}", 100 * v, math.nan) for name, v in classes.subset_mious.items()]
    pairs = zip(tables.region_names, regions.region_ious, strict=True)
    rows += [(f"mIoU {name}", 100 * iou, math.nan) for name, iou in pairs]
    triples = zip(classes.names, classes.ious, classes.accuracies, strict=True)
    rows += [(name, 100 * iou, 100 * accuracy) for name, iou, accuracy in triples]
    for name, by_region in zip(classes.names, classes.region_ious, strict=True):
        pairs = zip(tables.region_names, by_region, strict=True)
        rows += [(f"{name} / {region}", 100 * iou, math.nan) for region, iou in pairs]
    data = [[name, *without_nan([round(v, 2) for v in values])] for name, *values in rows]
    return {"columns": ["score", "IoU %", "accuracy %"], "data": data}


def _send_table(store: MlflowStore, sent: UploadState, tables: ResultTables | None) -> None:
    if tables is None:
        return
    text = json.dumps(artifact_table(tables))
    digest = hashlib.sha256(text.encode()).hexdigest()
    if sent.files.get(TABLE_FILE) != digest:
        store.client.log_text(sent.run_id, text, TABLE_FILE)
        sent.files[TABLE_FILE] = digest


def _send_files(store: MlflowStore, folder: RunFolder, sent: UploadState) -> None:
    """Upload files that are new or changed, under their path in the folder."""
    for path in sorted(found for pattern in FILES for found in folder.path.glob(pattern)):
        inside = path.relative_to(folder.path)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if sent.files.get(str(inside)) != digest:
            parent = None if inside.parent == Path() else str(inside.parent)
            store.client.log_artifact(sent.run_id, str(path), parent)
            sent.files[str(inside)] = digest


def _end_time(folder: RunFolder) -> int:
    """Milliseconds since 1970 of the last thing the run wrote."""
    names = ("result.json", "metrics.jsonl", "run.json")
    times = [(folder.path / n).stat().st_mtime for n in names if (folder.path / n).exists()]
    return round(1000 * max(times))
