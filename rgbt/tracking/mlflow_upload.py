"""Fill one MLflow run from one run folder.

MLflow drops a metric that it has with the same step, time and value, so that a batch may be sent
again. The folder's ``mlflow.json`` notes what that does not cover: the last step of each kind of
line, because a run that resumes at an earlier step writes lines again at another time.
"""

from __future__ import annotations

import getpass
import json
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbt.files.plain_files import read_json, write_json
from rgbt.metrics import names
from rgbt.runs.folder import (
    Description,
    MetricLine,
    RunFolder,
    read_provenance,
    read_result,
    read_tables,
    shown_description,
    shown_key,
)
from rgbt.tables import ResultTables, result_grids, subset_mious, without_nan
from rgbt.tracking.mlflow_view import KIND_TAG
from rgbt.tracking.tracker import Status

if TYPE_CHECKING:
    from rgbt.tracking.mlflow_store import MlflowStore

# Characters of a run's name (PostgreSQL refuses more), of a parameter and of a tag.
NAME_LENGTH, PARAM_LENGTH, TAG_LENGTH = 250, 500, 5000

# Numbers in one call. MLflow takes 1000 metrics, parameters and tags together.
BATCH_METRICS, BATCH_PARAMS = 800, 100

FILES = (
    "config.yaml",
    "provenance.json",
    "result.json",
    "*.patch",
    "counts_*.npz",
    "figures/*.png",
    "evaluations/*.npz",
)
# Files whose content is sent in another form.
READ = ("run.json", "metrics.jsonl", "tables.json")

TABLE_FILE = "tables/iou.json"


@dataclass
class UploadState:
    """What a store has of a run, ``mlflow.json`` in its folder. It is never read for an address.

    Attributes:
        uri: the store, passwords hidden; `run_id` is "" before the first contact.
        steps: kind of line -> last step sent.
        sent: time (seconds since 1970) at which the last complete upload began.
    """

    uri: str
    experiment: str
    run_id: str = ""
    steps: dict[str, int] = field(default_factory=dict)
    sent: float = 0.0


@dataclass(frozen=True)
class Content:
    """What is sent of a folder beside its files.

    Attributes:
        description: name, tags and parameters.
        identity: tags that are set in the call that makes a run, and by which it is found.
        process: that began the run, of ``provenance.json``.
        result: of a finished run.
    """

    description: Description
    identity: dict[str, str]
    process: Mapping[str, Any]
    lines: list[MetricLine]
    tables: ResultTables | None
    result: Mapping[str, Any]

    @classmethod
    def of(cls, folder: RunFolder) -> Content:
        """Read from the folder of a run that was described before."""
        path, description = folder.path, shown_description(folder)
        assert description is not None, f"{path}: describe() comes before upload()"
        return cls(
            description=description,
            identity={KIND_TAG: "run", "rgbt.key": shown_key(folder), "rgbt.folder": str(path)},
            process=next(iter(read_provenance(path / "provenance.json")), {}),
            lines=folder.lines(),
            tables=read_tables(path),
            result=read_result(path) or {},
        )


def read_upload_state(folder: RunFolder) -> UploadState | None:
    """The record of this folder, or None if nothing was sent; InputError where it is damaged."""
    path = folder.path / "mlflow.json"
    advice = "remove the file; the MLflow run is then identified by its key"
    found: UploadState | None = read_json(path, UploadState, advice) if path.exists() else None
    return found


def write_upload_state(folder: RunFolder, state: UploadState) -> None:
    """Write the record."""
    write_json(folder.path / "mlflow.json", asdict(state))


def is_sent(folder: RunFolder, state: UploadState) -> bool:
    """Whether no file changed since the last complete upload; MLflow is not imported."""
    files = [*_own_files(folder), *(folder.path / name for name in READ)]
    # The time of a change, not that of the content: a copied file keeps an old one.
    last = max((path.lstat().st_ctime for path in files if path.exists()), default=math.inf)
    return bool(state.run_id) and last <= state.sent


