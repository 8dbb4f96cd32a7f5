"""Counts of a network under every failure: what is evaluated, what is kept, what is made again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError
from rgbt.evaluation.corrupted import Chosen, Failure
from rgbt.files import budgets
from rgbt.requirements import record_of
from rgbt.types import View

if TYPE_CHECKING:
    from torch import nn

    from rgbt.build.session import Session
    from rgbt.metrics.counts import Counts

FORMAT = "rgbt robustness 1"
CLEAN = "clean"
FEATURES: dict[View, str] = {
    "thermal": "thermal alone (features)",
    "rgb": "RGB alone (features)",
}
"""View -> what it is called beside "RGB removed (zeroed)": the network sees both images, and the
features of one branch alone are decoded."""


@dataclass(frozen=True)
class Asked:
    """One evaluation.

    Attributes:
        mark: name of its file.
        row: of the table: a degradation or a view, whose severities share it.
        title: what people call the row.
        unit: of the severity; "" where it has none.
        severity: 0: clean.
        view: what is predicted from.
        failure: of the images; None: they are clean.
    """

    mark: str
    row: str
    title: str
    unit: str
    severity: float
    view: View
    failure: Failure | None = None


@dataclass(frozen=True)
class Measured:
    """An evaluation with its counts, and the mIoU of each part of them as a fraction."""

    asked: Asked
    counts: Counts
    mious: dict[str, float]


def asked_of(session: Session, chosen: Sequence[Chosen]) -> tuple[Asked, ...]:
    """Clean images, single branches as far as the network decodes them, every failure."""
    from rgbt.build.session import view_of

    view = view_of(session)
    known = record_of(session.model).views
    branches = {each: title for each, title in FEATURES.items() if view == "rgbt" and each in known}
    found = [Asked(CLEAN, CLEAN, CLEAN, "", 0.0, view)]
    for branch, title in branches.items():
        found.append(Asked(f"features-{branch}", f"features-{branch}", title, "", 1.0, branch))
    for each in chosen:
        kind = each.degradation
        for severity in kind.severities:
            failure = Failure(each, severity)
            said = (each.row, kind.title, kind.unit, severity)
            found.append(Asked(failure.mark, *said, view, failure))
    return tuple(found)


def measure(
    session: Session, split: str, chosen: Sequence[Chosen], folder: Path
) -> tuple[Measured, ...]:
    """Evaluate what is missing of a run's robustness; the clean images come first.

    Args:
        session: with the trained network.
        split: of its data set.
        chosen: degradations, each with all severities of its ladder.
        folder: of the counts; NAME.npz has a NAME.json, written after it, that says what made it.

    Raises:
        InputError: a severity that does not fit the images, or a file that cannot be read.
    """
    from rgbt.engine.progress import progress
    from rgbt.metrics.scores import miou

    folder.mkdir(parents=True, exist_ok=True)
    every = asked_of(session, chosen)
    shared = _shared_identity(session, split)
    found = []
    with progress() as display:
        task = display.add_task("robustness", total=len(every), note="")
        for asked in every:
            display.update(task, note=asked.mark)
            counts = _counts(session, split, asked, shared, folder)
            parts = {"": counts, **{f"{part}/": sub for part, sub in counts.parts().items()}}
            mious = {
                f"{part}mIoU": float(miou(sub.whole(), session.regions.absent, sub.scored))
                for part, sub in parts.items()
            }
            found.append(Measured(asked, counts, mious))
            display.advance(task)
    return tuple(found)


def _counts(
    session: Session, split: str, asked: Asked, shared: dict[str, Any], folder: Path
) -> Counts:
    """Those that are there if they were made of the same, else new ones."""
    from rgbt.build.session import evaluate
    from rgbt.files.atomic import write_atomic

    counts_file, made_file = folder / f"{asked.mark}.npz", folder / f"{asked.mark}.json"
    identity = _identity(asked, shared)
    made = {**identity, "row": asked.row, "title": asked.title, "unit": asked.unit}
    known = read_json(made_file)
    counts = _kept(counts_file, known, identity)
    if counts is None:
        failing = session if asked.failure is None else asked.failure.applied(session, split)
        counts = evaluate(failing, session.model, split, view=asked.view).counts
        # What says that the counts are of these weights must not outlive those of others.
        made_file.unlink(missing_ok=True)
        counts.save(counts_file)
    if known != made:
        write_atomic(made_file, (json.dumps(budgets.sealed(made), indent=1) + "\n").encode())
    return counts


def _kept(file: Path, known: Any, identity: dict[str, Any]) -> Counts | None:
    """The counts in `file` if they were made of the same; None where they are missing or damaged.

    Args:
        file: of counts.
        known: what is written beside it.
        identity: see `_identity`.
    """
    from rgbt.metrics.counts import Counts

    is_same = isinstance(known, dict) and {key: known.get(key) for key in identity} == identity
    if not (file.is_file() and is_same):
        return None
    try:
        return Counts.load(file)
    except InputError:
        return None


def _identity(asked: Asked, shared: dict[str, Any]) -> dict[str, Any]:
    """What decides the counts of an evaluation, as read back from JSON."""
    plain = {
        **shared,
        "severity": asked.severity,
        "view": asked.view,
        "failure": None if asked.failure is None else asked.failure.identity(),
    }
    return dict(json.loads(json.dumps(plain)))


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
    import torch

    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def read_json(path: Path) -> Any:
    """The mapping in a file of JSON; None where it is not there or damaged."""
    try:
        return budgets.read_json(path, dict[str, Any], "")
    except InputError:
        return None
