"""Which MLflow run belongs to a run folder: the noted one, an unnoted one, or a new one."""

from __future__ import annotations

import time
from datetime import datetime
from typing import Any

from rgbt.tracking.mlflow_client import MlflowStore
from rgbt.tracking.replaced_runs import shown_description, shown_key
from rgbt.tracking.run_files import read_provenance
from rgbt.tracking.run_folder import RunFolder

NAME_LENGTH = 250
"""Characters of a run's name; PostgreSQL refuses more, SQLite does not."""


def noted_run(store: MlflowStore, run_id: str) -> Any:
    """The run that ``mlflow.json`` names; None where the store does not have it any more.

    A run that was deleted in the pages takes nothing more; its folder gets a new one.
    """
    from mlflow.exceptions import MlflowException

    if not run_id:
        return None
    try:
        run = store.client.get_run(run_id)
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise
        return None
    return run if run.info.lifecycle_stage == "active" else None


def unnoted_run(store: MlflowStore, folder: RunFolder) -> Any:
    """A run made for this folder by a process that was killed before it noted the run's id.

    Without this look it would stay in the pages as running for ever. The time of the first start
    keeps runs of one key apart that were trained from their start again.
    """
    started = f"attributes.start_time = {_start_time(folder)}"
    # Compared here: MLflow's search cannot quote every path.
    runs = store.client.search_runs([store.experiment_id], started)
    same = [run for run in runs if identity(folder).items() <= run.data.tags.items()]
    return same[0] if same else None


def new_run(store: MlflowStore, folder: RunFolder) -> Any:
    """A new run for this folder; `unnoted_run` finds it."""
    description = shown_description(folder)
    assert description is not None, f"{folder.path}: describe() comes before fill()"
    return store.client.create_run(
        store.experiment_id,
        start_time=_start_time(folder),
        tags=identity(folder),
        run_name=short_name(description.name),
    )


def identity(folder: RunFolder) -> dict[str, str]:
    """Tags by which `unnoted_run` finds a run, set in the call that makes it."""
    return {"rgbt.key": shown_key(folder), "rgbt.folder": str(folder.path)}


def short_name(name: str) -> str:
    """A run's name as MLflow takes it; the whole one stays in the folder."""
    return name if len(name) <= NAME_LENGTH else f"{name[: NAME_LENGTH - 4]} ..."


def _start_time(folder: RunFolder) -> int:
    """Milliseconds since 1970 at which the first process of the run began."""
    first = (read_provenance(folder.path / "provenance.json") or [{}])[0].get("started")
    seconds = time.time() if first is None else datetime.fromisoformat(first).timestamp()
    return round(1000 * seconds)
