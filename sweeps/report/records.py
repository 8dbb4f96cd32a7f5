"""Tables and studies in MLflow: one run each, which holds their files."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rgbt.runs.provenance import without_passwords
from rgbt.terminal import info
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.tracker import Link, Tracking

if TYPE_CHECKING:
    from rgbt.tracking.mlflow_store import MlflowStore

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
    """Write a table or a study to MLflow, or update it there.

    An unreachable store is a warning only.

    Args:
        tracking: as the configuration builds it; nothing is done without MLflow.
        name: its identifier, e.g. "spatialseg/table3 demo".
        kind: tag of the run.
        files: artifacts; one of the same name is replaced.
        metrics: numbers; those that are not finite are left out, letters that MLflow refuses in a
            name become "_".
        tags: more tags.
        note: description of the run, in Markdown.

    Returns:
        the command that opens MLflow.
    """
    if not isinstance(tracking, MlflowTracking):
        return []
    if len(note) > NOTE_LENGTH:
        more = "\n\n(the rest is in the artifacts)\n"
        note = note[: NOTE_LENGTH - len(more)].rpartition("\n")[0] + more
    every = {"kind": kind, RECORD: name, "mlflow.note.content": note, **tags}
    try:
        from mlflow.entities import Metric, RunTag

        store = tracking.store()
        run_id = _run(store, name)
        now = round(1000 * time.time())
        named = {re.sub(r"[^\w\-. :/]", "_", each): value for each, value in metrics.items()}
        store.client.log_batch(
            run_id,
            metrics=[Metric(n, value, now, 0) for n, value in named.items() if isfinite(value)],
            tags=[RunTag(key, value) for key, value in every.items()],
        )
        for path in files:
            store.client.log_artifact(run_id, str(path))
        store.client.set_terminated(run_id)
    except Exception as error:  # The border to a store that may fail in any way.
        reason = (str(error).splitlines() or [""])[0][:120]
        info(
            f"the {kind} was not sent to MLflow ({type(error).__name__}: "
            f"{without_passwords(reason)}); rerun the command to send it."
        )
        return []
    return [("open MLflow", tracking.ui_command())]


def _run(store: MlflowStore, name: str) -> str:
    """The run of `name`, created if it does not exist."""
    existing = _oldest(store, name)
    if existing is not None:
        return existing
    # Tagged in the same call: a run without the tag would never be found again.
    tags = {RECORD: name}
    created = store.client.create_run(store.experiment_id, run_name=name, tags=tags).info.run_id
    # Another driver of the same table may end at this moment: both keep the older run.
    kept = _oldest(store, name) or created
    if kept != created:
        store.client.delete_run(created)
    return kept


def _oldest(store: MlflowStore, name: str) -> str | None:
    runs = store.client.search_runs(
        [store.experiment_id],
        filter_string=f'tags.`{RECORD}` = "{name}"',
        order_by=["attributes.start_time ASC", "attributes.run_id ASC"],
        max_results=1,
    )
    return str(runs[0].info.run_id) if runs else None
