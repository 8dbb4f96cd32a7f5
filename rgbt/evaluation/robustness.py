"""Evaluate a network under every corruption, reuse existing counts, and write the table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rgbt.assembly.session import Session
from rgbt.config.common_options import AS_TRAINED
from rgbt.engine.progress import progress
from rgbt.evaluation.prediction import view_of, weights_digest
from rgbt.evaluation.request import (
    CorruptionRequest,
    EvaluationRequest,
    NetworkRequest,
    other_images,
)
from rgbt.evaluation.segmentation import evaluate
from rgbt.files.atomic import write_atomic
from rgbt.files.plain_files import sealed, write_json
from rgbt.metrics.counts import Counts
from rgbt.metrics.names import DAY, MIOU, NIGHT, subset
from rgbt.metrics.scores import summary
from rgbt.requirements import record_of
from rgbt.runs.folder import read_marker
from rgbt.tables import TextTable, csv_text, percent
from rgbt.types import View

FORMAT = "rgbt robustness 1"
# Folder in ``evaluations/`` of a run; `analysis.results` looks for curves there.
FOLDER = "robustness"

CLEAN = "clean"
# View -> title: the network gets both images, and the features of one branch are decoded.
FEATURES: dict[View, str] = {
    "thermal": "thermal alone (features)",
    "rgb": "RGB alone (features)",
}

SCORES = (MIOU, subset(DAY, MIOU), subset(NIGHT, MIOU))


@dataclass(frozen=True)
class Condition:
    """The input of one evaluation; the severities of a corruption share a `row` of the table."""

    file_stem: str
    row: str
    title: str
    unit: str
    severity: float
    view: View
    corruption: CorruptionRequest | None = None


# A condition, and the mIoU of each part of its counts as a fraction.
Measured = tuple[Condition, dict[str, float]]


def conditions(session: Session, corruptions: Sequence[CorruptionRequest]) -> list[Condition]:
    """Clean images, single branches if the network decodes them, and every severity."""
    view, known = view_of(session), record_of(session.model).views
    found = [Condition(CLEAN, CLEAN, CLEAN, "", 0.0, view)]
    for branch, title in FEATURES.items() if view == "rgbt" else ():
        name = f"features-{branch}"
        found += [Condition(name, name, title, "", 1.0, branch)] if branch in known else []
    for each in (level for corruption in corruptions for level in corruption.ladder()):
        title, unit = each.corruption.title, each.corruption.unit
        found.append(Condition(each.file_stem, each.row, title, unit, each.severity, view, each))
    return found


def measure(
    session: Session, split: str, corruptions: Sequence[CorruptionRequest], folder: Path
) -> list[Measured]:
    """Evaluate clean images and all severities of each corruption, where counts are missing.

    In the folder NAME.npz has a NAME.json, written after it, that describes its inputs.
    """
    folder.mkdir(parents=True, exist_ok=True)
    every = conditions(session, corruptions)
    shared = {
        "format": FORMAT,
        "dataset": session.dataset.fingerprint(),
        "split": split,
        "partition": session.regions.name,
        "weights": weights_digest(session.model),
        "transform": session.spec.transform.plain,
        "precision": session.trainer.precision,
    }
    found = []
    with progress() as display:
        task = display.add_task("robustness", total=len(every), note="")
        for condition in every:
            display.update(task, note=condition.file_stem)
            counts = _counts(session, condition, shared, folder)
            scores = summary(counts, session.regions.absent)
            found.append((condition, {name: scores[name] for name in SCORES if name in scores}))
            display.advance(task)
    return found


def _counts(session: Session, condition: Condition, shared: dict[str, Any], folder: Path) -> Counts:
    """The counts in the folder if their inputs are the same, else new counts."""
    counts_file = folder / f"{condition.file_stem}.npz"
    made_file = folder / f"{condition.file_stem}.json"
    corruption = condition.corruption
    described = ("row", "title", "unit", "severity", "view")
    decisive = {
        **shared,
        **{key: getattr(condition, key) for key in described},
        "corruption": None if corruption is None else corruption.identity(),
    }
    with suppress(OSError, ValueError):  # missing or damaged
        if json.loads(made_file.read_text()) == sealed(decisive):
            return Counts.load(counts_file)
    request = EvaluationRequest(split=shared["split"], view=condition.view, corruption=corruption)
    counts = evaluate(session, session.model, request).counts
    # The description must not outlive the counts it belongs to.
    made_file.unlink(missing_ok=True)
    counts.save(counts_file)
    write_json(made_file, decisive)
    return counts


def counts_folder(opened: Session, network: NetworkRequest, split: str) -> Path:
    """Folder for the counts of a split; suffixes name changes from the training."""
    regions = [] if network.regions == AS_TRAINED else [opened.regions.name]
    others = other_images(opened.dataset, read_marker(opened.evaluations.parent))
    return opened.evaluations / FOLDER / "_".join([split, *regions, *network.suffixes, *others])


def robustness_grid(measured: Sequence[Measured], title: str) -> TextTable:
    """One line per corruption; level 0 is the clean image, level n the n-th severity."""
    clean = percent(measured[0][1][MIOU])
    rows: dict[str, list[Measured]] = {}
    for each in measured[1:]:
        rows.setdefault(each[0].row, []).append(each)
    levels = max((len(row) for row in rows.values()), default=0)
    lines = []
    for row in rows.values():
        first = row[0][0]
        ladder = ", ".join(f"{condition.severity:g}" for condition, _ in row)
        severities = f"{ladder} {first.unit}" if first.unit else ""
        values = [percent(mious[MIOU]) for _, mious in row] + [""] * (levels - len(row))
        lines.append((first.title, severities, clean, *values))
    header = ("", "severities", *(f"level {level}" for level in range(levels + 1)))
    return TextTable(title, header, tuple(lines or [(CLEAN, "", clean)]))


def write_tables(measured: Sequence[Measured], grid: TextTable, path: Path) -> None:
    """Write the numbers to `path` with .csv added and the table to `path` with .md added."""
    rows: list[tuple[object, ...]] = [
        ("row", "title", "unit", "severity", "view", *measured[0][1]),
    ]
    for each, mious in measured:
        described = each.row, each.title, each.unit, f"{each.severity:g}", each.view
        rows.append((*described, *(100 * value for value in mious.values())))
    # Names hold dots of severities: endings are added, not exchanged.
    write_atomic(path.with_name(f"{path.name}.csv"), csv_text(rows).encode())
    write_atomic(path.with_name(f"{path.name}.md"), grid.to_markdown().encode())
