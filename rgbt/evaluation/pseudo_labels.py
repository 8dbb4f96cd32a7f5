"""Predict pseudo-labels for a split; pixels below a confidence threshold stay unlabelled.

The folder is described in `rgbt.data.pseudo_labels`. Writing can be interrupted and resumed:
images whose files exist are not predicted again.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from rgbt.build.session import Session
from rgbt.checks import InputError, check_range
from rgbt.class_scores import best_of
from rgbt.config.command import composing
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.data.label_map import LabelMap
from rgbt.data.loaders import eval_batches
from rgbt.data.pseudo_labels import (
    FORMAT,
    FULL,
    MANIFEST,
    PseudoLabels,
    confidence_path,
    label_path,
    read_pair,
)
from rgbt.dataset import Subset
from rgbt.engine.progress import progress
from rgbt.evaluation.images import write_png
from rgbt.evaluation.prediction import Predictor, decode_ahead, view_of
from rgbt.evaluation.request import EvaluationRequest
from rgbt.files.atomic import holding, write_atomic
from rgbt.files.budgets import read_json, sealed
from rgbt.spec.run_spec import RunSpec
from rgbt.tracking.tables import TextTable, percent
from rgbt.tracking.terminal import info
from rgbt.types import IGNORE

UNFINISHED = "pseudo_labels.begun.json"
"""File with the settings of a folder that is not finished."""

LOCK = ".lock"


@dataclass(frozen=True)
class Labelling:
    """How predictions are converted to labels.

    Attributes:
        threshold: pixels whose confidence is below it get 255 instead of a class; in [0, 1].
        label_map: from the classes of the network to those of the data set, where they differ.

    Raises:
        InputError: a threshold out of range.
    """

    threshold: float = 0.0
    label_map: LabelMap | None = None

    def __post_init__(self) -> None:
        check_range("threshold", self.threshold, 0, 1)


def teacher_digest(model: nn.Module) -> str:
    """SHA-256 over the parameters and statistics of a network, in hexadecimal."""
    digest = hashlib.sha256()
    for key, tensor in model.state_dict().items():
        digest.update(f"{key} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        digest.update(flat.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def label_map_of(name: str) -> LabelMap | None:
    """The file of ``conf/label_map/`` called `name`; None for "none".

    Raises:
        InputError: there is no such file, or its lists do not fit.
    """
    if name == "none":
        return None
    with composing([]):
        node = compose([f"+label_map={name}"]).label_map
    made: LabelMap = build(node)
    return made


def write_pseudo_labels(
    session: Session, teacher: str, request: EvaluationRequest, labelling: Labelling, out: Path
) -> PseudoLabels:
    """Predict a split with the network of `session` and write its confident pixels as labels.

    The confidence of a pixel is the largest of its class probabilities
    (`rgbt.engine.evaluate.probabilities`), with a label map that of the network's own class. A
    folder that is finished with the same settings is returned as it is. A second process that
    writes to the same folder waits for the first.

    Source: HeatNet's release (labels and confidences of the thermal teacher for night images). It
    keeps every pixel: threshold 0.

    Args:
        session: its network is the teacher.
        teacher: key of its run, or file of its weights; for people.
        request: split, view and head.
        labelling: how predictions become labels.
        out: folder, made where it is missing.

    Raises:
        InputError: settings that do not fit each other, a folder with other content or with
            pseudo-labels of other settings, an image that cannot be read (data.on_error=raise).
        RunError: the network's predictions are not finite.
    """
    assert request.corruption is None, "labels are predicted from clean images"
    settings = _settings(session, teacher, request, labelling)
    names = tuple(dict.fromkeys(session.dataset.names(request.split)))
    _refuse_other_content(out)
    out.mkdir(parents=True, exist_ok=True)
    with _alone(out):
        finished = _is_finished(out, settings)
        missing = tuple(
            name
            for name in names
            if not (label_path(out, name).is_file() and confidence_path(out, name).is_file())
        )
        if not finished or set(missing) - set(PseudoLabels(out).manifest["skipped"]):
            # In this order, a killed process leaves a folder that can be resumed.
            write_atomic(out / UNFINISHED, _text(settings))
            (out / MANIFEST).unlink(missing_ok=True)
            skipped = _predict(session, request, labelling, out, missing, len(names))
            _finish(out, settings, [name for name in names if name not in skipped], skipped)
    return PseudoLabels(out)


def summary(labels: PseudoLabels) -> TextTable:
    """Print the share of pixels of each class, and the teacher's confidence in them."""
    manifest = labels.manifest
    by_class = [manifest["by_class"][name] for name in labels.classes]
    rows = [
        (name, percent(each["share"]), _percent(each["mean_confidence"]))
        for name, each in zip(labels.classes, by_class, strict=True)
    ]
    least = manifest["threshold"]
    which = f"pixels with a confidence of at least {least:g}" if least else "every pixel"
    title = f"{manifest['images']} images of {manifest['dataset']} {manifest['split']}, {which}"
    total = sum(each["share"] * (each["mean_confidence"] or 0.0) for each in by_class)
    share = manifest["kept"]
    kept = ("kept", percent(share), _percent(total / share if share else None))
    whole = ("all pixels", percent(1.0), percent(manifest["mean_confidence"]))
    return TextTable(title, ("class", "pixels", "confidence"), (*rows, kept, whole))


def _percent(fraction: float | None) -> str:
    return percent(float("nan") if fraction is None else fraction)


