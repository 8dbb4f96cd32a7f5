"""Saved views of MLflow's runs page, with headline scores first and other sections folded.

By default that page puts mIoU and Var last, below some forty charts. A saved view is a tag of the
experiment in a form that belongs to MLflow's pages (seen in 3.17), kept in ``mlflow_view.json``; a
version that cannot read it shows its own layout instead.
"""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path
from typing import Any

RUNS_VIEW = "rgbt-runs"
# Tag with "run" for runs, and "table" or "study" for the records of ``sweeps``.
KIND_TAG = "kind"


def view_tags() -> dict[str, str]:
    """Return tags of an experiment that hold its views: runs, means over seeds, and tables."""
    groups = [{"mode": "tag", "groupByData": "rgbt.group"}]
    seeds = {"aggregateFunction": "average", "groupByKeys": groups}
    runs, others = (f"tags.`{KIND_TAG}` {sign} 'run'" for sign in ("=", "!="))
    views = {
        RUNS_VIEW: _saved("rgbt: every run", searchFilter=runs),
        "rgbt-groups": _saved("rgbt: mean over seeds", searchFilter=runs, groupBy=seeds),
        "rgbt-tables": _saved("rgbt: tables and studies", searchFilter=others),
    }
    return {f"mlflow.sharedViewState.{name}": text for name, text in views.items()}


def view_path(experiment_id: str) -> str:
    """Return the path of the view of all runs, relative to the server's address.

    Without ``workflowType`` MLflow 3 opens its pages for generative models, which have no scores.
    """
    query = f"workflowType=machine_learning&compareRunsMode=CHART&viewStateShareKey={RUNS_VIEW}"
    return f"/#/experiments/{experiment_id}/runs?{query}"


def _saved(name: str, **changed: Any) -> str:
    """The tag's text: name, times, and the compressed state of the page."""
    state = {**json.loads(Path(__file__).with_suffix(".json").read_text()), **changed}
    packed = base64.b64encode(zlib.compress(json.dumps(state).encode(), 9)).decode()
    # The times are constant, so that the tag changes exactly when the view does.
    times = {"createdAt": 1_767_225_600_000, "updatedAt": 1_767_225_600_000}
    return json.dumps({"name": name, **times, "state": f"deflate;{packed}"})
