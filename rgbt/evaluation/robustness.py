"""Evaluate a network under every corruption, reuse existing counts, and write the table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from rgbt.build.load_run import TrainedNetwork
from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.config.common_options import AS_TRAINED
from rgbt.engine.progress import progress
from rgbt.evaluation.corruption_request import CorruptionRequest
from rgbt.evaluation.prediction import view_of
from rgbt.evaluation.request import EvaluationRequest, NetworkRequest, other_images
from rgbt.evaluation.segmentation import evaluate
from rgbt.files import budgets
from rgbt.files.atomic import write_atomic
from rgbt.metrics.counts import Counts
from rgbt.metrics.names import DAY, MIOU, NIGHT, subset
from rgbt.metrics.scores import summary
from rgbt.requirements import record_of
from rgbt.tracking.csv_files import csv_text
from rgbt.tracking.tables import TextTable, percent
from rgbt.types import View

FORMAT = "rgbt robustness 1"
FOLDER = "robustness"
"""Inside ``evaluations/`` of a run; `analysis.robustness` looks for curves there."""

CLEAN = "clean"
FEATURES: dict[View, str] = {
    "thermal": "thermal alone (features)",
    "rgb": "RGB alone (features)",
}
"""View -> title next to "RGB removed (zeroed)": the network gets both images, and the
features of one branch alone are decoded."""


SCORES = (MIOU, subset(DAY, MIOU), subset(NIGHT, MIOU))


@dataclass(frozen=True)
class Condition:
    """The input of one evaluation: clean images, one branch, or a corruption.

    Attributes:
        file_stem: name of its files without extension.
        row: of the table: a corruption or a view, whose severities share it.
        title: title of the row.
        unit: of the severity; "" where it has none.
    """

    file_stem: str
    row: str
    title: str
    unit: str
    severity: float
    view: View
    corruption: CorruptionRequest | None = None


@dataclass(frozen=True)
class Measured:
    """A condition with its counts, and the mIoU of each part of them as a fraction."""

    condition: Condition
    counts: Counts
    mious: dict[str, float]


def conditions(session: Session, corruptions: Sequence[CorruptionRequest]) -> tuple[Condition, ...]:
    """Clean images, single branches if the network decodes them, and every severity."""
    view, known = view_of(session), record_of(session.model).views
    found = [Condition(CLEAN, CLEAN, CLEAN, "", 0.0, view)]
    for branch, title in FEATURES.items() if view == "rgbt" else ():
        if branch in known:
            name = f"features-{branch}"
            found.append(Condition(name, name, title, "", 1.0, branch))
    for each in (level for corruption in corruptions for level in corruption.ladder()):
        kind = each.corruption
        found.append(
            Condition(each.file_stem, each.row, kind.title, kind.unit, each.severity, view, each)
        )
    return tuple(found)


def measure(
    session: Session, split: str, corruptions: Sequence[CorruptionRequest], folder: Path
) -> tuple[Measured, ...]:
    """Evaluate the missing conditions of a run's robustness, clean images first.

    Each corruption is evaluated at all severities of its ladder. In the folder of the counts
    NAME.npz has a NAME.json, written after it, that describes its inputs.

    Raises:
        InputError: a severity that does not fit the images, or a file that cannot be read.
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
            mious = {name: scores[name] for name in SCORES if name in scores}
            found.append(Measured(condition, counts, mious))
            display.advance(task)
    return tuple(found)


def _counts(session: Session, condition: Condition, shared: dict[str, Any], folder: Path) -> Counts:
    """The counts in the folder if their inputs are the same, else new counts."""
    counts_file = folder / f"{condition.file_stem}.npz"
    made_file = folder / f"{condition.file_stem}.json"
    corruption = condition.corruption
    decisive = {
        **shared,
        "severity": condition.severity,
        "view": condition.view,
        # The key that counts on disk are found by.
        "failure": None if corruption is None else corruption.identity(),
    }
    identity = dict(json.loads(json.dumps(decisive)))
    made = {**identity, "row": condition.row, "title": condition.title, "unit": condition.unit}
    known = _read_json(made_file) or {}
    counts = None
    if counts_file.is_file() and {key: known.get(key) for key in identity} == identity:
        with suppress(InputError):
            counts = Counts.load(counts_file)
    if counts is None:
        request = EvaluationRequest(
            split=shared["split"], view=condition.view, corruption=corruption
        )
        counts = evaluate(session, session.model, request).counts
        # The description must not outlive the counts it belongs to.
        made_file.unlink(missing_ok=True)
        counts.save(counts_file)
    if known != made:
        write_atomic(made_file, (json.dumps(budgets.sealed(made), indent=1) + "\n").encode())
    return counts


def weights_digest(model: nn.Module) -> str:
    """SHA-256 in hexadecimal over names and bytes of all parameters and buffers that are saved."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def _read_json(path: Path) -> Any:
    """The mapping in a file of JSON; None where it is missing or damaged."""
    with suppress(InputError):
        return budgets.read_json(path, dict[str, Any], "")
    return None


def counts_folder(opened: TrainedNetwork, network: NetworkRequest, split: str) -> Path:
    """Folder for the counts of a split; suffixes name changes from the training."""
    session = opened.session
    regions = [] if network.regions == AS_TRAINED else [session.regions.name]
    others = other_images(session.dataset, _read_json(opened.folder.parent / "dataset.json"))
    return opened.folder / FOLDER / "_".join([split, *regions, *network.suffixes, *others])


def robustness_grid(measured: Sequence[Measured], title: str) -> TextTable:
    """One line per corruption; level 0 is the clean image, level n the n-th severity."""
    clean, *others = measured
    rows: dict[str, list[Measured]] = {}
    for each in others:
        rows.setdefault(each.condition.row, []).append(each)
    levels = max((len(row) for row in rows.values()), default=0)
    lines = []
    for row in rows.values():
        first = row[0].condition
        ladder = ", ".join(f"{each.condition.severity:g}" for each in row)
        severities = f"{ladder} {first.unit}" if first.unit else ""
        values = [percent(each.mious[MIOU]) for each in (clean, *row)]
        empty = [""] * (levels - len(row))
        lines.append((first.title, severities, *values, *empty))
    lines = lines or [(CLEAN, "", percent(clean.mious[MIOU]))]
    header = ("", "severities", *(f"level {level}" for level in range(levels + 1)))
    return TextTable(title, header, tuple(lines))


def write_tables(measured: Sequence[Measured], grid: TextTable, path: Path) -> None:
    """Write the numbers to `path` with .csv added and the table to `path` with .md added."""
    scores = list(measured[0].mious)
    rows: list[tuple[object, ...]] = [("row", "title", "unit", "severity", "view", *scores)]
    for each in measured:
        seen = each.condition
        values = [100 * each.mious[score] for score in scores]
        rows.append((seen.row, seen.title, seen.unit, f"{seen.severity:g}", seen.view, *values))
    # Names hold dots of severities: endings are added, not exchanged.
    write_atomic(path.with_name(f"{path.name}.csv"), csv_text(rows).encode())
    write_atomic(path.with_name(f"{path.name}.md"), grid.to_markdown().encode())