def _settings(
    session: Session, teacher: str, request: EvaluationRequest, labelling: Labelling
) -> dict[str, Any]:
    """The first part of the manifest: all settings that determine the files."""
    settings = {
        "format": FORMAT,
        "teacher": teacher,
        "weights": teacher_digest(session.model),
        "network": _network(session.spec),
        "view": view_of(session, request.view),
        "head": request.head or session.domains.tested_head,
        "label_map": None if labelling.label_map is None else asdict(labelling.label_map),
        "threshold": float(labelling.threshold),
        "dataset": session.dataset.name,
        "fingerprint": session.dataset.fingerprint(),
        "split": request.split,
        "classes": session.dataset.classes,
    }
    plain: dict[str, Any] = json.loads(json.dumps(settings))
    return plain


def _network(spec: RunSpec) -> str:
    """SHA-256 over the settings of a prediction, without the weights and without paths."""
    plain = spec.plain
    model = {key: value for key, value in plain["model"].items() if key not in ("weights", "fresh")}
    unimportant = ("root", "cache_dir", "palette", "background", "layout")
    read = {key: value for key, value in plain["dataset"].items() if key not in unimportant}
    decisive = [model, read, plain["domains"], plain["transform"], plain["trainer"]["precision"]]
    text = json.dumps(decisive, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _refuse_other_content(out: Path) -> None:
    ours = (MANIFEST, UNFINISHED)
    if not out.is_dir() or any((out / name).exists() for name in ours):
        return
    others = sorted(path.name for path in out.iterdir() if not path.name.startswith("."))
    if others:
        raise InputError(
            f"{out} holds {others[0]} and no pseudo-labels. Choose a new folder, so that nothing "
            "is overwritten."
        )


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Lock the folder for this process, and remove temporary files of killed processes."""
    with ExitStack() as locks:
        holder = locks.enter_context(holding(out / LOCK))
        if holder is not None:
            info(f"{out} is being written by {holder}; waiting for it.")
            locks.enter_context(holding(out / LOCK, wait_s=math.inf))
        for folder in ("labels", "confidence"):
            for leftover in (out / folder).rglob(".*.png.*"):
                leftover.unlink()
        yield


def _is_finished(out: Path, settings: dict[str, Any]) -> bool:
    """Whether all files exist; InputError if they were written with other settings."""
    finished = (out / MANIFEST).exists()
    if finished:
        settings_before = PseudoLabels(out).manifest
    elif (out / UNFINISHED).exists():
        settings_before = read_json(out / UNFINISHED, dict[str, Any], "remove it and predict again")
    else:
        return False
    for key, value in settings.items():
        if key != "teacher" and settings_before.get(key) != value:
            before, now = (str(each)[:60] for each in (settings_before.get(key), value))
            raise InputError(
                f"{out} holds pseudo-labels of another {key} ({before}, now {now}). Choose "
                "another folder, or remove this one."
            )
    return finished


def _predict(
    session: Session,
    request: EvaluationRequest,
    labelling: Labelling,
    out: Path,
    missing: tuple[str, ...],
    total: int,
) -> dict[str, str]:
    """Predict and write the missing images; returns the errors of unreadable images by name."""
    if not missing:
        return {}
    label_map = labelling.label_map
    decode_ahead(session, request.split)
    subset = Subset(session.dataset, missing)
    batches = eval_batches(subset, request.split, session.transform, session.loading)
    predictor = Predictor(session, session.model, request)
    with progress() as display:
        done = total - len(missing)
        task = display.add_task("predicting", total=total, completed=done, note="images")
        for batch in batches:
            found = predictor.probabilities(batch.to(session.fabric.device))
            confidence, classes = (each.cpu().numpy() for each in best_of(found))
            for name, sure, ids in zip(batch.name, confidence, classes, strict=True):
                ids = ids.astype(np.uint8) if label_map is None else label_map(ids.astype(np.uint8))
                label = np.where(sure < labelling.threshold, np.uint8(IGNORE), ids)
                scaled = np.rint(FULL * sure.astype(np.float64)).clip(0, FULL).astype(np.uint16)
                write_png(confidence_path(out, name), scaled)
                write_png(label_path(out, name), label)
            display.advance(task, len(batch.name))
    return batches.skipped


def _finish(out: Path, settings: dict[str, Any], names: list[str], skipped: dict[str, str]) -> None:
    """Read all files once, and write the manifest."""
    if not names:
        raise InputError(
            f"split '{settings['split']}' of {settings['dataset']}: no image could be read."
        )
    digest = hashlib.sha256()
    counts = np.zeros(IGNORE + 1, np.int64)
    sums = np.zeros(IGNORE + 1)
    with progress() as display:
        task = display.add_task("checking", total=len(names), note="images")
        for name in names:
            label, confidence = read_pair(out, name, len(settings["classes"]))
            digest.update(f"{name} {label.shape}\n".encode())
            digest.update(label.tobytes())
            digest.update(confidence.astype("<u2").tobytes())
            counts += np.bincount(label.ravel(), minlength=IGNORE + 1)
            sums += np.bincount(label.ravel(), confidence.ravel(), IGNORE + 1)
            display.advance(task)
    total = int(counts.sum())
    found = {
        "images": len(names),
        "skipped": sorted(skipped),
        "kept": 1 - int(counts[IGNORE]) / total,
        "mean_confidence": float(sums.sum()) / FULL / total,
        "by_class": {
            name: {
                "share": int(count) / total,
                "mean_confidence": float(added) / FULL / int(count) if count else None,
            }
            for name, count, added in zip(settings["classes"], counts, sums, strict=False)
        },
        "digest": digest.hexdigest(),
    }
    write_atomic(out / MANIFEST, _text(settings | found))
    (out / UNFINISHED).unlink(missing_ok=True)


def _text(values: dict[str, Any]) -> bytes:
    return (json.dumps(sealed(values), indent=1) + "\n").encode()
