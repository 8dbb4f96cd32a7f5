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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import Image

from rgbt.files.plain_files import read_json, write_json
from rgbt.metrics import names
from rgbt.runs.folder import (
    MetricLine,
    RunFolder,
    read_provenance,
    read_result,
    read_tables,
    shown_description,
    shown_key,
)
from rgbt.tables import ResultTables, result_grids, subset_mious, without_nan
from rgbt.terminal import warn
from rgbt.tracking.mlflow_client import ExperimentClient
from rgbt.tracking.mlflow_view import KIND_TAG
from rgbt.tracking.tracker import Status

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

# Figures that the charts of all runs show side by side.
IMAGES = ("panel", "regions")

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


def read_upload_state(folder: RunFolder) -> UploadState | None:
    """Read the record of this folder; None: nothing was sent. InputError: it is damaged."""
    path = folder.path / "mlflow.json"
    advice = "remove the file; the MLflow run is then identified by its key"
    found: UploadState | None = read_json(path, UploadState, advice) if path.exists() else None
    return found


def write_upload_state(folder: RunFolder, state: UploadState) -> None:
    """Write the record."""
    write_json(folder.path / "mlflow.json", asdict(state))


def is_sent(folder: RunFolder, state: UploadState) -> bool:
    """Return whether no file changed since the last complete upload, without importing MLflow."""
    files = [*_own_files(folder), *(folder.path / name for name in READ)]
    # The time of a change, not that of the content: a copied file keeps an old one.
    last = max((path.lstat().st_ctime for path in files if path.exists()), default=math.inf)
    return bool(state.run_id) and last <= state.sent


def upload(store: ExperimentClient, folder: RunFolder, state: UploadState, status: Status) -> None:
    """Bring the MLflow run of a folder up to date; `state` is changed and written.

    Args:
        store: open store.
        folder: described before; the lock ``mlflow.lock`` is held.
        state: what that store has.
        status: the state to show.

    Raises:
        InputError: a file is damaged. MLflow raises anything else.
    """
    from mlflow.entities import Metric, Param, RunTag

    # Taking the lock has written its file: the time by the clock of the folder's file system.
    began = (folder.path / "mlflow.lock").lstat().st_mtime
    path, description = folder.path, shown_description(folder)
    assert description is not None, f"{path}: describe() comes before upload()"
    process = next(iter(read_provenance(path / "provenance.json")), {})  # that began the run
    lines, tables, result = folder.lines(), read_tables(path), read_result(path) or {}
    # These tags are set in the call that makes a run, which is found by them.
    identity = {KIND_TAG: "run", "rgbt.key": shown_key(folder), "rgbt.folder": str(path)}
    name = description.name[:NAME_LENGTH]
    run = _run_of(store, folder, state, name, identity, process.get("started"))
    store.check_files(run.info.artifact_uri)

    metrics = list(_metrics(lines, tables, result, state))
    if names.MIOU not in {*run.data.metrics, *(metric.key for metric in metrics)}:
        # The compare page draws the metric that came first: the score, also before it is known.
        metrics.insert(0, Metric(names.MIOU, math.nan, run.info.start_time, 0))
    # MLflow refuses to change a parameter.
    new = {key: v for key, v in description.params.items() if key not in run.data.params}
    params = [Param(key, value[:PARAM_LENGTH]) for key, value in new.items()]
    texts = {
        "mlflow.user": _user(),
        "mlflow.source.type": "LOCAL",
        "mlflow.source.name": "rgbt",  # its pages show no more than the end of a path
        "rgbt.command": process.get("command", ""),
        "mlflow.source.git.commit": process.get("git_commit") or "",
        "rgbt.dataset": result.get("dataset", ""),
        **identity,
        **description.tags,
    }
    if tables is not None:
        texts["mlflow.note.content"] = "\n".join(g.to_markdown() for g in result_grids(tables))
        texts["mlflow.loggedArtifacts"] = json.dumps([{"path": TABLE_FILE, "type": "table"}])
    tags = [RunTag(key, value[:TAG_LENGTH]) for key, value in texts.items() if value]
    while metrics or params or tags:  # one call, except for many parameters or metrics
        store.log_batch(state.run_id, metrics[:BATCH_METRICS], params[:BATCH_PARAMS], tags)
        metrics, params, tags = metrics[BATCH_METRICS:], params[BATCH_PARAMS:], []
    for line in lines:  # a resumed run may be behind what was sent
        state.steps[line.kind] = max(line.step, state.steps.get(line.kind, -1))
    write_upload_state(folder, state)  # at once: a kill between doubles points after the resume
    for file in _own_files(folder):
        if file.stat().st_ctime > state.sent:
            _send_file(store, state.run_id, file, file.parent.relative_to(path).as_posix())
    if tables is not None and (path / "tables.json").stat().st_ctime > state.sent:
        store.log_text(state.run_id, json.dumps(artifact_table(tables)), TABLE_FILE)
    store.update_run(state.run_id, "RUNNING" if status == "RUNNING" else None, name)
    if status not in ("RUNNING", run.info.status):
        written = (path / file for file in ("result.json", "metrics.jsonl", "run.json"))
        end = max(file.stat().st_mtime for file in written if file.exists())
        store.set_terminated(state.run_id, status=status, end_time=round(1000 * end))
    state.sent = began
    write_upload_state(folder, state)


