"""The charts of the page: rows and titles for the Vega-Lite specifications of `charts.yaml`.

A row with ``panel`` opens that panel when its mark is clicked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from functools import cache
from itertools import accumulate
from pathlib import Path
from typing import Any

from analysis.report.data import StudyEntry, TrialEntry
from analysis.report.views import Group, TableView, fixed, is_number, plural
from rgbt.files.yaml_files import read_yaml

Spec = dict[str, Any]

MOST_CHOSEN = 6
"""Groups in one profile: as many as there are distinct colours."""


def specification(name: str) -> Spec:
    """A copy of an entry of `charts.yaml`."""
    copy: Spec = deepcopy(_specifications()[name])
    return copy


@cache
def _specifications() -> Any:
    return read_yaml(Path(__file__).with_name("charts.yaml"))


def table_charts(view: TableView) -> list[Spec]:
    """Ours with intervals and single runs, and the published values, by row.

    At every scale but "paper" the published values have a separate chart and axis.
    """
    rows = list(_table_rows(view))
    printed = [row for row in rows if row["kind"] == "published"]
    ours = [row for row in rows if row["kind"] != "published"]
    apart = not view.entry.at_paper_scale and ours and printed
    parts = [(f"ours ({view.entry.scale} scale)", ours), ("published, own axis", printed)]
    unit = view.entry.unit + ", Var: squared percent points" * ("Var" in view.entry.columns)
    charts = []
    for title, values in parts if apart else [("", rows)]:
        spec = specification("table")
        spec |= {"title": title, "data": {"values": values}, "height": 24 * len(view.entry.rows)}
        spec["description"] = f"{view.entry.name}: {title or 'ours and published'}, by row"
        spec["params"] = [{"name": "column", "value": view.entry.columns[view.main]}]
        spec["encoding"]["y"]["scale"] = {"domain": view.entry.rows}
        spec["encoding"]["x"]["axis"]["title"] = unit
        charts.append(spec)
    return charts


def _table_rows(view: TableView) -> Iterator[Spec]:
    for (r, c), cell in view.places():
        label = view.entry.rows[r]
        base = {"row": label, "column": view.entry.columns[c]}
        if is_number(cell.mean):
            range_ = f" [{fixed(cell.low)}, {fixed(cell.high)}]" if is_number(cell.low) else ""
            text = f"{label}: {fixed(cell.mean)}{range_}"
            ends = {"low": cell.low, "high": cell.high, "panel": f"cell={view.id}/{r}/{c}"}
            yield {**base, "kind": "ours", "x": cell.mean, "text": text, **ends}
        for value in filter(is_number, cell.values):
            yield {**base, "kind": "run", "x": value, "text": f"{label}: {fixed(value)}"}
        if is_number(cell.published):
            text = f"{label}: {cell.published} published"
            yield {**base, "kind": "published", "x": cell.published, "text": text}


def profile_rows(group: Group) -> list[Spec]:
    """Rows of the chart "profile" for one group: mean, and lowest and highest of several runs."""
    name = f"{group.name} ({plural(len(group.runs), 'run')})"
    rows = []
    for index, each in enumerate(group.regions):
        text = f"{group.name}, region {index + 1}: {fixed(each['mean'])}"
        ends = {"low": each["min"], "high": each["max"]} if len(group.runs) > 1 else {}
        place = {"name": name, "region": group.place(index)}
        rows.append({**place, "y": each["mean"], "text": text, **ends})
    return rows


def is_complete(trial: TrialEntry) -> bool:
    """Whether all objectives of the trial are known."""
    return trial.state == "complete" and bool(trial.values) and all(map(is_number, trial.values))


def study_chart(study: StudyEntry, place: str) -> Spec | None:
    """Two objectives with their front, or one by trial with the best so far; None: nothing to draw.

    Args:
        study: with its trials.
        place: its name behind #.
    """
    trials = list(filter(is_complete, study.trials))
    if not trials:
        return None
    names, several = study.objectives, len(study.objectives) > 1
    rows: list[Spec] = []
    for trial in trials:
        scores = zip(names, map(fixed, trial.values), strict=True)
        text = f"Trial {trial.number}: " + ", ".join(f"{name} {value}" for name, value in scores)
        x, y = trial.values[:2] if several else (trial.number, trial.values[0])
        row = {"x": x, "y": y, "text": text, "panel": f"trial={place}/{trial.number}"}
        rows.append({**row, "number": str(trial.number), "best": trial.on_front})
    spec = specification("study")
    axes, (line, *_, numbers) = spec["encoding"], spec["layer"]
    spec["data"] = {"values": rows}
    of = " against ".join(names[:2]) if several else f"{names[0]} by trial"
    spec["description"] = f"{study.name}: {of}"
    front = sorted((row for row in rows if row["best"]), key=lambda row: float(row["x"]))
    if several:
        wanted = ["higher" if up else "lower" for up in study.maximize]
        more = f"; {len(names) - 2} more in the table" if len(names) > 2 else ""
        axes["x"]["title"] = f"{names[0]} ({wanted[0]} is better){more}"
        axes["y"]["title"] = f"{names[1]} ({wanted[1]} is better)"
        # Between two points of the front one holds the worse value of both.
        line["mark"]["interpolate"] = "step-before" if study.maximize[0] else "step-after"
        line["data"] = {"values": [] if more else front}
        numbers["data"] = {"values": front}
    else:
        axes["x"]["title"], axes["y"]["title"] = "trial", f"{names[0]} (line: best so far)"
        best = accumulate((row["y"] for row in rows), max if study.maximize[0] else min)
        line["mark"]["interpolate"] = "step-after"
        steps: Sequence[Spec] = [{"x": row["x"], "y": y} for row, y in zip(rows, best, strict=True)]
        line["data"] = {"values": steps}
        spec["layer"].remove(numbers)
    return spec
