"""Finished tables and studies in MLflow: a run of its own that holds their files."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rgbt.tracking.mlflow_server import pages_of
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.mlflow_view import run_path
from rgbt.tracking.provenance import without_passwords
from rgbt.tracking.terminal import info
from rgbt.tracking.tracker import Link, Tracking

if TYPE_CHECKING:
    from rgbt.tracking.mlflow_client import MlflowStore

Kind = Literal["table", "study"]

RECORD = "rgbt.record"
"""Tag with the name of the table or study that a run holds."""

NOTE_LENGTH = 5000
"""Characters of a description that every version of MLflow takes."""


def record(  # noqa: PLR0913 - each is a part of the run in MLflow
    tracking: Tracking,
    *,
    name: str,
    kind: Kind,
    files: Sequence[Path],
    metrics: Mapping[str, float],
    tags: Mapping[str, str],
    note: str,
) -> list[Link]:
    """Put a table or a study into MLflow; one that is there already is brought up to date.

    A store that cannot be used costs a line on stderr.

    Args:
        tracking: as the configuration builds it; nothing is done without MLflow.
        name: what it is found by, e.g. "spatialseg/table3 demo".
        kind: tag of the run.
        files: artifacts; a name that is there already is replaced.
        metrics: numbers; those that are not finite are left out, letters that MLflow refuses in a
            name become "_".
        tags: more tags.
        note: description of the run, in Markdown.

    Returns:
        where a person sees it.
    """
    if not isinstance(tracking, MlflowTracking):
        return []
    every = {"kind": kind, RECORD: name, "mlflow.note.content": _cut(note), **tags}
    try:
        store = tracking.store()
        run_id = _run(store, name)
        store.client.log_batch(run_id, metrics=_metrics(metrics), tags=_tags(every))
        for path in files:
            store.client.log_artifact(run_id, str(path))
        store.client.set_terminated(run_id)
    except Exception as error:  # The border to a store that may fail in any way.
        reason = (str(error).splitlines() or [""])[0][:120]
        info(
            f"the {kind} was not sent to MLflow ({type(error).__name__}: "
            f"{without_passwords(reason)}); the same command sends it later."
        )
        return []
    shown = pages_of(tracking.uri, run_id)
    page = (f"{kind} in MLflow", shown.address + run_path(store.experiment_id, run_id))
    return [page] if shown.command is None else [("open MLflow", shown.command), page]


def _run(store: MlflowStore, name: str) -> str:
    """The run that holds `name`, made where there is none."""
    found = _oldest(store, name)
    if found is not None:
        return found
    # Tagged in the same call: a run that nothing finds would stay as running for ever.
    tags = {RECORD: name}
    made = store.client.create_run(store.experiment_id, run_name=name, tags=tags).info.run_id
    # Another driver of the same table may have ended at this moment: both keep the older run.
    kept = _oldest(store, name) or made
    if kept != made:
        store.client.delete_run(made)
    return kept


def _oldest(store: MlflowStore, name: str) -> str | None:
    runs = store.client.search_runs(
        [store.experiment_id],
        filter_string=f'tags.`{RECORD}` = "{name}"',
        order_by=["attributes.start_time ASC", "attributes.run_id ASC"],
        max_results=1,
    )
    return str(runs[0].info.run_id) if runs else None


def _metrics(metrics: Mapping[str, float]) -> list[Any]:
    from mlflow.entities import Metric

    now = round(1000 * time.time())
    named = {re.sub(r"[^\w\-. :/]", "_", name): value for name, value in metrics.items()}
    return [Metric(n, value, now, 0) for n, value in named.items() if math.isfinite(value)]


def _tags(tags: Mapping[str, str]) -> list[Any]:
    from mlflow.entities import RunTag

    return [RunTag(name, value) for name, value in tags.items()]


def _cut(note: str) -> str:
    """The note as far as whole lines fit."""
    if len(note) <= NOTE_LENGTH:
        return note
    more = "\n\n(the rest is in the artifacts)\n"
    return note[: NOTE_LENGTH - len(more)].rpartition("\n")[0] + more