def _user() -> str:
    with suppress(KeyError, OSError):  # in a container, a number may have no name
        return getpass.getuser()
    return ""


def _send_file(store: ExperimentClient, run_id: str, file: Path, parent: str) -> None:
    store.log_artifact(run_id, str(file), None if parent == "." else parent)
    if file.stem not in IMAGES:
        return
    try:
        with Image.open(file) as stored:
            image = stored.convert("RGB")
    except (OSError, Image.DecompressionBombError) as error:
        warn(f"{file} is sent as a file and not shown as an image: {error}")
        return
    store.log_image(run_id, image, key=file.stem, step=0)


def _run_of(
    store: ExperimentClient,
    folder: RunFolder,
    state: UploadState,
    name: str,
    identity: Mapping[str, str],
    started: str | None,
) -> Any:
    """The MLflow run that ``mlflow.json`` names; an unnoted or a new one if it was deleted."""
    from mlflow.exceptions import MlflowException

    try:
        run = store.get_run(state.run_id) if state.run_id else None
        if run is not None and run.info.lifecycle_stage == "active":
            return run
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise
    # A process that was killed may have made the run without noting its id. The start keeps runs of
    # one key apart that were trained again.
    seconds = time.time() if started is None else datetime.fromisoformat(started).timestamp()
    start = round(1000 * seconds)
    found = store.search_runs([store.experiment_id], f"attributes.start_time = {start}")
    # Compared here: MLflow's search cannot quote every path. A store of one folder moves with it.
    known = dict(identity)
    if store.files:
        del known["rgbt.folder"]
    same = [run for run in found if known.items() <= run.data.tags.items()]
    run = same[0] if same else store.create_run(store.experiment_id, start, dict(identity), name)
    state.run_id, state.steps, state.sent = run.info.run_id, {}, 0.0
    write_upload_state(folder, state)
    return run


def _own_files(folder: RunFolder) -> list[Path]:
    """Files to send: regular ones inside the folder, which no link leads to."""
    found = sorted(path for pattern in FILES for path in folder.path.glob(pattern))
    return [path for path in found if path.is_file() and path.resolve() == path]


def _metrics(
    lines: Sequence[MetricLine],
    tables: ResultTables | None,
    result: Mapping[str, Any],
    state: UploadState,
) -> Iterator[Any]:
    """Finite values of new lines, each with the time of its line, and what no line holds.

    The latter are the IoU over the regions (the step is the region's number), and scores of pairs
    of frames: of the selection split, and those that `rgbt.consistency` added to a finished run.
    """
    from mlflow.entities import Metric

    new = [line for line in lines if line.step > state.steps.get(line.kind, -1)]
    # The compare page draws the metric that came first: scores before losses.
    for line in sorted(new, key=lambda line: ("test", "val", "train").index(line.kind)):
        # The pages draw bars over runs for a metric that has step 0 only, else a line over steps.
        prefix, step = ("", 0) if line.kind == "test" else (f"{line.kind}/", line.step)
        finite = {name: value for name, value in line.values.items() if math.isfinite(value)}
        for name, value in names.shown(finite).items():
            yield Metric(prefix + name, value, round(1000 * line.time), step)
    now = round(1000 * lines[-1].time) if lines else 0
    regions = tables.regions.region_ious if tables is not None and tables.split == "test" else ()
    for region, iou in enumerate(regions, start=1):
        if math.isfinite(iou):
            yield Metric(names.REGION_PROFILE, round(100 * iou, 2), now, region)
    known = {name for line in lines if line.kind == "test" for name in line.values}
    for name, value in _pair_scores(result, "val").items():
        yield Metric(f"val/{name}", value, now, 0)
    for name, value in _pair_scores(result, "test").items():
        if name not in known:
            yield Metric(name, value, now, 0)


def _pair_scores(result: Mapping[str, Any], kind: str) -> dict[str, float]:
    """The scores of pairs of frames in a result, as MLflow shows them."""
    pairs = {}
    for name, score in (result.get(kind) or {}).items():
        if score is not None and name.split("/")[0] in (names.TC, names.CA):
            pairs[name] = score
    return names.shown(pairs)


def artifact_table(tables: ResultTables) -> dict[str, list[Any]]:
    """Make columns and rows in percent (Var: its own unit) for MLflow's table view.

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