def upload(store: MlflowStore, folder: RunFolder, state: UploadState, status: Status) -> None:
    """Bring the MLflow run of a folder up to date; `state` is changed and written.

    Args:
        store: open store.
        folder: described before; the lock ``mlflow.lock`` is held.
        state: what that store has.
        status: the state to show.

    Raises:
        InputError: a file is damaged. MLflow raises anything else.
    """
    from mlflow.entities import Param, RunTag

    # Taking the lock has written its file: the time by the clock of the folder's file system.
    began = (folder.path / "mlflow.lock").lstat().st_mtime
    content = Content.of(folder)
    client, name = store.client, content.description.name[:NAME_LENGTH]
    run = _run_of(store, folder, state, content)
    store.check_files(run.info.artifact_uri)

    metrics = list(_metrics(content, state))
    # MLflow refuses to change a parameter.
    new = {key: v for key, v in content.description.params.items() if key not in run.data.params}
    params = [Param(key, value[:PARAM_LENGTH]) for key, value in new.items()]
    tags = [RunTag(key, value[:TAG_LENGTH]) for key, value in _tags(content).items() if value]
    while metrics or params or tags:  # one call, except for many parameters or metrics
        client.log_batch(state.run_id, metrics[:BATCH_METRICS], params[:BATCH_PARAMS], tags)
        metrics, params, tags = metrics[BATCH_METRICS:], params[BATCH_PARAMS:], []
    for line in content.lines:  # a resumed run may be behind what was sent
        state.steps[line.kind] = max(line.step, state.steps.get(line.kind, -1))
    write_upload_state(folder, state)  # at once: a kill between doubles points after the resume
    for path in (each for each in _own_files(folder) if each.stat().st_ctime > state.sent):
        parent = path.parent.relative_to(folder.path).as_posix()
        client.log_artifact(state.run_id, str(path), None if parent == "." else parent)
    if content.tables is not None and (folder.path / "tables.json").stat().st_ctime > state.sent:
        client.log_text(state.run_id, json.dumps(artifact_table(content.tables)), TABLE_FILE)
    client.update_run(state.run_id, "RUNNING" if status == "RUNNING" else None, name)
    if status not in ("RUNNING", run.info.status):
        written = (folder.path / each for each in ("result.json", "metrics.jsonl", "run.json"))
        end = max(path.stat().st_mtime for path in written if path.exists())
        client.set_terminated(state.run_id, status=status, end_time=round(1000 * end))
    state.sent = began
    write_upload_state(folder, state)


def _run_of(store: MlflowStore, folder: RunFolder, state: UploadState, content: Content) -> Any:
    """The MLflow run that ``mlflow.json`` names; an unnoted or a new one if it was deleted."""
    from mlflow.exceptions import MlflowException

    try:
        run = store.client.get_run(state.run_id) if state.run_id else None
        if run is not None and run.info.lifecycle_stage == "active":
            return run
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise
    # A process that was killed may have made the run without noting its id. The start keeps runs of
    # one key apart that were trained again.
    first = content.process.get("started")
    seconds = time.time() if first is None else datetime.fromisoformat(first).timestamp()
    start, tags, name = round(1000 * seconds), content.identity, content.description.name
    found = store.client.search_runs([store.experiment_id], f"attributes.start_time = {start}")
    # Compared here: MLflow's search cannot quote every path. A store of one folder moves with it.
    known = {key: tags[key] for key in tags if not (store.files and key == "rgbt.folder")}
    run = next((each for each in found if known.items() <= each.data.tags.items()), None)
    run = run or store.client.create_run(store.experiment_id, start, tags, name[:NAME_LENGTH])
    state.run_id, state.steps, state.sent = run.info.run_id, {}, 0.0
    write_upload_state(folder, state)
    return run


