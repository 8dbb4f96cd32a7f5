"""What the page's script reads: the runs, and the panel that opens behind each number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from analysis.report.claim_views import (
    VERDICTS,
    needed,
    placed,
    printed_sentence,
    seeds,
    why,
)
from analysis.report.data import ReportData, RunEntry, StudyEntry
from analysis.report.views import (
    COVERS,
    DASH,
    STATUS,
    Group,
    TableView,
    commit_text,
    duration,
    fixed,
    interval_text,
    is_number,
    moment,
    plural,
    signed,
    with_sign,
)

Panel = dict[str, Any]


def run_records(singles: Sequence[Group]) -> dict[str, Any]:
    """The runs by key, their configurations stored by what differs.

    Args:
        singles: every run as a separate group.

    Returns:
        ``runs``, and ``common_config`` with each key's most frequent value; in each run ``config``
        (values that differ from it) and ``config_lacks`` (its keys that the run has not).
    """
    counts: dict[str, Counter[str]] = {}
    for single in singles:
        for key, value in single.runs[0].config.items():
            counts.setdefault(key, Counter())[value] += 1
    common = {key: values.most_common(1)[0][0] for key, values in counts.items()}
    records = {
        run.key: {
            "name": run.name,
            "seed": run.seed,
            "commit": commit_text(run.commit),
            "repeat": run.repeat,
            "command": run.command,
            "scores": run.scores,
            "facts": _run_facts(run),
            "config": {key: value for key, value in run.config.items() if common[key] != value},
            "config_lacks": [key for key in common if key not in run.config],
            **class_records(single),
        }
        for single in singles
        for run in single.runs
    }
    return {"runs": records, "common_config": common}


def _run_facts(run: RunEntry) -> list[tuple[str, str]]:
    uncommitted = " (with uncommitted changes)" if run.commit.endswith("+") else ""
    rows = "; ".join(f"{table}: {row}" for table, row in run.table_rows.items())
    facts = [
        ("status", STATUS.get(run.status, run.status)),
        ("config key", run.key),
        ("MLflow run", run.run_id),
        ("commit", run.commit + uncommitted),
        ("started (UTC)", moment(run.started)),
        ("duration", duration(run.seconds)),
        ("host", run.host),
        ("scale, seed", f"{run.scale or DASH}, {DASH if run.seed is None else run.seed}"),
        ("experiment, group", f"{run.experiment or DASH}, {run.group or DASH}"),
        ("dataset", run.dataset),
        (
            "scored on",
            f"{run.split}, {plural(run.images, 'image')}, {run.partition or 'no partition'}",
        ),
        ("tables", rows),
        ("studies", ", ".join(run.studies)),
    ]
    return [(name, value or DASH) for name, value in facts]


def class_records(group: Group) -> dict[str, Any]:
    """IoU by class and region, mean over the runs of a group.

    Returns:
        ``classes``, rows of name, IoU of the image and of each region; ``regions``, their titles;
        ``notes`` on absent classes.
    """
    if not all(run.class_region_ious for run in group.runs):
        return {"classes": [], "regions": [], "notes": []}
    first = group.runs[0]
    stacked = np.ma.masked_invalid([run.class_region_ious for run in group.runs])
    rows = zip(first.classes, stacked.mean(0).filled(np.nan).tolist(), strict=True)
    return {
        "classes": [
            [
                f"{name} (not in means)" if name in first.unscored else name,
                group.means.get(f"class/{name}"),
                *values,
            ]
            for name, values in rows
        ],
        "regions": [group.place(index) for index in range(len(group.regions))],
        "notes": list(dict.fromkeys(note for run in group.runs for note in run.notes)),
    }


def panels_of(
    data: ReportData,
    tables: Sequence[TableView],
    groups: Sequence[Group],
    studies: Iterable[tuple[StudyEntry, str]],
) -> dict[str, Any]:
    """What opens behind a number, by its address.

    Returns:
        ``panels``: title, subtitle, facts, runs, their values, and names of ``peers``, lists of
        runs whose configurations are compared.
    """
    runs = {run.key: run for run in data.runs}
    peers = {view.id: view.keys for view in tables}
    panels: dict[str, Panel] = {}
    for run in data.runs:
        experiment = f"experiment {run.experiment}"
        peers.setdefault(experiment, []).append(run.key)
        of_tables = [view.id for view in tables if run.key in peers[view.id]]
        panels[f"run={run.key}"] = _panel(run.name, "Run", [run.key], of_tables or [experiment])
    peers["all"] = list(runs)
    for group in groups:
        keys = [run.key for run in group.runs]
        panels[group.id] = _panel(group.name, "Group of runs", keys, ["all"])
    for view in tables:
        panels |= _cell_panels(view) | _claim_panels(view)
    for study, place in studies:
        peers[place] = [key for trial in study.trials for key in trial.runs]
        for trial in study.trials:
            values = trial.values or (None,) * len(study.objectives)
            facts = [
                ("state", trial.state),
                *zip(study.objectives, map(fixed, values), strict=True),
            ]
            title, subtitle = f"Trial {trial.number}", f"Study {study.name}"
            shown = _panel(title, subtitle, trial.runs, [place], [*facts, *trial.params.items()])
            panels[f"trial={place}/{trial.number}"] = shown
    for index, entry in enumerate(data.differences):
        address, subtitle = f"difference={index}", "Paper against release"
        peers[address] = list(entry.runs)
        facts = [("effect", entry.effect)]
        panels[address] = _panel(entry.topic, subtitle, entry.runs, [address], facts)
    return {"panels": panels, "peers": peers}


def _panel(
    title: str,
    subtitle: str,
    runs: Sequence[str],
    peers: Sequence[str],
    facts: Sequence[tuple[str, str]] = (),
) -> Panel:
    names = {"title": title, "subtitle": subtitle, "facts": facts}
    return {**names, "runs": runs, "values": [], "peers": peers}


def _cell_panels(view: TableView) -> dict[str, Panel]:
    table, panels = view.entry, {}
    for (r, c), cell in view.places():
        if not cell.runs and not is_number(cell.mean):
            continue
        column = table.columns[c]
        covers = f" (95 %, {COVERS[cell.covers]})" if cell.covers in COVERS else ""
        interval = f"[{fixed(cell.low)}, {fixed(cell.high)}]{covers}"
        facts = [
            ("ours", fixed(cell.mean) + (f" ± {fixed(cell.sd)}" if is_number(cell.sd) else "")),
            ("interval", interval if is_number(cell.low) else DASH),
            ("published", fixed(cell.published, view.decimals)),
            ("difference", signed(cell.difference)),
            ("seeds", str(cell.seeds)),
            ("unit", "squared percent points" if column == "Var" else table.unit),
            *([("note", cell.reason)] if cell.reason else []),
            *(
                []
                if table.at_paper_scale
                else [("scale", f"{table.scale}: compare the verdicts of claims")]
            ),
        ]
        subtitle = ", ".join(filter(None, (table.name, table.number, table.extra)))
        shown = _panel(f"{table.rows[r]}, {column}", subtitle, cell.runs, [view.id], facts)
        values = {"values": cell.values, "value_name": column}
        panels[f"cell={view.id}/{r}/{c}"] = shown | values
    return panels


def _claim_panels(view: TableView) -> dict[str, Panel]:
    """What opens behind a verdict."""
    table, panels = view.entry, {}
    for claim in placed(view):
        if not claim.panel:
            continue
        entry = claim.entry
        covers = f" (95 %, {COVERS[entry.covers]})" if entry.covers in COVERS else ""
        facts = [
            ("statement", entry.says),
            ("place", entry.source),
            ("verdict", VERDICTS[entry.verdict]),
            ("contrast", entry.contrast),
            ("difference", with_sign(entry.estimate)),
            ("interval", interval_text(entry.low, entry.high) + covers),
            ("printed", f"{with_sign(entry.printed)}. {printed_sentence(entry)}"),
            ("smallest difference that could be shown", fixed(entry.smallest)),
            ("paired seeds", seeds(entry)),
            ("seeds that would decide", needed(entry)),
            *([("why", why(entry))] if entry.reason else []),
            *(("remark", remark) for remark in entry.remarks),
        ]
        subtitle = f"Claim of {table.paper}, {table.number}"
        panels[claim.panel] = _panel(entry.name, subtitle, entry.runs, [view.id], facts)
    return panels
