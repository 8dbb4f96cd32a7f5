"""Saved views of MLflow's runs page, with headline scores first and other sections folded.

By default that page sorts chart sections by name and puts mIoU and Var last, below some forty
charts. A saved view is a tag of the experiment in a form that belongs to MLflow's pages (seen in
3.17); a version that cannot read it shows its own layout instead.
"""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any
from urllib.parse import quote

from rgbt.metrics import names

TAG = "mlflow.sharedViewState."
RUNS_VIEW = "rgbt-runs"
GROUPS_VIEW = "rgbt-groups"
GROUP_TAG = "rgbt.group"

HEADLINE = "result on test split"
SECTIONS = {
    HEADLINE: True,
    "region": True,
    names.TC: True,
    names.CA: True,
    "val": True,
    "train/loss": True,
    "class": False,
    names.DAY: False,
    names.NIGHT: False,
    "Model metrics": False,
    "val/region": False,
    "val/class": False,
    f"val/{names.TC}": False,
    f"val/{names.CA}": False,
    f"val/{names.DAY}": False,
    f"val/{names.NIGHT}": False,
    "train": False,
    "train/lr": False,
}
"""Sections in order, and whether they are unfolded. MLflow fills all but the first by name."""

COLUMNS = (
    *(names.MIOU, names.VAR),
    *(names.consistency(score, "aligned") for score in (names.TC, names.CA)),
    *(names.region(number) for number in range(1, 10)),
)
"""Metrics that are columns of the runs table; those that no run has do not appear."""

PROFILE = {
    "metricKey": names.REGION_PROFILE,
    "xAxisKey": "step",
    "xAxisScaleType": "linear",
    "scaleType": "linear",
    "range": {},
    "lineSmoothness": 0,
    "displayPoints": True,
    "selectedXAxisMetricKey": "",
    "yAxisKey": "metric",
    "yAxisExpressions": [],
    "ignoreOutliers": False,
    "useGlobalXaxisKey": False,
    "useGlobalLineSmoothing": False,
}
AXES = {
    "xaxis": {"key": names.VAR, "type": "METRIC"},
    "yaxis": {"key": names.MIOU, "type": "METRIC"},
}
CHARTS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("BAR", "miou", {"metricKey": names.MIOU}),
    ("BAR", "variance", {"metricKey": names.VAR}),
    ("LINE", "profile", PROFILE),
    ("SCATTER", "trade-off", AXES),
)
"""Charts of the headline section."""


def view_tags() -> dict[str, str]:
    """Tags of an experiment that hold both views: every run, and means over runs of one group."""
    group = {
        "aggregateFunction": "average",
        "groupByKeys": [{"mode": "tag", "groupByData": GROUP_TAG}],
    }
    return {
        TAG + RUNS_VIEW: _saved("rgbt: every run", _state(None)),
        TAG + GROUPS_VIEW: _saved("rgbt: mean over seeds", _state(group)),
    }


def view_path(experiment_id: str, view: str) -> str:
    """Where a view opens, relative to the server's address."""
    query = f"workflowType=machine_learning&compareRunsMode=CHART&viewStateShareKey={view}"
    return f"/#/experiments/{quote(experiment_id)}/runs?{query}"


def run_path(experiment_id: str, run_id: str) -> str:
    """Where the page of one run opens, relative to the server's address."""
    return f"/#/experiments/{quote(experiment_id)}/runs/{run_id}?workflowType=machine_learning"


def _saved(name: str, state: dict[str, Any]) -> str:
    """The tag's text: name, times, and the compressed state of the page."""
    packed = base64.b64encode(zlib.compress(json.dumps(state).encode(), 9)).decode()
    # The times are constant, so that the tag changes exactly when the view does.
    times = {"createdAt": 1_767_225_600_000, "updatedAt": 1_767_225_600_000}
    return json.dumps({"name": name, **times, "state": f"deflate;{packed}"})


def _state(group_by: dict[str, Any] | None) -> dict[str, Any]:
    columns = [f"metrics.`{name}`" for name in COLUMNS]
    return {
        "searchFilter": "",
        "orderByKey": "tags.`mlflow.runName`",
        "orderByAsc": True,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "datasetsFilter": [],
        "modelVersionFilter": "All Runs",
        "selectedColumns": columns,
        "columnOrder": columns,
        "columnWidths": {},
        "runsHiddenMode": "SHOWALL",
        "groupBy": group_by,
        "hideEmptyCharts": True,
        "isAccordionReordered": True,  # keeps the order below
        "compareRunSections": [
            {"uuid": name, "name": name, "display": unfolded, "isReordered": True}
            for name, unfolded in SECTIONS.items()
        ],
        "compareRunCharts": [
            {
                "uuid": f"rgbt {key}",
                "type": kind,
                "runsCountToCompare": 100,
                "metricSectionId": HEADLINE,
                "deleted": False,
                "isGenerated": False,
                **settings,
            }
            for kind, key, settings in CHARTS
        ],
    }
