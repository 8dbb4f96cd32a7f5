"""The lines and the result of a run folder as metrics of MLflow."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator
from typing import Any

from rgbt.metrics import names
from rgbt.metrics.names import shown
from rgbt.tracking.run_files import read_result
from rgbt.tracking.run_folder import MetricLine, RunFolder
from rgbt.tracking.tables import ResultTables


def metrics_of(lines: list[MetricLine]) -> Iterator[Any]:
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


def later_scores(
    folder: RunFolder, lines: list[MetricLine], sent: Collection[str]
) -> dict[str, float]:
    """Scores of pairs of frames in the result that no line holds and that were not sent yet.

    Those of the selection split, and those that `rgbt.consistency` added to a finished run; by
    split and name, as those that were `sent`.
    """
    result = read_result(folder.path) or {}
    known = {f"test/{name}" for line in lines if line.kind == "test" for name in line.values}
    found = {}
    for kind in ("val", "test"):
        for name, value in (result.get(kind) or {}).items():
            key = f"{kind}/{name}"
            is_pairs = name.split("/")[0] in (names.TC, names.CA)
            if is_pairs and value is not None and key not in known and key not in sent:
                found[key] = value
    return found


def metrics_of_pairs(later: dict[str, float], lines: list[MetricLine]) -> Iterator[Any]:
    """Scores as MLflow metrics: those of the test split by their name alone."""
    from mlflow.entities import Metric

    for key, value in later.items():
        name = key.partition("/")[2]
        label = name if key.startswith("test/") else key
        yield Metric(label, shown(name, value), round(1000 * lines[-1].time), 0)


def profile_of(tables: ResultTables, lines: list[MetricLine]) -> list[Any]:
    """IoU over the regions as a line: the step is the region's number."""
    from mlflow.entities import Metric

    last = lines[-1].time if lines else time.time()
    return [
        Metric(names.REGION_PROFILE, round(100 * iou, 2), round(1000 * last), region)
        for region, iou in enumerate(tables.regions.region_ious, start=1)
        if math.isfinite(iou)
    ]
