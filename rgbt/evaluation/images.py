"""Write predictions of images: colour overlays and class indices, or pseudo-labels of a split."""

from __future__ import annotations

import hashlib
import json
import tempfile
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from rgbt.assembly.session import Session
from rgbt.checks import InputError, check_range
from rgbt.class_scores import best_of
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.config.overrides import composing
from rgbt.data.label_map import LabelMap
from rgbt.data.loaders import collate, eval_batches
from rgbt.data.new_images import ToPredict, of_files, of_path, of_split
from rgbt.data.pseudo_labels import (
    FORMAT,
    FULL,
    MANIFEST,
    PseudoLabels,
    confidence_path,
    label_path,
)
from rgbt.evaluation.predict import Predictor
from rgbt.files.atomic import write_atomic
from rgbt.files.plain_files import inside, write_json
from rgbt.metrics.measurement import Measurement
from rgbt.tables import TextTable, percent
from rgbt.terminal import info, progress
from rgbt.tracking.pictures import overlay
from rgbt.types import IGNORE, Batch, Sample


def chosen_images(session: Session, source: str, rgb: str, thermal: str) -> ToPredict:
    """Return the images of the options ``input``, or ``rgb`` and ``thermal``."""
    if bool(rgb) != bool(thermal) or bool(source) == bool(rgb):
        raise InputError("expected either input=... or both rgb=FILE and thermal=FILE.")
    dataset = session.dataset
    if rgb:
        return of_files(dataset, Path(rgb), Path(thermal))
    if source in dataset.splits:
        return of_split(dataset, source)
    return of_path(dataset, source, session.loading.on_error)


def write_images(
    session: Session,
    images: ToPredict,
    predictor: Predictor,
    out: Path,
    label_map: LabelMap | None,
) -> str:
    """Write NAME_overlay.png and NAME.png of every image to `out`; how many, and where."""
    images.check_out(out)
    written = 0
    with progress() as display:
        task = display.add_task("predicting", total=len(images.names), note="images")
        for sample in images.samples(session.loading.on_error):
            classes = predictor.classes(batch_of(session, sample))[0].cpu().numpy()
            classes = classes if label_map is None else label_map(classes)
            painted = overlay(sample.rgb, classes, session.dataset)
            # A line of a list of images may begin with "../".
            write_png(inside(out / f"{sample.name}_overlay.png", out), painted[..., ::-1])
            write_png(inside(out / f"{sample.name}.png", out), classes)
            written += 1
            display.advance(task)
    if images.skipped:
        first = next(iter(images.skipped.values()))
        info(f"{len(images.skipped)} image(s) skipped; the first: {first}")
    return f"{written} images in {out.resolve()}"


def batch_of(session: Session, sample: Sample) -> Batch:
    """Put one image on the device; images of a folder may have different sizes."""
    return collate([session.transform.test(sample)], "").to(session.device)