def _own_files(folder: RunFolder) -> list[Path]:
    """Files to send: regular ones inside the folder, which no link leads to."""
    found = sorted(path for pattern in FILES for path in folder.path.glob(pattern))
    return [path for path in found if path.is_file() and path.resolve() == path]


def _metrics(content: Content, state: UploadState) -> Iterator[Any]:
    """Finite values of new lines, each with the time of its line, and what no line holds.

    The latter are the IoU over the regions (the step is the region's number), and scores of pairs
    of frames: of the selection split, and those that `rgbt.consistency` added to a finished run.
    """
    from mlflow.entities import Metric

    every, tables = content.lines, content.tables
    new = [line for line in every if line.step > state.steps.get(line.kind, -1)]
    # The compare page draws the metric that came first: scores before losses.
    for line in sorted(new, key=lambda line: ("test", "val", "train").index(line.kind)):
        # The pages draw bars over runs for a metric that has step 0 only, else a line over steps.
        prefix, step = ("", 0) if line.kind == "test" else (f"{line.kind}/", line.step)
        finite = {name: value for name, value in line.values.items() if math.isfinite(value)}
        for name, value in names.shown(finite).items():
            yield Metric(prefix + name, value, round(1000 * line.time), step)
    now = round(1000 * every[-1].time) if every else 0
    regions = tables.regions.region_ious if tables is not None and tables.split == "test" else ()
    for region, iou in enumerate(regions, start=1):
        if math.isfinite(iou):
            yield Metric(names.REGION_PROFILE, round(100 * iou, 2), now, region)
    known = {name for line in every if line.kind == "test" for name in line.values}
    for kind, prefix, sent in (("val", "val/", set()), ("test", "", known)):
        scores = {name: v for name, v in (content.result.get(kind) or {}).items() if v is not None}
        pairs = {n: v for n, v in scores.items() if n.split("/")[0] in (names.TC, names.CA)}
        for name, value in names.shown(pairs).items() if pairs else ():
            if name not in sent:
                yield Metric(f"{prefix}{name}", value, now, 0)


def _tags(content: Content) -> dict[str, str]:
    """Tags of a run by name; those without a value are not sent."""
    tables = content.tables
    tags = {
        "mlflow.user": getpass.getuser(),
        "mlflow.source.type": "LOCAL",
        "mlflow.source.name": "rgbt",  # its pages show no more than the end of a path
        "rgbt.command": content.process.get("command", ""),
        "mlflow.source.git.commit": content.process.get("git_commit") or "",
        "rgbt.dataset": content.result.get("dataset", ""),
        **content.identity,
        **content.description.tags,
    }
    if tables is not None:
        tags["mlflow.note.content"] = "\n".join(g.to_markdown() for g in result_grids(tables))
        tags["mlflow.loggedArtifacts"] = json.dumps([{"path": TABLE_FILE, "type": "table"}])
    return tags


def artifact_table(tables: ResultTables) -> dict[str, list[Any]]:
    """The result as columns and rows in percent (Var: its own unit) for MLflow's table view.

    That view groups by the first column, which must be unique, and compares the second between
    runs; it shows few rows on a screen, so summaries come first.
    """
    classes, regions = tables.classes, tables.regions
    rows = [("mIoU", regions.miou, math.nan), ("Var", regions.variance / 100, math.nan)]
    rows += [(f"mIoU {name}", value, math.nan) for name, value in subset_mious(classes).items()]
    pairs = zip(tables.region_names, regions.region_ious, strict=True)
    rows += [(f"mIoU {name}", iou, math.nan) for name, iou in pairs]
    rows += zip(classes.names, classes.ious, classes.accuracies, strict=True)
    for name, by_region in zip(classes.names, classes.region_ious, strict=True):
        pairs = zip(tables.region_names, by_region, strict=True)
        rows += [(f"{name} / {region}", iou, math.nan) for region, iou in pairs]
    data = [[name, *(round(100 * v, 2) for v in values)] for name, *values in rows]
    return {"columns": ["score", "IoU %", "accuracy %"], "data": without_nan(data)}
