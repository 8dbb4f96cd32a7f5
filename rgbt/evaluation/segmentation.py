"""Predictions of a split, counted by image, region, label and class; tables of the counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import nn

from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.data.loaders import eval_batches
from rgbt.dataset import LabelledDataset
from rgbt.engine.evaluate import predictions
from rgbt.engine.progress import progress
from rgbt.evaluation.prediction import decode_ahead, heads_of, view_of
from rgbt.evaluation.request import EvaluationRequest
from rgbt.metrics import scores
from rgbt.metrics.absent import absent_notes
from rgbt.metrics.confusion import RegionCounter
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Regions
from rgbt.tracking.pictures import Legend, PanelExample
from rgbt.tracking.tables import ClassTable, RegionTable, ResultTables
from rgbt.types import View

NUM_PANELS = 6
"""Images of the qualitative panel: as many by day as by night where the split holds both."""


@dataclass(frozen=True)
class EvaluationResult:
    """Counts of one split.

    Attributes:
        counts: per image and region.
        view: what was predicted from.
        kept: examples for pictures.
        skipped: names of unreadable files that were left out.
    """

    counts: Counts
    view: View
    kept: tuple[PanelExample, ...]
    skipped: tuple[str, ...]


def evaluate(session: Session, model: nn.Module, request: EvaluationRequest) -> EvaluationResult:
    """Predict a split and count, with a progress bar.

    Args:
        session: see `rgbt.build.session.open_session`.
        model: the network to evaluate; left in evaluation mode.
        request: split, view, head, corruption, and the images to return for pictures.

    Raises:
        InputError: a file cannot be read (data.on_error=raise), or none could be; the network
            has not the view or the head; a corruption that does not fit the images.
    """
    view = view_of(session, request.view)
    if request.corruption is not None:
        session = request.corruption.applied_to(session, request.split)
    dataset = session.dataset
    decode_ahead(session, request.split)
    batches = eval_batches(dataset, request.split, session.transform, session.loading)
    counter = RegionCounter(len(dataset.classes), session.regions)
    counted: dict[str, np.ndarray] = {}
    kept: list[PanelExample] = []
    heads = heads_of(session, view, request.head)
    with progress() as display:
        total = len(dataset.names(request.split))
        task = display.add_task(request.split, total=total, note="images")
        for found in predictions(model, batches, session.fabric, view, heads):
            triples = zip(found.batch.name, found.batch.label, found.classes, strict=True)
            for name, label, classes in triples:
                counted[name] = counter(label, classes)
                is_kept = name in request.keep
                kept += [_example(session, name, classes.numpy())] if is_kept else []
            display.advance(task, len(found.batch.name))
    counts = _counts(session, request.split, counted)
    return EvaluationResult(counts, view, tuple(kept), tuple(batches.skipped))


def _counts(session: Session, split: str, counted: dict[str, np.ndarray]) -> Counts:
    dataset = session.dataset
    if not counted:
        raise InputError(f"split '{split}' of {dataset.name}: no image could be read.")
    return Counts(
        counts=np.stack(list(counted.values())).astype(np.int32),
        names=tuple(counted),
        night=dataset.nights(tuple(counted)),
        classes=dataset.classes,
        partition=session.regions.name,
        dataset=dataset.fingerprint(),
        split=split,
        unscored=dataset.unscored,
        absent=session.regions.absent,
    )


def _example(session: Session, name: str, classes: np.ndarray) -> PanelExample:
    sample = session.dataset.read(name)
    label = sample.label if sample.label is not None else np.full_like(sample.thermal, 255)
    return PanelExample(name, sample.rgb, sample.thermal, label, classes)


def result_tables(counts: Counts, regions: Regions, label: str, step: int) -> ResultTables:
    """The tables of one evaluation, from its counts alone.

    Args:
        counts: of the split.
        regions: partition of the counts and the rule for absent classes.
        label: what the row stands for, e.g. "grbm".
        step: optimiser steps done.
    """
    absent, scored = regions.absent, counts.scored
    whole, by_region = counts.whole(), counts.by_region()
    region_ious = scores.miou(by_region, absent, scored)
    parts = {part: scores.miou(sub.whole(), absent, scored) for part, sub in counts.parts().items()}
    return ResultTables(
        split=counts.split,
        step=step,
        region_names=tuple(f"{regions.partition}_{n + 1}" for n in range(len(by_region))),
        regions=RegionTable(
            row_label=label,
            region_ious=tuple(map(float, region_ious)),
            miou=float(scores.miou(whole, absent, scored)),
            variance=float(scores.variance(region_ious)),
        ),
        classes=ClassTable(
            names=counts.classes,
            ious=tuple(map(float, scores.iou(whole, absent))),
            accuracies=tuple(map(float, scores.recall(whole, absent))),
            region_ious=tuple(tuple(map(float, row)) for row in scores.iou(by_region, absent).T),
            subset_mious={part: float(value) for part, value in parts.items()},
            unscored=counts.unscored,
            notes=absent_notes(by_region, counts.classes, scored, counts.split, absent),
        ),
    )


def legend_of(dataset: LabelledDataset) -> Legend:
    """Classes of a data set and their colours."""
    return Legend(dataset.classes, np.array(dataset.palette, np.uint8))


def panel_names(dataset: LabelledDataset, split: str) -> tuple[str, ...]:
    """The first images of a split, half by day and half by night where it holds both."""
    names = dataset.names(split)
    at_night = dataset.nights(names) or (False,) * len(names)
    night = [name for name, dark in zip(names, at_night, strict=True) if dark]
    day = [name for name, dark in zip(names, at_night, strict=True) if not dark]
    num_day = min(len(day), max(NUM_PANELS // 2, NUM_PANELS - len(night)))
    return tuple(day[:num_day] + night[: NUM_PANELS - num_day])