def write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an image of 8 or 16 bit, three channels in the order B, G, R."""
    assert image.dtype in (np.uint8, np.uint16), "OpenCV would write other types as 8 bits"
    content = cv2.imencode(".png", image)[1]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, content.tobytes())


def label_map_of(name: str) -> LabelMap | None:
    """Build the file of ``conf/label_map/`` called `name`; None for "none"."""
    if name == "none":
        return None
    with composing([]):
        return cast(LabelMap, build(compose([f"+label_map={name}"]).label_map))


def check_empty(out: Path) -> None:
    """Refuse a folder of pseudo-labels that holds files (InputError)."""
    if out.is_dir() and any(out.iterdir()):
        raise InputError(f"out={out}: the folder is not empty.")


def write_pseudo_labels(
    session: Session,
    wanted: Measurement,
    out: Path,
    *,
    threshold: float = 0.0,
    label_map: LabelMap | None = None,
) -> PseudoLabels:
    """Predict a split with the network of `session` and write its confident pixels as labels.

    The confidence of a pixel is the largest of its class probabilities
    (`rgbt.engine.evaluate.shares`), with a label map that of the network's own class. The
    folder (`rgbt.data.pseudo_labels`) is written under a temporary name and renamed at the end.

    Source: HeatNet's release (thermal teacher, night images). It keeps every pixel: threshold 0.

    Args:
        session: its network is the teacher.
        wanted: its split, view and head.
        out: folder, missing or empty.
        threshold: pixels whose confidence is below it get 255 instead of a class; in [0, 1].
        label_map: from the classes of the network to those of the data set, where they differ.
    """
    check_range("threshold", threshold, 0, 1)
    settings: dict[str, Any] = {
        "format": FORMAT,
        "teacher": session.run or session.label,
        "weights": weights_digest(session.model),
        "view": wanted.view,
        "head": wanted.head or None,
        "label_map": None if label_map is None else json.loads(json.dumps(asdict(label_map))),
        "threshold": float(threshold),
        "dataset": session.dataset.name,
        "fingerprint": session.dataset.fingerprint(),
        "split": wanted.split,
        "classes": list(session.dataset.classes),
    }
    check_empty(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as temporary:
        made = Path(temporary) / out.name
        manifest = settings | _predict(session, wanted, made, threshold, label_map)
        write_json(made / MANIFEST, manifest)
        with suppress(OSError):  # another process was faster
            made.rename(out)
    return PseudoLabels(out)


def _predict(
    session: Session,
    wanted: Measurement,
    out: Path,
    threshold: float,
    label_map: LabelMap | None,
) -> dict[str, Any]:
    """Predict and write all images of the split; the part of the manifest that counts them."""
    names = session.dataset.names(wanted.split)
    batches = eval_batches(session.dataset, names, session.transform, session.loading)
    head: Any = wanted.head or None
    predictor = Predictor(session, wanted.view, head)  # type: ignore[arg-type]
    digest = hashlib.sha256()
    counts, sums = np.zeros(IGNORE + 1, np.int64), np.zeros(IGNORE + 1)
    with progress() as display:
        task = display.add_task("predicting", total=len(names), note="images")
        for batch in batches:
            found = predictor.probabilities(batch.to(session.device))
            confidence, classes = best_of(found)
            by_image = zip(batch.name, confidence.cpu().numpy(), classes.cpu().numpy(), strict=True)
            for name, sure, ids in by_image:
                known = ids.astype(np.uint8)
                known = known if label_map is None else label_map(known)
                label = np.where(sure < threshold, np.uint8(IGNORE), known)
                scaled = np.rint(FULL * sure.astype(np.float64)).clip(0, FULL).astype(np.uint16)
                write_png(inside(confidence_path(out, name), out), scaled)
                write_png(inside(label_path(out, name), out), label)
                digest.update(f"{name} {label.shape}\n".encode())
                digest.update(label.tobytes())
                digest.update(scaled.astype("<u2").tobytes())
                counts += np.bincount(label.ravel(), minlength=IGNORE + 1)
                sums += np.bincount(label.ravel(), scaled.ravel(), IGNORE + 1)
            display.advance(task, len(batch.name))
    total = int(counts.sum())
    if not total:
        raise InputError(f"split '{wanted.split}': no image could be read.")
    by_class = {}
    for number, name in enumerate(session.dataset.classes):
        pixels = int(counts[number])
        mean = float(sums[number]) / FULL / pixels if pixels else None
        by_class[name] = {"share": pixels / total, "mean_confidence": mean}
    return {
        "images": len(names) - len(batches.skipped),
        "skipped": sorted(batches.skipped),
        "kept": 1 - int(counts[IGNORE]) / total,
        "mean_confidence": float(sums.sum()) / FULL / total,
        "by_class": by_class,
        "digest": digest.hexdigest(),
    }


def weights_digest(model: nn.Module) -> str:
    """Return SHA-256 in hexadecimal over names and bytes of all saved parameters and buffers."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def labels_table(labels: PseudoLabels) -> TextTable:
    """Make the table of the share of pixels of each class, and the teacher's confidence in them."""
    made, total = labels.manifest, 0.0
    rows = []
    for name, found in made["by_class"].items():
        rows.append((name, found["share"], found["mean_confidence"]))
        total += found["share"] * (found["mean_confidence"] or 0.0)
    kept = made["kept"]
    rows += [("kept", kept, total / kept if kept else None)]
    rows += [("all pixels", 1.0, made["mean_confidence"])]
    which = f"confidence of at least {made['threshold']:g}" if made["threshold"] else "every pixel"
    title = f"{made['images']} images of {made['dataset']} {made['split']}, {which}"
    grid = []
    for name, share, mean in rows:
        grid.append((name, percent(share), percent(float("nan") if mean is None else mean)))
    return TextTable(title, ("class", "pixels", "confidence"), tuple(grid))
