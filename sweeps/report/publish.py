"""Prints the report of a study, writes its files and records it in MLflow."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Group
from rich.text import Text

from rgbt.files.atomic import write_atomic
from rgbt.runs.provenance import without_passwords
from rgbt.tables import TextTable
from rgbt.terminal import path_lines, print_rich, rich_table
from sweeps.report.figures import draw
from sweeps.report.records import record
from sweeps.report.study_data import StudyData, importances, pruning_savings, read
from sweeps.report.tables import WORDS, markdown_table, tables, trials_csv

if TYPE_CHECKING:
    import optuna

    from rgbt.tracking.tracker import Tracking


def publish_study(study: optuna.Study, out: Path, tracking: Tracking, url: str) -> None:
    """Print the tables of a study in the storage `url`, write its files into `out`, record them."""
    data = read(study)
    shares = importances(data)
    grids = tables(data, shares)
    out.mkdir(parents=True, exist_ok=True)
    pictures = draw(data, shares, out)
    # Remarks below the tables: on the importances, and why figures are missing.
    missing: dict[str, list[str]] = {}
    for picture in pictures:
        if picture.path is None:
            missing.setdefault(picture.reason, []).append(picture.name)
    remarks = [f"No figure {', '.join(names)}: {reason}" for reason, names in missing.items()]
    if shares.remark and shares.remark not in missing:
        remarks.insert(0, f"Importances: {shares.remark}")
    text = markdown(data, grids, remarks)
    drawn = [(picture, picture.path) for picture in pictures if picture.path is not None]
    gallery = "".join(f"\n## {one.title}\n\n![{one.title}]({path.name})\n" for one, path in drawn)
    write_atomic(out / "study.md", (text + gallery).encode())
    write_atomic(out / "trials.csv", trials_csv(data).encode())
    print_rich(Group(*map(rich_table, grids), Text("\n".join(remarks))))
    links = record(
        tracking,
        # A table and its study may have one name, and are two records.
        name=f"study {data.name}",
        kind="study",
        files=[out / "study.md", out / "trials.csv", *(path for _, path in drawn)],
        metrics=metrics(data),
        tags={"rgbt.study": data.name, "rgbt.study.kind": data.kind},
        note=text,
    )
    files = [("report", str(out / "study.md")), ("figures", f"{len(drawn)} in {out}")]
    command = f"optuna-dashboard {without_passwords(url)}"
    print_rich(path_lines([*files, *links, ("dashboard", command)]))


def markdown(data: StudyData, grids: Sequence[TextTable], remarks: Sequence[str]) -> str:
    """The report in Markdown, without figures: MLflow's descriptions cannot show them."""
    way = ["highest" if up else "lowest" for up in data.maximize]
    objectives = ", ".join(f"{w} {metric}" for w, metric in zip(way, data.metrics, strict=True))
    created = f"Created by `{without_passwords(data.command)}`.\n" if data.command else ""
    head = f"# Study {data.name}\n\nKind: {data.kind}. Objectives: {objectives}.\n{created}"
    return "\n".join([head, *map(markdown_table, grids), "".join(f"- {e}\n" for e in remarks)])


def metrics(data: StudyData) -> dict[str, float]:
    """Metrics of a study in MLflow: the best of each objective, trials by state, steps saved."""
    numbers = {f"trials/{WORDS[state]}": float(count) for state, count in data.counts().items()}
    for index, metric in enumerate(data.metrics if data.complete else ()):
        best = max if data.maximize[index] else min
        numbers[f"best/{metric}"] = best(trial.values[index] for trial in data.complete)
    saved = pruning_savings(data)
    return numbers if saved is None else {**numbers, "steps_saved": 100.0 * saved.share}


def study_folder(runs_dir: Path, name: str) -> Path:
    """Folder of the report of a study; characters such as / in its name are replaced."""
    safe = re.sub(r"[^\w+=.-]+", "_", name).lstrip(".")[:80]
    if safe != name:
        safe += "-" + hashlib.sha256(name.encode()).hexdigest()[:6]
    return runs_dir / "studies" / safe
