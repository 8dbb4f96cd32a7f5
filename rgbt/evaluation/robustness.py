"""Counts of a network under every corruption: what is evaluated, kept and evaluated again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.engine.progress import progress
from rgbt.evaluation.corruption_request import CorruptionRequest
from rgbt.evaluation.prediction import view_of
from rgbt.evaluation.request import EvaluationRequest
from rgbt.evaluation.segmentation import evaluate
from rgbt.files import budgets
from rgbt.files.atomic import write_atomic
from rgbt.metrics.counts import Counts
from rgbt.metrics.scores import miou
from rgbt.requirements import record_of
from rgbt.types import View

FORMAT = "rgbt robustness 1"
CLEAN = "clean"
FEATURES: dict[View, str] = {
    "thermal": "thermal alone (features)",
    "rgb": "RGB alone (features)",
}
"""View -> what it is called beside "RGB removed (zeroed)": the network sees both images, and the
features of one branch alone are decoded."""


@dataclass(frozen=True)
class Condition:
    """What the network sees in one evaluation: clean images, one branch, or a corruption.

    Attributes:
        file_stem: name of its files without extension.
        row: of the table: a corruption or a view, whose severities share it.
        title: what people call the row.
        unit: of the severity; "" where it has none.
        severity: 0: clean.
        view: what is predicted from.
        corruption: of the images; None: they are clean.
    """

    file_stem: str
    row: str
    title: str
    unit: str
    severity: float
    view: View
    corruption: CorruptionRequest | None = None

    def identity(self) -> dict[str, Any]:
        """What of the condition decides the counts, as values of JSON."""
        return {
            "severity": self.severity,
            "view": self.view,
            # The key that counts on disk are found by.
            "failure": None if self.corruption is None else self.corruption.identity(),
        }


@dataclass(frozen=True)
class Measured:
    """A condition with its counts, and the mIoU of each part of them as a fraction."""

    condition: Condition
    counts: Counts
    mious: dict[str, float]


def conditions(session: Session, corruptions: Sequence[CorruptionRequest]) -> tuple[Condition, ...]:
    """Clean images, single branches as far as the network decodes them, every severity."""
    view, known = view_of(session), record_of(session.model).views
    branches = {each: title for each, title in FEATURES.items() if view == "rgbt" and each in known}
    found = [Condition(CLEAN, CLEAN, CLEAN, "", 0.0, view)]
    for branch, title in branches.items():
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
    """Evaluate what is missing of a run's robustness; the clean images are first.

    Args:
        session: with the trained network.
        split: of its data set.
        corruptions: each is evaluated at all severities of its ladder.
        folder: of the counts; NAME.npz has a NAME.json, written after it, that says what made it.

    Raises:
        InputError: a severity that does not fit the images, or a file that cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    every = conditions(session, corruptions)
    shared = _shared_identity(session, split)
    found = []
    with progress() as display:
        task = display.add_task("robustness", total=len(every), note="")
        for condition in every:
            display.update(task, note=condition.file_stem)
            counts = _counts(session, split, condition, shared, folder)
            parts = {"": counts, **{f"{part}/": sub for part, sub in counts.parts().items()}}
            mious = {
                f"{part}mIoU": float(miou(sub.whole(), session.regions.absent, sub.scored))
                for part, sub in parts.items()
            }
            found.append(Measured(condition, counts, mious))
            display.advance(task)
    return tuple(found)


def _counts(
    session: Session, split: str, condition: Condition, shared: dict[str, Any], folder: Path
) -> Counts:
    """Those in the folder if the same made them, else new ones."""
    counts_file = folder / f"{condition.file_stem}.npz"
    made_file = folder / f"{condition.file_stem}.json"
    identity = dict(json.loads(json.dumps({**shared, **condition.identity()})))
    texts = {"row": condition.row, "title": condition.title, "unit": condition.unit}
    made = {**identity, **texts}
    known = read_json(made_file)
    counts = _kept(counts_file, known, identity)
    if counts is None:
        request = EvaluationRequest(
            split=split, view=condition.view, corruption=condition.corruption
        )
        counts = evaluate(session, session.model, request).counts
        # What says that the counts are of these weights must not outlive those of others.
        made_file.unlink(missing_ok=True)
        counts.save(counts_file)
    if known != made:
        write_atomic(made_file, (json.dumps(budgets.sealed(made), indent=1) + "\n").encode())
    return counts


def _kept(file: Path, known: Any, identity: dict[str, Any]) -> Counts | None:
    """The counts in `file` if the same made them; None where they are missing or damaged.

    Args:
        file: of counts.
        known: what is written beside it.
        identity: what decides the counts.
    """
    is_same = isinstance(known, dict) and {key: known.get(key) for key in identity} == identity
    if not (file.is_file() and is_same):
        return None
    try:
        return Counts.load(file)
    except InputError:
        return None


def _shared_identity(session: Session, split: str) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "dataset": session.dataset.fingerprint(),
        "split": split,
        "partition": session.regions.name,
        "weights": weights_digest(session.model),
        "transform": session.spec.transform.plain,
        "precision": session.trainer.precision,
    }


def weights_digest(model: nn.Module) -> str:
    """SHA-256 in hexadecimal over names and bytes of all parameters and buffers that are saved."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def read_json(path: Path) -> Any:
    """The mapping in a file of JSON; None where it is missing or damaged."""
    try:
        return budgets.read_json(path, dict[str, Any], "")
    except InputError:
        return None
